"""A rendered frame, its statistics, and the contributions of its primitives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from neuprim.core.model.checks import check_model_tensor_shape


@dataclass
class Contributions:
    """What each of the N primitives of a frame contributed to it; zeros until the frame's backward pass fills them."""

    weight: Tensor  # (N,) sum over pixels of alpha_i T_i; positive exactly for primitives that the view shows
    error_weight: Tensor  # (N,) sum over pixels of alpha_i T_i x error
    rows: Tensor | None = None  # of the model, where some primitives were left out of the frame

    def of_all(self, count: int) -> tuple[Tensor, Tensor]:
        """Return (count,) sums of all primitives of the model, zero for those left out of the frame."""
        if self.rows is None:
            return self.weight, self.error_weight
        weight, error_weight = (
            sums.new_zeros(count).index_copy_(0, self.rows, sums) for sums in (self.weight, self.error_weight)
        )
        return weight, error_weight


def sum_contributions(frames: Sequence[Contributions], count: int) -> Contributions:
    """Return the sums over several frames of a model with ``count`` primitives, added in their order."""
    weight, error = frames[0].of_all(count)
    for contributions in frames[1:]:
        more = contributions.of_all(count)
        weight, error = weight + more[0], error + more[1]
    return Contributions(weight, error)


@dataclass
class ContributionRequest:
    """What a backend's backward pass reads and fills: sums over the rays that it drew."""

    error: Tensor  # of each ray, in the shape of the frame as the backend drew it
    result: Contributions
    rays: int = 1  # of a pixel; sums are divided by their number, so that frames of any number compare
    sums: tuple[Tensor, Tensor] | None = None

    def add(self, rows: Tensor, weight: Tensor, error_weight: Tensor) -> None:
        """Add the sums of primitives ``rows`` (R,) over some of the rays, for backends that draw in blocks."""
        if self.sums is None:
            blank = torch.zeros_like(self.result.weight, device=rows.device)
            self.sums = blank, blank.clone()
        for total, part in zip(self.sums, (weight, error_weight), strict=True):
            total.index_add_(0, rows, part.to(total))
        self.fill(*self.sums)

    def fill(self, weight: Tensor, error_weight: Tensor) -> None:
        """Set the sums (N,) over all rays."""
        n = self.rays
        weight, error_weight = (sums.to(self.result.weight.device) for sums in (weight, error_weight))
        self.result.weight, self.result.error_weight = (
            (weight, error_weight) if n == 1 else (weight / n, error_weight / n)
        )


@dataclass
class RenderStats:
    """By-products of a frame."""

    backend: str
    count: int  # primitives of the frame
    pairs: int = 0  # tile-primitive pairs (cpu, cuda) or ray-primitive pairs (reference) that were evaluated
    rows: Tensor | None = None  # of the model, where some primitives were left out of the frame
    samples: int = 1  # rays per pixel side
    drawn_on: torch.device | None = None  # where that is not the device that its tensors are on
    contributions: ContributionRequest | None = None  # see RenderOutput.request_contributions
    extra: dict[str, Any] = field(default_factory=dict)

    def request_contributions(self, error: Tensor) -> Contributions:
        """As :meth:`RenderOutput.request_contributions`, without its check of the shape."""
        n, error = self.samples, error.detach()
        blank = torch.zeros(self.count, device=error.device)
        result = Contributions(blank, blank.clone(), self.rows)
        rays = error if n == 1 else error.repeat_interleave(n, 0).repeat_interleave(n, 1)
        rays = rays if self.drawn_on is None else rays.to(self.drawn_on)
        self.contributions = ContributionRequest(rays, result, n * n)
        return result


@dataclass(frozen=True)
class RenderOutput:
    """One frame."""

    rgb: Tensor  # (H, W, C) in the model's colour space, composited over the background
    alpha: Tensor  # (H, W) accumulated opacity 1 - T
    # (H, W) weighted mean camera-z (ray distance for a RayCamera) of the chord middles, 0 where nothing is hit; None
    # unless the settings ask for it
    depth: Tensor | None
    stats: RenderStats  # see RenderStats

    def request_contributions(self, error: Tensor) -> Contributions:
        """Have the backward pass sum each primitive's part in the frame and in an error.

        Call it before ``backward()``, which fills the result. A second call replaces the first.

        Args:
            error: (H, W) any measure of what is wrong at each pixel; no gradient reaches it.
        """
        check_model_tensor_shape("request_contributions: error", error, tuple(self.alpha.shape), ", that of the frame")
        return self.stats.request_contributions(error)


def mean_depth(weighted: Tensor, alpha: Tensor) -> Tensor:
    """Return (H, W) sum of w z over sum of w, which is a ray's alpha; 0 where nothing is hit."""
    hit = alpha > 0
    if not (torch.is_grad_enabled() and (weighted.requires_grad or alpha.requires_grad)):
        return (weighted / alpha).masked_fill_(~hit, 0.0)
    return torch.where(hit, weighted / torch.where(hit, alpha, 1.0), 0.0)
