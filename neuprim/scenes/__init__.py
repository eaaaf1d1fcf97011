"""Generated scenes, written in layouts that loaders read: solids, room, lit solids and smoke. They know no task."""

__all__ = ["PIXEL_CLASSES"]

PIXEL_CLASSES = ("background", "lit", "cast_shadow", "attached_shadow", "highlight")
"""Names of the values 0 to 4 in the class maps of lit solids."""
