"""The strategy ``gradient``: the authors' growth and pruning."""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.model.checks import check_tensors, method
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions
from neuprim.core.train.population.interface import Change, Population
from neuprim.core.train.population.splitting import SPLIT_GAUSSIAN, SPLIT_SHIFT, split
from neuprim.core.train.settings import PopulationSettings

__all__ = ["Gradient"]


class Gradient(Population):
    """The authors' rule on the density network's gradient, with exact splits (method: "Population").

    g = mean over views that saw the primitive of |dW1| + |db1| + |dw2| + |db2|, one view per step. g >= grow_threshold:
    clone in place, both copies at half density, if max s <= clone_scale x extent, else split in two (s/1.6).
    g < prune_threshold although seen, or max s > prune_scale x extent: prune. So is a primitive no view saw.
    """

    def __init__(self, settings: PopulationSettings) -> None:
        super().__init__(settings)
        self.total: Tensor | None = None
        self.seen: Tensor | None = None

    def observe(self, model: Primitives, tally: Contributions) -> None:
        if self.total is None or self.seen is None:
            self.total, self.seen = (torch.zeros(model.count, device=model.device) for _ in range(2))
        saw = tally.of_all(model.count)[0] > 0
        norm = torch.zeros_like(self.total)
        for name in model.of(model.density):
            grad = model.params[name].grad
            if grad is not None and grad.numel():
                norm += grad.reshape(model.count, -1).norm(dim=1)
        self.total += torch.where(saw, norm, torch.zeros_like(norm))
        self.seen += saw

    def intervene(self, model: Primitives, extent: float) -> Change | None:
        if self.total is None or self.seen is None:
            return None
        s = self.settings
        seen, mean = self.seen > 0, self.total / self.seen.clamp_min(1)
        self.total = self.seen = None
        size = model.params["log_scales"].detach().max(dim=-1).values.exp()
        prune = (seen & (mean < s.prune_threshold)) | (size > s.prune_scale * extent) | ~seen
        if bool(prune.all()):
            return None  # an all-black stretch of views must not empty the model
        grow = ((mean >= s.grow_threshold) & ~prune).nonzero()[:, 0]
        room = max(s.max_primitives - int((~prune).sum()), 0)
        if len(grow) > room:  # the growth cap keeps the most wanted ones
            grow = grow[torch.argsort(mean[grow], descending=True, stable=True)[:room]].sort().values
        small = size[grow] <= s.clone_scale * extent
        clones, splits = grow[small], grow[~small]
        keep = ~prune
        keep[splits] = False
        kept = keep.nonzero()[:, 0]

        params = {n: v.detach()[kept].clone() for n, v in model.params.items()}
        own = {k: model.params[k].detach()[clones] for k in model.of(model.density)}
        halved = model.density.scale_density(own, torch.full((len(clones),), 0.5, device=model.device))
        halved = check_tensors(halved, own, method(model.density, "scale_density"))
        copies = {**model.rows(clones), **halved}
        place = torch.full_like(prune, -1, dtype=torch.int64)
        place[kept] = torch.arange(len(kept), device=model.device)
        for name, value in halved.items():
            params[name][place[clones]] = value
        children = split(model, splits, SPLIT_SHIFT, SPLIT_GAUSSIAN, SPLIT_GAUSSIAN)
        params = {n: torch.cat([params[n], copies[n], children[n]]) for n in params}
        origin = torch.cat([kept, clones, splits, splits])
        fresh = torch.zeros_like(origin, dtype=torch.bool)
        fresh[len(kept) :] = True
        return Change(params, origin, fresh, f"cloned {len(clones)}, split {len(splits)}, pruned {int(prune.sum())}")

    def state(self) -> dict[str, Tensor]:
        if self.total is None or self.seen is None:
            return {}
        return {"total": self.total, "seen": self.seen}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.total = state["total"].clone() if "total" in state else None
        self.seen = state["seen"].clone() if "seen" in state else None
