"""Limits of lobe colours, for all kernels."""

from __future__ import annotations

MOST_LOBES = 8

LOG_LIMIT = 20.0
"""Logarithms of sharpness count as no further from 0 than this, and get no gradient beyond."""

SHORTEST = 1e-24
"""Vectors that are not longer have no direction: the unit vector is zero and passes no gradient. The limit keeps
gradients of float32 numbers finite."""
