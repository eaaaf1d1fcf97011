"""Constants of the kernels that compute view-dependent colours.

C0 to C3 are factors of the real spherical harmonics of degrees 0 to 3, with the signs of 3D Gaussian splatting. The
other constants are limits of spherical Gaussian lobes (:mod:`neuprim.core.model.lobes`).
"""

from __future__ import annotations

import math

C0 = 0.5 / math.sqrt(math.pi)  # Y_00: a colour c of every direction has the coefficient (c - 0.5)/C0

C1 = math.sqrt(3.0 / (4.0 * math.pi))
C2 = (
    math.sqrt(15.0 / (4.0 * math.pi)),
    -math.sqrt(15.0 / (4.0 * math.pi)),
    math.sqrt(5.0 / (16.0 * math.pi)),
    -math.sqrt(15.0 / (4.0 * math.pi)),
    math.sqrt(15.0 / (16.0 * math.pi)),
)
C3 = (
    -math.sqrt(35.0 / (32.0 * math.pi)),
    math.sqrt(105.0 / (4.0 * math.pi)),
    -math.sqrt(21.0 / (32.0 * math.pi)),
    math.sqrt(7.0 / (16.0 * math.pi)),
    -math.sqrt(21.0 / (32.0 * math.pi)),
    math.sqrt(105.0 / (16.0 * math.pi)),
    -math.sqrt(35.0 / (32.0 * math.pi)),
)

MOST_LOBES = 8

LOG_LIMIT = 20.0
"""The logarithm of a lobe's sharpness is clamped to plus or minus this value; beyond, it gets no gradient."""

SHORTEST = 1e-24
"""Vectors of at most this length are treated as zero: they have no direction and pass no gradient. The limit keeps
gradients of float32 numbers finite."""
