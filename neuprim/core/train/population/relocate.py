"""The strategy ``relocate``: as many primitives as were asked for, moved to where they are missing."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions
from neuprim.core.train.population.interface import Change, Plan, Population
from neuprim.core.train.population.splitting import carried_out
from neuprim.core.train.settings import PopulationSettings

__all__ = ["Relocate"]

_GROWTH = 0.25
"""Share of the primitives that is born at once: a split costs quality that training has to win back. It is more where
the count would else not be reached."""

_PARTS = 3
"""Of the time between ``start`` and ``stop``, at least, between which primitives are born while some are missing."""


class Relocate(Population):
    """Primitives with the least total weight move to where weight x error is largest, and as many are born there as are
    still missing.

    The busiest primitive splits in two by the exact rule, one child in its own row and one in the idle row. A split
    costs more than it brings once the idle ones are used up (children cover each other and not all of their parent):
    ``idle`` says who may move. Where there are fewer primitives than ``grow_to``, further ones split without an idle
    row, a quarter of all at a time, or as many as the interventions that are left need to reach it; budgets that are
    over before that have their interventions sooner.
    """

    plans = True

    def __init__(self, settings: PopulationSettings) -> None:
        super().__init__(settings)
        self.weight: Tensor | None = None
        self.error: Tensor | None = None
        self._left = math.inf
        self._part = 0

    def due(self, step: int, progress: float) -> bool:
        s = self.settings
        share = (s.stop - s.start) / _PARTS
        if (
            self.weight is not None
            and (self.count or len(self.weight)) < (s.grow_to or 0)
            and 0 < share * step < s.every * progress
        ):
            # a budget so short that ``every`` would leave it without its primitives, or with all of them born at once
            part = int((progress - s.start) // share)
            due, self._part = self._part < min(part, _PARTS - 1), max(part, self._part)
            self._left = max(_PARTS - 1 - part, 0)
            return due
        due = super().due(step, progress)
        if due:
            further = (
                (self.settings.stop - progress) / progress * step / self.settings.every if progress > 0 else math.inf
            )
            # the schedule ends before ``stop``, so that an intervention just then does not happen
            self._left = math.inf if math.isinf(further) else max(math.ceil(further - 1e-6) - 1, 0)
        return due

    def observe(self, model: Primitives, tally: Contributions) -> None:
        if self.weight is None or self.error is None:
            self.weight, self.error = (torch.zeros(model.count, device=model.device) for _ in range(2))
        weight, error = tally.of_all(model.count)
        self.weight += weight
        self.error += error

    def intervene(self, model: Primitives, extent: float) -> Change | None:
        found = self.take()
        plan = None if found is None else self.plan(*found)
        return None if plan is None else carried_out(plan, model)

    def take(self) -> tuple[Tensor, Tensor] | None:
        found = None if self.weight is None or self.error is None else (self.weight, self.error)
        self.weight = self.error = None
        return found

    def plan(self, weight: Tensor, error: Tensor) -> Plan | None:
        count = len(weight)
        budget = int(self.settings.fraction * count)
        missing = max((self.settings.grow_to or 0) - count, 0)
        due = math.ceil(
            count * ((1 + missing / count) ** (1 / (self._left + 1)) - 1) - 1e-9
        )  # by the same factor each time that is left
        births = min(missing, max(int(_GROWTH * count), due, 1))
        busiest = torch.argsort(error, descending=True, stable=True)
        busy = torch.zeros(count, dtype=torch.bool, device=weight.device)
        busy[busiest[:budget]] = True
        idle = torch.argsort(weight, stable=True)
        idle = idle[~busy[idle]][:budget]
        if self.settings.idle is not None:
            idle = idle[weight[idle] < self.settings.idle * weight.mean()]
        moves = min(len(idle), budget, max(count - births, 0))  # who moves does not split
        idle = idle[:moves]
        moved = torch.zeros_like(busy)
        moved[idle] = True
        busiest = busiest[~moved[busiest]]
        births = max(
            min(births, int((error[busiest] > 0).sum()) - moves), 0
        )  # what no view showed has nothing to split for
        busiest = busiest[: moves + births]
        if len(busiest) == 0:
            return None
        new = torch.arange(count, count + births, device=weight.device)
        said = [f"{what} {number}" for what, number in (("moved", moves), ("grew by", births)) if number]
        return Plan(busiest, torch.cat([idle, new]), count, births, ", ".join(said))

    def state(self) -> dict[str, Tensor]:
        found = {} if self.weight is None or self.error is None else {"weight": self.weight, "error": self.error}
        return found | ({"part": torch.tensor(self._part)} if self._part else {})

    def load_state(self, state: dict[str, Tensor]) -> None:
        self._part = int(state["part"]) if "part" in state else 0
        self.weight = state["weight"].clone() if "weight" in state else None
        self.error = state["error"].clone() if "error" in state else None
