"""The strategy ``relocate``: as many primitives as at the start, moved to where they are missing."""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Tally
from neuprim.core.train.population.interface import Change, Population
from neuprim.core.train.population.splitting import SPLIT_LONG, SPLIT_OTHERS, SPLIT_SHIFT, split
from neuprim.core.train.settings import PopulationSettings

__all__ = ["Relocate"]


class Relocate(Population):
    """Constant count: primitives with the least total weight move to where weight x error is largest.

    The busiest primitive splits in two by the exact rule, one child in its own row and one in the idle row. A split costs more than it
    brings once the idle ones are used up (children cover each other and not all of their parent): ``idle`` says who may move.
    """

    def __init__(self, settings: PopulationSettings) -> None:
        super().__init__(settings)
        self.weight: Tensor | None = None
        self.error: Tensor | None = None

    def observe(self, model: Primitives, tally: Tally) -> None:
        if self.weight is None or self.error is None:
            self.weight, self.error = (torch.zeros(model.count, device=model.device) for _ in range(2))
        weight, error = tally.of_all(model.count)
        self.weight += weight
        self.error += error

    def intervene(self, model: Primitives, extent: float) -> Change | None:
        if self.weight is None or self.error is None:
            return None
        weight, error = self.weight, self.error
        self.weight = self.error = None
        count = model.count
        budget = int(self.settings.fraction * count)
        busiest = torch.argsort(error, descending=True, stable=True)[:budget]
        busy = torch.zeros(count, dtype=torch.bool, device=model.device)
        busy[busiest] = True
        idle = torch.argsort(weight, stable=True)
        idle = idle[~busy[idle]][:budget]
        if self.settings.idle is not None:
            idle = idle[weight[idle] < self.settings.idle * weight.mean()]
        moves = min(len(idle), len(busiest))
        if moves == 0:
            return None
        idle, busiest = idle[:moves], busiest[:moves]
        children = split(model, busiest, SPLIT_SHIFT, SPLIT_LONG, SPLIT_OTHERS)
        params = {n: v.detach().clone() for n, v in model.params.items()}
        target = torch.cat([busiest, idle])
        for name, value in params.items():
            value[target] = children[name]
        origin = torch.arange(count, device=model.device)
        origin[idle] = busiest
        fresh = torch.zeros(count, dtype=torch.bool, device=model.device)
        fresh[target] = True
        return Change(params, origin, fresh, f"moved {moves}")

    def state(self) -> dict[str, Tensor]:
        return {} if self.weight is None or self.error is None else {"weight": self.weight, "error": self.error}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.weight = state["weight"].clone() if "weight" in state else None
        self.error = state["error"].clone() if "error" in state else None
