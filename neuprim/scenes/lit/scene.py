"""What stands in the scene: the solids of the static one on a round matt slab instead of their plate, and a dark
polished ring."""

from __future__ import annotations

from neuprim.scenes.meshes import lathe, ring
from neuprim.scenes.shapes import FLOOR, Solid, build, plain

__all__ = ["RADIUS", "solids"]

_THICK, _EDGE = 0.1, 0.012
_MAJOR, _MINOR = 0.235, 0.1

RADIUS = 1.19
"""A sphere about the origin that holds everything, scene units."""


def solids() -> list[Solid]:
    """All solids, the same at every call. The slab is bright and even, so that shadows show; the ring is nearly black,
    so that its highlights do."""
    profile = [(0.0, 1.0 - _EDGE), (_EDGE, 1.0), (_THICK - _EDGE, 1.0), (_THICK, 1.0 - _EDGE)]
    slab = Solid("slab", lathe([0, 0, FLOOR - _THICK], [0, 0, 1], profile, sections=256), plain("#c9c2b4"), 0.0)
    polished = ring([-0.66, 0.2, FLOOR + _MAJOR + _MINOR], [1.0, 0.35, 0.0], _MAJOR, _MINOR)
    others = [solid for solid in build() if solid.name != "plate"]
    return [slab, *others, Solid("glossy ring", polished, plain("#3a1c4a"), 0.35, specular=2.8)]
