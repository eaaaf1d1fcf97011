"""Gradients and statistics of a model as one flat buffer, and their sums over views, in the order of the views.

Floating-point sums depend on their order. A ring or a tree would add the views of a step in an order of its own; here
every rank owns a slice of the buffer, gets that slice of every view, adds it up view by view as one process does, and
hands the sum to the others. It sends as many bytes as a ring.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from neuprim.core.render.output import Contributions

__all__ = ["Bucket", "Pair", "Swap"]

Swap = Callable[[Tensor, Tensor], None]
"""((R, n) rows, one for each rank; (R, n) for what comes, one from each), of one dtype and device."""

_ALIGNED = 16
"""Numbers that every tensor's place is a multiple of: 64 bytes, what vectors of the processor and of a card take at
once."""


def _padded(numbers: int) -> int:
    return -(-numbers // _ALIGNED) * _ALIGNED


class Bucket:
    """The buffer of a model with these parameters. All memory is taken once: new pages cost as much as sending them.

    Args:
        params: name -> (N, ...) float32.
        ranks: how many share the work.
        letter: bytes that go with the sums from each rank to each, a multiple of 4.

    Attributes:
        width: numbers of a slice; :meth:`add` sends ``ranks - 1`` slices, and so does :meth:`spread`, with as many
        letters.
    """

    def __init__(self, params: Mapping[str, Tensor], ranks: int, letter: int) -> None:
        self.shapes = {name: value.shape for name, value in params.items()}
        like = next(iter(params.values()))
        count = like.shape[0]
        self._places: dict[str, tuple[int, int]] = {}
        at = 0
        for name, numbers in (
            *((name, value.numel()) for name, value in params.items()),
            (_WEIGHT, count),
            (_ERROR, count),
        ):
            self._places[name] = at, numbers
            at += _padded(numbers)
        self.width, self.letter = _padded(-(-at // ranks)), letter
        self._begun = False
        self._make(ranks, like.device)

    def _make(self, ranks: int, device: torch.device) -> None:
        """Take the memory; ``_flat`` is the buffer."""
        self._flat, self._got = (torch.zeros(ranks, self.width, device=device) for _ in range(2))
        self._sum = torch.zeros(self.width, device=device)
        self._sums, self._all = (torch.zeros(ranks, self.width + self.letter // 4, device=device) for _ in range(2))

    def fits(self, params: Mapping[str, Tensor], letter: int) -> bool:
        """Whether it is of parameters like these, and of such letters."""
        return self.letter == letter and self.shapes == {name: value.shape for name, value in params.items()}

    def _part(self, name: str) -> Tensor:
        start, numbers = self._places[name]
        return self._flat.reshape(-1)[start : start + numbers]

    def take(self, params: Mapping[str, Tensor], tally: Contributions) -> list[bool]:
        """Fill it with a view's gradients, which the parameters lose, and its tally; of each parameter, whether there
        was a gradient."""
        there = []
        for name, value in params.items():
            part, grad = self._part(name), value.grad
            there.append(grad is not None)
            if grad is None:
                part.zero_()
            else:
                part.view(grad.shape).copy_(grad)
            value.grad = None
        weight, error = tally.of_all(next(iter(params.values())).shape[0])
        self._part(_WEIGHT).copy_(weight)
        self._part(_ERROR).copy_(error)
        return there

    def add(self, swap: Swap) -> None:
        """Add what every rank filled it with, by rank, to this rank's slice of the sum."""
        swap(self._flat, self._got)
        for row in self._got:
            if self._begun:
                self._sum += row
            else:
                self._sum.copy_(row)
                self._begun = True

    def spread(self, swap: Swap, letter: bytes) -> list[bytes]:
        """Bring the slices together, and to every rank a letter of every rank, which are returned; the next :meth:`add`
        begins a new sum."""
        assert self._begun and len(letter) == self.letter
        self._begun = False
        self._sums[:, : self.width] = self._sum
        self._sums[:, self.width :] = torch.frombuffer(bytearray(letter), dtype=torch.float32).to(self._sums.device)
        swap(self._sums, self._all)
        self._flat.copy_(self._all[:, : self.width])
        return [part.numpy().tobytes() for part in self._all[:, self.width :].cpu()]

    def give(self, params: Mapping[str, Tensor], there: Sequence[bool]) -> Contributions:
        """Hand the sums out: gradients to the parameters that have one, and the tally that is returned; good until the
        next :meth:`take`."""
        for (name, value), has in zip(params.items(), there, strict=True):
            if has:
                value.grad = self._part(name).view(value.shape)
        return Contributions(self._part(_WEIGHT), self._part(_ERROR))


class Pair(Bucket):
    """The buffer of two ranks that look at one view each. A sum of two has no order, so both send all and add it up
    themselves: as many bytes as by slices, and one exchange less to wait for.

    Args:
        rank: this one, 0 or 1.
    """

    def __init__(self, params: Mapping[str, Tensor], rank: int, letter: int) -> None:
        self._other = 1 - rank
        super().__init__(params, 2, letter)

    def _make(self, ranks: int, device: torch.device) -> None:
        numbers = 2 * self.width
        # the row that goes to oneself is never looked at
        self._rows, self._found = (torch.zeros(2, numbers + self.letter // 4, device=device) for _ in range(2))
        self._flat, self._rest = self._rows[self._other, :numbers], self._rows[self._other, numbers:]

    def add(self, swap: Swap) -> None:
        """There is but one view, which goes with the letter."""

    def spread(self, swap: Swap, letter: bytes) -> list[bytes]:
        self._rest.copy_(torch.frombuffer(bytearray(letter), dtype=torch.float32))
        swap(self._rows, self._found)
        came = self._found[self._other]
        self._flat += came[: len(self._flat)]
        letters = [letter, came[len(self._flat) :].cpu().numpy().tobytes()]
        return letters if self._other else letters[::-1]


_WEIGHT, _ERROR = "weight of the tally", "error of the tally"
