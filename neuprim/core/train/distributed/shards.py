"""One model in parts: every rank holds a block of the primitives, with their gradients, moments and statistics.

Each rank still looks at views of its own. Before a view is drawn, every rank finds which of *its* primitives the view
can show, and sends their parameters to the rank that draws it. That rank lowers, draws and goes back as with any model,
and sends the rows' gradients and statistics back, which their owners add up in the order of the views. Primitives that
were not sent have a gradient of zero in one process, too, so that the sums are the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.data import View
from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import ColourField
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.frustum import in_sight
from neuprim.core.render.output import Contributions
from neuprim.core.train.distributed.alone import Alone, Look, Seen, StepViews
from neuprim.core.train.distributed.blocks import Blocks, regrouped
from neuprim.core.train.distributed.group import Group
from neuprim.core.train.optimizer import RowAdam
from neuprim.core.train.population import Change, Population

__all__ = ["Shards", "shards_of"]

_PIECE = 1 << 22
"""Numbers of a tensor that are collected at once."""


@dataclass(frozen=True)
class _Sent:
    """What went to each rank before its view was drawn.

    Attributes:
        rows: (M,) of this rank's primitives, those for the first rank first. give: how many for each; take: how many
        came from each.
    """

    rows: Tensor
    give: list[int]
    take: list[int]


class Shards(Alone):
    """This process as one of several that have a part of the primitives each.

    Args:
        group: the ranks.
        near: depth below which nothing is drawn.

    Attributes:
        blocks: which rows of the whole model each rank has, as last asked for by :meth:`own_of`.
    """

    def __init__(self, group: Group, near: float) -> None:
        self.group, self.near = group, near
        self.rank, self.size = group.rank, group.size
        self.blocks = Blocks(0, self.size)
        self._saving: Callable[[], bool] = lambda: False
        self._save = False

    @property
    def parts(self) -> bool:
        return True

    def count(self, model: Primitives) -> int:
        return self.blocks.count

    # ------------------------------------------------------------ what a group does

    def last(self, asked: Callable[[], bool]) -> Callable[[], bool]:
        return self.group.last(asked)

    def saves(self, asked: Callable[[], bool]) -> Callable[[], bool]:
        self._saving = asked
        return lambda: self._save

    def spent(self, elapsed: float, start: float) -> float:
        return self.group.spent(elapsed, start)

    def agree(self, what: str, facts: dict[str, Any]) -> None:
        self.group.agree(what, facts)

    @contextmanager
    def in_turn(self) -> Iterator[None]:
        with self.group.in_turn():
            yield

    # ------------------------------------------------------------ a step

    def step(self, model: Primitives, views: int, elapsed: float, start: float) -> StepViews:
        return _ShardViews(self, model, elapsed, start)

    def gather(self, model: Primitives, looks: Sequence[Look | None]) -> tuple[Primitives, _Sent]:
        """The primitives that this rank's look needs, in the order of the whole model, and what was sent for all ranks'
        looks, one each."""
        device = model.device
        with torch.no_grad():
            none = torch.zeros(0, dtype=torch.int64, device=device)
            each = [none if look is None else self._needed(model, look) for look in looks]
        give = [len(rows) for rows in each]
        sent = _Sent(torch.cat(each), give, self._lengths(give))
        params = {}
        for (
            name,
            value,
        ) in model.params.items():  # one at a time: what comes is the tensor that is drawn, without another copy
            found = value.new_empty((sum(sent.take), *value.shape[1:]))
            self.group.exchange(value.detach()[sent.rows], found, give, sent.take)
            params[name] = found.requires_grad_()
        return Primitives(model.density, model.colour, params), sent

    def _needed(self, model: Primitives, look: Look) -> Tensor:
        """(M,) rows of this rank's primitives that a look may show."""
        rows = self._shown(model, look.view)
        if look.beside is None:
            return rows
        alive, _ = model.active_geometry(
            look.beside
        )  # all that live: points are anywhere, and sums over them are of all
        whole = torch.arange(model.count, device=model.device) if alive is None else alive
        return torch.cat([rows, whole]).unique()

    def _shown(self, model: Primitives, view: View) -> Tensor:
        alive, geometry = model.active_geometry(view.conditions)
        whole = torch.arange(model.count, device=model.device) if alive is None else alive
        if type(model.colour).shade is not ColourField.shade:
            return whole  # what the camera does not see may cast a shadow on what it does
        seen = in_sight(geometry, view.camera, self.near)
        return whole if seen is None else whole[seen]

    def _lengths(self, give: list[int]) -> list[int]:
        """How many rows come from each rank."""
        own = torch.tensor(give)[:, None]
        found = torch.empty_like(own)
        self.group.swap(own, found)
        return [int(n) for n in found[:, 0]]

    def judged(
        self, model: Primitives, views: Sequence[View], judge: Callable[[int, Primitives], float]
    ) -> list[float]:
        own: dict[str, float] = {}
        for start in range(0, len(views), self.size):
            looks = [Look(views[i]) if i < len(views) else None for i in range(start, start + self.size)]
            drawn, _ = self.gather(model, looks)
            if looks[self.rank] is not None:
                with torch.no_grad():
                    own[str(start + self.rank)] = judge(start + self.rank, drawn)
        every = {
            place: value for letter in self.group.tell({"judged": own}) for place, value in letter["judged"].items()
        }
        return [every[str(i)] for i in range(len(views))]

    # ------------------------------------------------------------ who has what

    def own_of(self, count: int) -> tuple[int, int]:
        if count < self.size:
            raise ConfigError(
                f"train.shard=true: {count} primitives for {self.size} ranks; expected one for each at least"
            )
        self.blocks = Blocks(count, self.size)
        return self.blocks.of(self.rank)

    def cut(self, tensors: dict[str, Tensor]) -> dict[str, Tensor]:
        """This rank's rows of tensors of the whole model."""
        mine = slice(*self.own_of(len(next(iter(tensors.values())))))
        return {name: value.detach()[mine].clone() for name, value in tensors.items()}

    def collected(self, value: Tensor) -> Iterator[Tensor]:
        """On the first rank, (N, ...) of the whole model piece by piece, of which it never holds more than one beside
        its own; nothing on the others."""
        at_once = max(_PIECE // max(value[:1].numel(), 1), 1)
        for rank in range(self.size):
            start, stop = self.blocks.of(rank)
            for first in range(0, stop - start, at_once):
                rows = min(at_once, stop - start - first)
                own = value.detach()[first : first + rows]
                if rank == 0:
                    if self.first:
                        yield own
                    continue
                give, take = [0] * self.size, [0] * self.size
                if self.rank == rank:
                    give[0] = rows
                if self.first:
                    take[rank] = rows
                found = value.new_empty((sum(take), *value.shape[1:]))
                self.group.exchange(own[: sum(give)].contiguous(), found, give, take)
                if self.first:
                    yield found

    def intervene(self, population: Population, model: Primitives, optimizer: RowAdam, extent: float) -> Change | None:
        """All ranks decide the same on everybody's statistics; rows move to whose block they are in then, with their
        moments."""
        found = population.take()
        if found is None:
            return None
        plan = population.plan(*(self._of_all(statistic) for statistic in found))
        if plan is None:
            return None
        before, self.blocks = self.blocks, Blocks(plan.count + plan.births, self.size)
        population.count = self.blocks.count
        return regrouped(self.group, plan, before, self.blocks, model, optimizer)

    def _of_all(self, value: Tensor) -> Tensor:
        """(N,) of the whole model, of (n,) numbers of each rank's block."""
        take = [stop - start for start, stop in map(self.blocks.of, range(self.size))]
        found = value.new_empty(sum(take))
        self.group.exchange(value.repeat(self.size), found, [len(value)] * self.size, take)
        return found


def shards_of(ranks: Alone, near: float) -> Shards:
    """The ranks of a group with a part of the primitives each."""
    assert isinstance(ranks, Group), "one process is refused"
    return Shards(ranks, near)


class _ShardViews(StepViews):
    """The views of a step, in rounds of a view of each rank."""

    def __init__(self, shards: Shards, model: Primitives, elapsed: float, start: float) -> None:
        super().__init__(model)
        self._shards, self._group, self._when = shards, shards.group, (elapsed, start)
        self._sums = {name: torch.zeros_like(value) for name, value in model.params.items()}
        self._tally = torch.zeros(model.count, 2, device=model.device)
        self._there = dict.fromkeys(model.params, False)
        self._drawn: Primitives | None = None
        self._sent: _Sent | None = None

    def drawn(self, looks: Callable[[], Sequence[Look]]) -> Primitives:
        self._drawn, self._sent = self._shards.gather(self.model, looks())
        return self._drawn

    def add(self, seen: Seen, tally: Contributions) -> None:
        drawn, sent = self._drawn, self._sent
        assert drawn is not None and sent is not None
        self.seen.append(seen)
        for name, value in drawn.params.items():
            gradient, value.grad = value.grad, None
            self._there[name] |= gradient is not None
            self._return(torch.zeros_like(value) if gradient is None else gradient, self._sums[name], sent)
        self._return(torch.stack(tally.of_all(drawn.count), 1), self._tally, sent)
        self._drawn = self._sent = None

    def _return(self, numbers: Tensor, sums: Tensor, sent: _Sent) -> None:
        """Send what belongs to rows back to whose they are, and add what comes, view by view."""
        found = numbers.new_empty((len(sent.rows), *numbers.shape[1:]))
        self._group.exchange(numbers.detach().contiguous(), found, sent.take, sent.give)
        for rows, part in zip(sent.rows.split(sent.give), found.split(sent.give), strict=True):
            sums.index_add_(0, rows, part)

    def close(self) -> Contributions:
        group = self._group
        letter = {
            "clock": group.time(*self._when),
            "stop": group.asked(),
            "save": self._shards._saving(),
            "there": [name for name, has in self._there.items() if has],
            "seen": [asdict(seen) for seen in self.seen],
        }
        letters = group.tell(letter)
        group.heard(letters)
        self._shards._save = bool(letters[0]["save"])
        self.seen = [
            Seen(**seen) for views in zip(*(other["seen"] for other in letters), strict=True) for seen in views
        ]
        there = {name for other in letters for name in other["there"]}
        for name, value in self.model.params.items():
            value.grad = self._sums[name] if name in there else None
        weight, error = self._tally.unbind(1)
        return Contributions(weight.contiguous(), error.contiguous())
