"""The scene ``lit_solids``: the solids and a glossy ring on a slab, under one point light per image."""

__all__ = ["CLASSES"]

CLASSES = ("background", "lit", "cast_shadow", "attached_shadow", "highlight")
"""Names of the values 0 to 4 of a map of pixel classes."""
