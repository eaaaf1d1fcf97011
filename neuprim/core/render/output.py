"""What a rendered frame consists of."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

__all__ = ["RenderOutput", "RenderStats", "mean_depth"]


@dataclass
class RenderStats:
    """By-products of a frame.

    Attributes:
        backend: the backend that drew it.
        pairs: tile-primitive pairs (cpu) or ray-primitive pairs (reference) that were evaluated.
        pixel_error: set this (H, W) map after the forward pass, and the backward pass fills the two sums below.
        weight: (N,) sum over pixels of alpha_i T_i; positive exactly for primitives the view saw.
        error_weight: (N,) sum over pixels of alpha_i T_i x pixel_error.
        rows: which primitives the sums belong to where some were left out of the frame; None for all.
    """

    backend: str
    pairs: int = 0
    pixel_error: Tensor | None = None
    weight: Tensor | None = None
    error_weight: Tensor | None = None
    rows: Tensor | None = None
    extra: dict[str, Any] = field(default_factory=dict)

    def of_all(self, sums: Tensor, count: int) -> Tensor:
        """(count,) sums of all primitives of the model, zero for those that were left out of the frame."""
        return sums if self.rows is None else sums.new_zeros(count).index_copy_(0, self.rows, sums)


@dataclass(frozen=True)
class RenderOutput:
    """One frame.

    Attributes:
        rgb: (H, W, C) in the model's colour space, composited over the background.
        alpha: (H, W) accumulated opacity 1 - T.
        depth: (H, W) weighted mean camera-z (ray distance for a ``RayCamera``) of the chord middles, 0 where nothing is hit; None unless asked for.
        stats: see :class:`RenderStats`.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None
    stats: RenderStats


def mean_depth(weighted: Tensor, alpha: Tensor) -> Tensor:
    """(H, W) sum of w z over sum of w; 0 where nothing is hit. The weights of a ray telescope: their sum is its alpha."""
    hit = alpha > 0
    return torch.where(hit, weighted / torch.where(hit, alpha, torch.ones_like(alpha)), torch.zeros_like(weighted))
