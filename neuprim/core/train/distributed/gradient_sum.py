"""Sum gradients and contributions over the views of all ranks, in the order of the views.

Floating-point sums depend on their order, and an all-reduce adds in an order of its own. Here every rank owns a slice
of a flat buffer, receives that slice of every view, adds the views one after the other as one process does, and sends
the sum to the others. This moves as many bytes as a ring all-reduce.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from neuprim.core.render.output import Contributions

if TYPE_CHECKING:
    from neuprim.core.train.distributed.process_group import ProcessGroup


_ALIGNMENT = 16
"""Numbers; tensors start at multiples of 64 bytes, which vector units read at once."""


def _pad(numbers: int) -> int:
    return -(-numbers // _ALIGNMENT) * _ALIGNMENT


class GradientSum:
    """The buffers for a model with these parameters. They are reused: new memory pages cost as much as sending them.

    Args:
        params: name -> (N, ...) float32.
        group: the ranks.
    """

    def __init__(self, params: Mapping[str, Tensor], group: ProcessGroup) -> None:
        self.group = group
        self.shapes = {name: value.shape for name, value in params.items()}
        first = next(iter(params.values()))
        self._count = first.shape[0]
        sizes = [*(value.numel() for value in params.values()), self._count, self._count]
        width = _pad(-(-sum(map(_pad, sizes)) // group.size))
        self._buffer, self._received = (torch.zeros(group.size, width, device=first.device) for _ in range(2))
        self._sum = torch.zeros(width, device=first.device)
        self._empty = True
        flat, start, parts = self._buffer.reshape(-1), 0, []
        for size in sizes:
            parts.append(flat[start : start + size])
            start += _pad(size)
        *self._gradients, self._weight, self._error = parts

    def fits(self, params: Mapping[str, Tensor]) -> bool:
        """Whether it was made for parameters of these shapes."""
        return self.shapes == {name: value.shape for name, value in params.items()}

    def add(self, params: Mapping[str, Tensor], tally: Contributions) -> list[bool]:
        """Add one view of every rank, in the order of the ranks. The parameters lose their gradients; returns which of
        them had one."""
        present = []
        for value, part in zip(params.values(), self._gradients, strict=True):
            present.append(value.grad is not None)
            if value.grad is None:
                part.zero_()
            else:
                part.view(value.shape).copy_(value.grad)
            value.grad = None
        weight, error = tally.of_all(self._count)
        self._weight.copy_(weight)
        self._error.copy_(error)
        self.group.exchange(self._buffer, self._received)
        for row in self._received:
            if self._empty:
                self._sum.copy_(row)
                self._empty = False
            else:
                self._sum += row
        return present

    def finish(self, params: Mapping[str, Tensor], present: Sequence[bool]) -> Contributions:
        """Give the sums to the parameters that have a gradient, and return the summed contributions; both are valid
        until the next :meth:`add`, which starts a new sum."""
        self._empty = True
        self.group.all_gather(self._buffer, self._sum)
        for value, part, has_gradient in zip(params.values(), self._gradients, present, strict=True):
            if has_gradient:
                value.grad = part.view(value.shape)
        return Contributions(self._weight, self._error)
