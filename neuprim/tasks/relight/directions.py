"""Directions that survive lights at a primitive's centre and at infinity."""

from __future__ import annotations

from torch import Tensor

from neuprim.core.model.geometry import Geometry

__all__ = ["least_square", "unit"]

_NEAREST = 1e-6
"""Below this length, in units of ``size``, a vector's direction fades: its gradient, 1/length, stays below 1e6 per
size."""
_LEAST = 1e-4
"""Of a primitive's size: a light that is nearer to its centre does not get stronger."""


def unit(vector: Tensor, size: Tensor | float = 1.0) -> Tensor:
    """(..., 3) unit vectors; those shorter than 1e-6 of ``size`` keep their share of it, so that zero stays zero.

    No square leaves float32's range.

    Args:
        size: (..., 1) the length that counts as one, e.g. of the primitive that the vector begins at.
    """
    scaled = vector / vector.detach().abs().amax(-1, keepdim=True).clamp_min(_NEAREST * size)
    return scaled / scaled.norm(dim=-1, keepdim=True).clamp_min(1.0)


def least_square(geometry: Geometry) -> Tensor:
    """(N, 1) the least squared distance to a light that falloff knows."""
    return (_LEAST * geometry.length_scale.detach()[:, None]).square()
