"""Generators of the built-in scenes (solids, room, lit solids, smoke). Loaders of tasks read the written files."""

__all__ = ["PIXEL_CLASSES"]

PIXEL_CLASSES = ("background", "lit", "cast_shadow", "attached_shadow", "highlight")
"""Names of the pixel classes 0 to 4, which the images ``*_classes.png`` of the scene ``lit_solids`` store."""
