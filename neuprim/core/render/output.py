"""What a rendered frame consists of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from neuprim.core.model.checks import check_shape

__all__ = ["RenderOutput", "RenderStats", "Tally", "Watch", "mean_depth", "together"]


@dataclass
class Tally:
    """What each of the N primitives of a frame had a part in; zeros until the frame's backward pass fills them.

    Attributes:
        weight: (N,) sum over pixels of alpha_i T_i; positive exactly for primitives the view saw.
        error_weight: (N,) sum over pixels of alpha_i T_i x error.
        rows: which primitives of the model the sums belong to where some were left out of the frame; None for all.
    """

    weight: Tensor
    error_weight: Tensor
    rows: Tensor | None = None

    def of_all(self, count: int) -> tuple[Tensor, Tensor]:
        """(count,) weight and error_weight of all primitives of the model, zero for those that were left out of the
        frame."""
        if self.rows is None:
            return self.weight, self.error_weight
        weight, error_weight = (
            sums.new_zeros(count).index_copy_(0, self.rows, sums) for sums in (self.weight, self.error_weight)
        )
        return weight, error_weight


def together(tallies: Sequence[Tally], count: int) -> Tally:
    """The sums over several frames of a model with ``count`` primitives, one after the other, as several processes add
    them up, too."""
    weight, error = tallies[0].of_all(count)
    for tally in tallies[1:]:
        more = tally.of_all(count)
        weight, error = weight + more[0], error + more[1]
    return Tally(weight, error)


@dataclass
class Watch:
    """What a backend's backward pass looks for and fills: sums over the rays that it drew.

    Attributes:
        error: of each ray, in the shape of the frame as the backend drew it.
        rays: how many of a pixel; sums are divided by their number, so that frames of any compare.
    """

    error: Tensor
    tally: Tally
    rays: int = 1
    sums: tuple[Tensor, Tensor] | None = None

    def add(self, rows: Tensor, weight: Tensor, error_weight: Tensor) -> None:
        """Sums of some primitives ``rows`` (R,) over some of the rays, for backends that draw in blocks."""
        if self.sums is None:
            blank = torch.zeros_like(self.tally.weight, device=rows.device)
            self.sums = blank, blank.clone()
        for total, part in zip(self.sums, (weight, error_weight), strict=True):
            total.index_add_(0, rows, part.to(total))
        self.fill(*self.sums)

    def fill(self, weight: Tensor, error_weight: Tensor) -> None:
        """Sums (N,) over all rays."""
        tally, n = self.tally, self.rays
        weight, error_weight = (sums.to(tally.weight.device) for sums in (weight, error_weight))
        tally.weight, tally.error_weight = (weight, error_weight) if n == 1 else (weight / n, error_weight / n)


@dataclass
class RenderStats:
    """By-products of a frame.

    Attributes:
        backend: the backend that drew it.
        count: primitives of the frame.
        pairs: tile-primitive pairs (cpu) or ray-primitive pairs (reference) that were evaluated.
        rows: which primitives of the model they are where some were left out of the frame; None for all.
        samples: rays per pixel side.
        drawn_on: the device that it was drawn on, where that is not the one its tensors are on.
        watched: what :meth:`RenderOutput.watch` left for the backward pass.
    """

    backend: str
    count: int
    pairs: int = 0
    rows: Tensor | None = None
    samples: int = 1
    drawn_on: torch.device | None = None
    watched: Watch | None = None
    extra: dict[str, Any] = field(default_factory=dict)

    def watch(self, error: Tensor) -> Tally:
        """See :meth:`RenderOutput.watch`; ``error`` fits."""
        n, error = self.samples, error.detach()
        blank = torch.zeros(self.count, device=error.device)
        tally = Tally(blank, blank.clone(), self.rows)
        rays = error if n == 1 else error.repeat_interleave(n, 0).repeat_interleave(n, 1)
        self.watched = Watch(rays if self.drawn_on is None else rays.to(self.drawn_on), tally, n * n)
        return tally


@dataclass(frozen=True)
class RenderOutput:
    """One frame.

    Attributes:
        rgb: (H, W, C) in the model's colour space, composited over the background.
        alpha: (H, W) accumulated opacity 1 - T.
        depth: (H, W) weighted mean camera-z (ray distance for a ``RayCamera``) of the chord middles, 0 where nothing is
        hit; None unless asked for. stats: see :class:`RenderStats`.
    """

    rgb: Tensor
    alpha: Tensor
    depth: Tensor | None
    stats: RenderStats

    def watch(self, error: Tensor) -> Tally:
        """Let the backward pass tell which primitives were seen, and which had a part in an error; call it before
        ``backward()``.

        Args:
            error: (H, W) any measure of what is wrong at each pixel; constant, no gradient reaches it.

        Returns:
            the sums, which the backward pass fills. A second call takes the place of the first.

        Raises:
            FormError: ``error`` is not of the frame's size.
        """
        check_shape("watch: error", error, tuple(self.alpha.shape), ", that of the frame")
        return self.stats.watch(error)


def mean_depth(weighted: Tensor, alpha: Tensor) -> Tensor:
    """(H, W) sum of w z over sum of w; 0 where nothing is hit. The weights of a ray telescope: their sum is its
    alpha."""
    hit = alpha > 0
    if not (torch.is_grad_enabled() and (weighted.requires_grad or alpha.requires_grad)):
        return (weighted / alpha).masked_fill_(~hit, 0.0)
    return torch.where(hit, weighted / torch.where(hit, alpha, 1.0), 0.0)
