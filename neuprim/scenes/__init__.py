"""Generated scenes: solids, a room, lit solids and smoke, and what they share (shapes, ray casting, image sets).

Scenes write files in a layout that loaders read. They know no task: tasks register them and load what they wrote.
"""

__all__ = ["PIXEL_CLASSES"]

PIXEL_CLASSES = ("background", "lit", "cast_shadow", "attached_shadow", "highlight")
"""Names of the values 0 to 4 in the class maps of lit solids."""
