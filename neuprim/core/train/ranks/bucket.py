"""Gradients and statistics of a model as one flat buffer, and their sums over views, in the order of the views.

Floating-point sums depend on their order. A ring or a tree would add the views of a step in an order of its own; here every rank owns a slice of the
buffer, gets that slice of every view, adds it up view by view as one process does, and hands the sum to the others. It sends as many bytes as a ring.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import torch
from torch import Tensor

from neuprim.core.render.output import Tally

__all__ = ["Bucket", "Swap"]

Swap = Callable[[Tensor], Tensor]
"""(R, n) rows, one for each rank -> (R, n) rows, one from each rank."""

_ALIGNED = 16
"""Numbers that every tensor's place is a multiple of: 64 bytes, what vectors of the processor and of a card take at once."""


def _padded(numbers: int) -> int:
    return -(-numbers // _ALIGNED) * _ALIGNED


class Bucket:
    """The buffer of a model with these parameters.

    Args:
        params: name -> (N, ...) float32.
        ranks: how many share the work.

    Attributes:
        width: numbers of a slice; a view's exchange sends ``ranks - 1`` slices, and so does :meth:`spread`.
    """

    def __init__(self, params: Mapping[str, Tensor], ranks: int) -> None:
        self.shapes = {name: value.shape for name, value in params.items()}
        like = next(iter(params.values()))
        count = like.shape[0]
        self._places: dict[str, tuple[int, int]] = {}
        at = 0
        for name, numbers in (*((name, value.numel()) for name, value in params.items()), ("", count), (" ", count)):
            self._places[name] = at, numbers
            at += _padded(numbers)
        self.width = _padded(-(-at // ranks))
        self._flat = torch.zeros(ranks * self.width, device=like.device)
        self._ranks = ranks
        self._sum: Tensor | None = None

    def fits(self, params: Mapping[str, Tensor]) -> bool:
        """Whether it is of parameters like these."""
        return self.shapes == {name: value.shape for name, value in params.items()}

    def _part(self, name: str) -> Tensor:
        start, numbers = self._places[name]
        return self._flat[start : start + numbers]

    def take(self, params: Mapping[str, Tensor], tally: Tally) -> list[bool]:
        """Fill it with a view's gradients, which the parameters lose, and its tally; of each parameter, whether there was a gradient."""
        there = []
        for name, value in params.items():
            part, grad = self._part(name), value.grad
            there.append(grad is not None)
            part.zero_() if grad is None else part.copy_(grad.reshape(-1))
            value.grad = None
        weight, error = tally.of_all(next(iter(params.values())).shape[0])
        self._part("").copy_(weight)
        self._part(" ").copy_(error)
        return there

    def add(self, swap: Swap) -> None:
        """Add what every rank filled it with, by rank, to this rank's slice of the sum."""
        for row in swap(self._flat.view(self._ranks, self.width)):
            if self._sum is None:
                self._sum = row.clone()
            else:
                self._sum += row

    def spread(self, swap: Swap) -> None:
        """Bring the slices together; the next :meth:`add` begins a new sum."""
        assert self._sum is not None, "nothing was added"
        self._flat = swap(self._sum.expand(self._ranks, self.width)).reshape(-1)
        self._sum = None

    def give(self, params: Mapping[str, Tensor], there: Mapping[str, bool]) -> Tally:
        """Hand the sums out: gradients to the parameters that have one, and the tally that is returned."""
        for name, value in params.items():
            if there[name]:
                value.grad = self._part(name).view(value.shape)
        return Tally(self._part(""), self._part(" "))
