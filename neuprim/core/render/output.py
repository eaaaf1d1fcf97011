"""What a rendered frame consists of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from torch import Tensor

__all__ = ["RenderOutput", "RenderStats"]


@dataclass
class RenderStats:
    """By-products of a frame.

    Attributes:
        backend: the backend that drew it.
        pairs: tile-primitive pairs (cpu) or ray-primitive pairs (reference) that were evaluated.
        pixel_error: set this (H, W) map after the forward pass, and the backward pass fills the two sums below.
        weight: (N,) sum over pixels of alpha_i T_i; positive exactly for primitives the view saw.
        error_weight: (N,) sum over pixels of alpha_i T_i x pixel_error.
    """

    backend: str
    pairs: int = 0
    pixel_error: Tensor | None = None
    weight: Tensor | None = None
    error_weight: Tensor | None = None
    extra: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class RenderOutput:
    """One frame.

    Attributes:
        rgb: (H, W, C) in the model's colour space, composited over the background.
        alpha: (H, W) accumulated opacity 1 - T.
        depth: (H, W) weighted mean camera-z of the chord middles, 0 where nothing is hit; None unless asked for.
        stats: see :class:`RenderStats`.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None
    stats: RenderStats
