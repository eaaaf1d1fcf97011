"""Directions that survive lights at a primitive's centre and at infinity."""

from __future__ import annotations

from torch import Tensor

__all__ = ["unit"]

_NEAREST = 1e-6
"""Scene units below which a vector's direction fades: its gradient, 1/length, stays below 1e6."""


def unit(vector: Tensor) -> Tensor:
    """(..., 3) unit vectors; those shorter than 1e-6 keep their share of it, so that zero stays zero. No square leaves float32's range."""
    scaled = vector / vector.detach().abs().amax(-1, keepdim=True).clamp_min(_NEAREST)
    return scaled / scaled.norm(dim=-1, keepdim=True).clamp_min(1.0)
