"""Generated scenes (solids, room, lit solids, smoke), in layouts that loaders read; no task is used."""

__all__ = ["PIXEL_CLASSES"]

PIXEL_CLASSES = ("background", "lit", "cast_shadow", "attached_shadow", "highlight")
"""Names of the values 0 to 4 in the class maps of lit solids."""
