"""What the per-primitive stage decides by: the states of a primitive, and where the pixel stage leaves float32. numba
and Warp read it.

The bounds were found with ``benchmarks/numerics.py``.
"""

from __future__ import annotations

__all__ = [
    "ANCHOR_RADII", "CULLED", "CUT", "FLOAT32_MAX", "FLOAT64_ANCHOR", "FLOAT64_PIXELS", "FLOAT64_RADII", "FLOAT64_RATIO", "FLOAT64_RATIO_NEAR",
    "FLOAT64_TURNS", "NON_FINITE", "VISIBLE",
]  # fmt: skip

VISIBLE, CULLED, NON_FINITE = 0, 1, 2
FLOAT32_MAX = 3.0e38

FLOAT64_RADII = 8.0  # terms of a point on the ray this many radii of the thinnest axis long: they cancel
FLOAT64_ANCHOR = 1.25  # the same of the centre seen from an anchor at the camera: most cameras outside, but near
FLOAT64_TURNS = 4.0  # of a neuron, or a unit of a colour network, over half a chord
ANCHOR_RADII = (
    1.5  # a centre at least so many radii in front of the camera is its own anchor, also where the near plane cuts it
)
CUT = 1e-3  # of the reach: float32 may find a chord cut that float64 does not
FLOAT64_PIXELS = 16384.0  # from the corner of the image to the anchor
FLOAT64_RATIO = 256.0  # of the axes; for the gradients
FLOAT64_RATIO_NEAR = 16.0  # of the axes of a primitive anchored at the camera, which its chords pass closely
