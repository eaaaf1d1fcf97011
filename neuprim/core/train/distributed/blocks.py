"""Which rows of a model each rank has, and how rows change hands when some are born."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor

from neuprim.core.model.primitives import Primitives
from neuprim.core.train.optimizer import RowAdam
from neuprim.core.train.population import Change, Plan, children_of

if TYPE_CHECKING:
    from neuprim.core.train.distributed.group import Group

__all__ = ["Blocks", "regrouped"]


@dataclass(frozen=True)
class Blocks:
    """``count`` rows in ``size`` blocks that follow each other and differ by one row at most, so that blocks one after
    the other are the model."""

    count: int
    size: int

    def of(self, rank: int) -> tuple[int, int]:
        """First row of a rank's block, and the one after its last."""
        return self.count * rank // self.size, self.count * (rank + 1) // self.size


def regrouped(group: Group, plan: Plan, before: Blocks, after: Blocks, model: Primitives, optimizer: RowAdam) -> Change:
    """Carry out this rank's part of a plan: it gets the rows that its new block descends from, and splits those that
    are children.

    ``optimizer`` has the moments of these rows afterwards; the change's ``origin`` leaves them where they are.
    """
    origin, fresh = plan.origin, plan.fresh
    mine, (first, stop) = before.of(group.rank), after.of(group.rank)
    asked = []  # rows of this rank's old block that each rank's new block descends from
    for rank in range(after.size):
        theirs = origin[slice(*after.of(rank))]
        asked.append(theirs[(theirs >= mine[0]) & (theirs < mine[1])] - mine[0])
    own = origin[first:stop]
    bounds = torch.tensor([before.of(rank)[1] for rank in range(before.size)], device=own.device)
    owner = torch.bucketize(own, bounds, right=True)
    place = torch.argsort(owner, stable=True)  # where what comes from each rank, by rank, is to be
    rows, give, take = (
        torch.cat(asked),
        [len(part) for part in asked],
        torch.bincount(owner, minlength=before.size).tolist(),
    )

    def moved(value: Tensor) -> Tensor:
        found = value.new_empty((stop - first, *value.shape[1:]))
        group.exchange(value.detach()[rows], found, give, take)
        result = torch.empty_like(found)
        result[place] = found
        return result

    params = {name: moved(value) for name, value in model.params.items()}
    for moments in (optimizer.m, optimizer.v):
        for name in moments:
            moments[name] = moved(moments[name])
    optimizer.age = moved(optimizer.age)

    new = fresh[first:stop].nonzero()[:, 0]
    second = torch.zeros(after.count, dtype=torch.bool, device=own.device)
    second[plan.others] = True
    second = second[first:stop][new]
    parents = Primitives(model.density, model.colour, {name: value[new] for name, value in params.items()})
    children = children_of(parents, torch.arange(len(new), device=own.device))
    for name, value in params.items():
        one, other = children[name].split(len(new)) if len(new) else (children[name], children[name])
        value[new] = torch.where(second.reshape(-1, *[1] * (value.dim() - 1)), other, one)
    return Change(params, torch.arange(stop - first, device=own.device), fresh[first:stop], plan.text)
