"""Population control: strategies that add, move and remove primitives (ellipsoids with a density) during a training.

A split replaces a primitive by two smaller ones, its children. With a hard edge, a child has exactly its parent's
density inside its own ellipsoid. With a soft edge, the density changes slightly.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.errors import ConfigError
from neuprim.core.model.checks import check_primitive_tensors, model_method_label
from neuprim.core.model.geometry import Geometry, quaternion_to_matrix
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions
from neuprim.core.train.settings import PopulationSettings

SPLIT_SHIFT, SPLIT_LONG, SPLIT_OTHERS = 0.5, 0.6, 0.9
"""Shape of a child relative to its parent: distance of the centres over the parent's longest semi-axis, factor on that
semi-axis, factor on the other two semi-axes.

A child has its parent's density only inside its own ellipsoid. Density outside of both children is lost; density inside
both children counts twice. With these numbers, the children cover 78 % of the parent and overlap in 2 %. Five other
shapes trained no better."""

SPLIT_GAUSSIAN = 1 / 1.6
"""Factor on all semi-axes of a child in :class:`GradientPopulation`. The authors of the method use this factor, which
follows 3D Gaussian splatting (Kerbl et al. 2023): the inverse of 0.8 times the number of children. Such children cover
45 % of their parent."""

_GROWTH = 0.25
"""Share of the primitives that one intervention (change of the population) adds. The share is small, because each
split lowers the quality until training recovers it. An intervention adds more primitives if their number would
otherwise not reach ``grow_to``."""

_MIN_GROWTHS = 3
"""Number of equal parts of the time from ``start`` to ``stop``. :class:`RelocatePopulation` adds primitives at least at
the boundaries between the parts, even if a part is shorter than ``every`` steps."""


def split_population(
    model: Primitives, parents: Tensor, shift: float, long_factor: float, other_factor: float
) -> dict[str, Tensor]:
    """Split each of P parent primitives in two; return the parameters of the children, name -> (2 P, ...).

    The first children of all parents come first, then all second children. Each child continues its parent's density
    (exactly with a hard edge) and colour. The children's centres lie on the parent's longest axis, at a distance of
    ``shift`` x the longest semi-axis from the parent's centre, on opposite sides. The longest semi-axis is multiplied
    by ``long_factor``, the other two semi-axes by ``other_factor``.

    Args:
        parents: (P,) indices of the parents in ``model``.

    Raises:
        FormError: ``on_split`` of the density or colour field returned tensors of other shapes.
    """
    rows = torch.cat([parents, parents])
    old = {n: v.detach()[rows].clone() for n, v in model.params.items()}
    before = Geometry(old["means"], old["log_scales"], old["quats"])
    axis = before.log_scales.argmax(dim=-1)
    longest = torch.nn.functional.one_hot(axis, 3).to(before.means)
    sign = torch.cat([torch.ones(len(parents), 1), -torch.ones(len(parents), 1)]).to(before.means)
    direction = (quaternion_to_matrix(before.quats) * longest[:, None, :]).sum(-1)
    reach = (before.scales * longest).sum(-1, keepdim=True)
    shrink = torch.where(longest > 0, torch.full_like(longest, long_factor), torch.full_like(longest, other_factor))
    after = Geometry(before.means + sign * shift * reach * direction, before.log_scales + shrink.log(), before.quats)
    own, own_colour = ({k: old[k] for k in model.of(field)} for field in (model.density, model.colour))
    density = check_primitive_tensors(
        model.density.on_split(own, before, after), own, model_method_label(model.density, "on_split")
    )
    colour = check_primitive_tensors(
        model.colour.on_split(own_colour, before, after), own_colour, model_method_label(model.colour, "on_split")
    )
    return {**old, "means": after.means, "log_scales": after.log_scales, **density, **colour}


@dataclass(frozen=True)
class PopulationChange:
    """Result of an intervention: N new primitives, and for each new primitive the old primitive it comes from.

    Attributes:
        params: parameter name -> (N, ...) values.
        origin: (N,) index of the old primitive from which each new one comes.
        fresh: (N,) bool, True for primitives that start with zero Adam moments.
        text: what changed, for logs.
    """

    params: dict[str, Tensor]
    origin: Tensor
    fresh: Tensor
    text: str


class Population(ABC):
    """Base class of population control strategies, which add, move and remove primitives during a training.

    A strategy collects statistics in every step (:meth:`observe`), and changes the primitives after the steps that
    :meth:`due` selects (:meth:`intervene`).
    """

    def __init__(self, settings: PopulationSettings) -> None:
        self.settings = settings

    def due(self, step: int, progress: float) -> bool:
        """Return whether :meth:`intervene` runs after this step; ``progress`` is the used fraction of the budget."""
        s = self.settings
        return s.start <= progress < s.stop and step % s.every == 0

    @abstractmethod
    def observe(self, model: Primitives, contributions: Contributions) -> None:
        """Add one step to the statistics. Call this method after the backward passes, before ``.grad`` is cleared."""

    def sums(self) -> tuple[Tensor | None, ...]:
        """Return the tensors in which :meth:`observe` sums statistics; None for each tensor that does not exist yet."""
        return ()

    @abstractmethod
    def intervene(self, model: Primitives, extent: float) -> PopulationChange | None:
        """Return the new primitives, or None for no change, and reset the statistics.

        ``extent`` is the extent of the scene, in scene units.
        """

    def state(self) -> dict[str, Tensor]:
        """Return the strategy's statistics as tensors, for a checkpoint."""
        return {}

    def load_state(self, state: dict[str, Tensor]) -> None:  # noqa: B027 - a strategy without statistics has none
        """Restore the result of :meth:`state`."""


class FixedPopulation(Population):
    """Strategy that adds, moves and removes no primitive."""

    def observe(self, model: Primitives, contributions: Contributions) -> None:
        pass

    def intervene(self, model: Primitives, extent: float) -> PopulationChange | None:
        return None


class RelocatePopulation(Population):
    """Strategy that moves primitives of little weight to where the error is largest, and adds primitives.

    A primitive's weight is the sum over pixels of alpha T, the primitive's share of the pixel. A primitive's error is
    the same sum, with each term multiplied by the pixel's error. The primitives with the largest errors split in two.
    One child replaces its parent, the other child replaces a primitive with little weight. If the setting ``idle`` is
    given, only primitives with a weight below ``idle`` x the mean weight are replaced. While there are fewer than
    ``grow_to`` primitives, further primitives split, and their second children are added. An intervention adds a
    quarter of all primitives, or more if the remaining interventions would not reach ``grow_to``. If the budget is too
    short for ``every``, interventions are more frequent.
    """

    def __init__(self, settings: PopulationSettings) -> None:
        super().__init__(settings)
        self.weight: Tensor | None = None
        self.error: Tensor | None = None
        self._remaining = math.inf
        self._part = 0

    def due(self, step: int, progress: float) -> bool:
        s = self.settings
        share = (s.stop - s.start) / _MIN_GROWTHS
        if self.weight is not None and len(self.weight) < (s.grow_to or 0) and 0 < share * step < s.every * progress:
            # a budget so short that ``every`` would leave it without its primitives, or with all of them born at once
            part = int((progress - s.start) // share)
            due, self._part = self._part < min(part, _MIN_GROWTHS - 1), max(part, self._part)
            self._remaining = max(_MIN_GROWTHS - 1 - part, 0)
            return due
        due = super().due(step, progress)
        if due:
            further = (s.stop - progress) / progress * step / s.every if progress > 0 else math.inf
            # the schedule ends before ``stop``, so an intervention exactly there does not happen
            self._remaining = math.inf if math.isinf(further) else max(math.ceil(further - 1e-6) - 1, 0)
        return due

    def observe(self, model: Primitives, contributions: Contributions) -> None:
        if self.weight is None or self.error is None:
            self.weight, self.error = (torch.zeros(model.count, device=model.device) for _ in range(2))
        weight, error = contributions.of_all(model.count)
        self.weight += weight
        self.error += error

    def sums(self) -> tuple[Tensor | None, ...]:
        return self.weight, self.error

    def intervene(self, model: Primitives, extent: float) -> PopulationChange | None:
        if self.weight is None or self.error is None or not bool(self.weight.any()):
            return None
        weight, error = self.weight.clone(), self.error.clone()
        self.weight.zero_()
        self.error.zero_()
        count = len(weight)
        budget = int(self.settings.fraction * count)
        births = self._count_births(count)
        busiest = torch.argsort(error, descending=True, stable=True)
        busy = torch.zeros(count, dtype=torch.bool, device=weight.device)
        busy[busiest[:budget]] = True
        idle = torch.argsort(weight, stable=True)
        idle = idle[~busy[idle]][:budget]
        if self.settings.idle is not None:
            idle = idle[weight[idle] < self.settings.idle * weight.mean()]
        moves = min(len(idle), budget, max(count - births, 0))  # a primitive that moves does not split
        idle = idle[:moves]
        moved = torch.zeros_like(busy)
        moved[idle] = True
        busiest = busiest[~moved[busiest]]
        # a primitive that no view showed has no error and no reason to split
        births = max(min(births, int((error[busiest] > 0).sum()) - moves), 0)
        parents = busiest[: moves + births]
        if len(parents) == 0:
            return None
        if births:
            self.weight = self.error = None
        new = torch.arange(count, count + births, device=weight.device)
        text = ", ".join(f"{what} {number}" for what, number in (("moved", moves), ("grew by", births)) if number)
        return _split_population_into_rows(model, parents, torch.cat([idle, new]), births, text)

    def _count_births(self, count: int) -> int:
        """Return how many primitives to add: a quarter of ``count``, or more if needed to reach ``grow_to``.

        In the second case, each remaining intervention multiplies the number of primitives by the same factor. The
        result is at most the number that is missing.
        """
        missing = max((self.settings.grow_to or 0) - count, 0)
        due = math.ceil(count * ((1 + missing / count) ** (1 / (self._remaining + 1)) - 1) - 1e-9)
        return min(missing, max(int(_GROWTH * count), due, 1))

    def state(self) -> dict[str, Tensor]:
        found = {}
        if self.weight is not None and self.error is not None and bool(self.weight.any()):
            found = {"weight": self.weight, "error": self.error}
        return found | ({"part": torch.tensor(self._part)} if self._part else {})

    def load_state(self, state: dict[str, Tensor]) -> None:
        self._part = int(state["part"]) if "part" in state else 0
        self.weight = state["weight"].clone() if "weight" in state else None
        self.error = state["error"].clone() if "error" in state else None


def _split_population_into_rows(
    model: Primitives, parents: Tensor, others: Tensor, births: int, text: str
) -> PopulationChange:
    """Return the change that splits each of the primitives ``parents`` (P,) into two children.

    The first child takes the row (index) of its parent. The second child takes a row from ``others`` (P,), and
    replaces the primitive in that row. The last ``births`` rows in ``others`` are new, so their children replace
    nothing. ``text`` describes the change, for logs.
    """
    children = split_population(model, parents, SPLIT_SHIFT, SPLIT_LONG, SPLIT_OTHERS)
    rows = torch.cat([parents, others])
    origin = torch.arange(model.count + births, device=parents.device)
    origin[others] = parents
    fresh = torch.zeros(model.count + births, dtype=torch.bool, device=parents.device)
    fresh[rows] = True
    params = {}
    for name, value in model.params.items():
        params[name] = value.detach()[origin]
        params[name][rows] = children[name]
    return PopulationChange(params, origin, fresh, text)


class GradientPopulation(Population):
    """Strategy of the authors of the method: clone, split and remove primitives by the gradient of the density network.

    A primitive's g is the gradient norm of its density parameters, |dW1| + |db1| + |dw2| + |db2|, as a mean over the
    steps whose views show the primitive. A primitive with g >= grow_threshold is cloned if its longest semi-axis is <=
    clone_scale x the scene's extent. Both copies stay in place and have half the density. A larger primitive with g >=
    grow_threshold is split in two, with semi-axes / 1.6 (:func:`split_population`). A primitive is removed if g <
    prune_threshold, if its longest semi-axis is > prune_scale x the scene's extent, or if no view shows the primitive.
    """

    def __init__(self, settings: PopulationSettings) -> None:
        super().__init__(settings)
        self.total: Tensor | None = None
        self.seen: Tensor | None = None

    def observe(self, model: Primitives, contributions: Contributions) -> None:
        if self.total is None or self.seen is None:
            self.total, self.seen = (torch.zeros(model.count, device=model.device) for _ in range(2))
        saw = contributions.of_all(model.count)[0] > 0
        norm = torch.zeros_like(self.total)
        for name in model.of(model.density):
            grad = model.params[name].grad
            if grad is not None and grad.numel():
                norm += grad.reshape(model.count, -1).norm(dim=1)
        self.total += torch.where(saw, norm, torch.zeros_like(norm))
        self.seen += saw

    def sums(self) -> tuple[Tensor | None, ...]:
        return self.total, self.seen

    def intervene(self, model: Primitives, extent: float) -> PopulationChange | None:
        if self.total is None or self.seen is None:
            return None
        s = self.settings
        seen, mean = self.seen > 0, self.total / self.seen.clamp_min(1)
        self.total = self.seen = None
        size = model.params["log_scales"].detach().max(dim=-1).values.exp()
        prune = (seen & (mean < s.prune_threshold)) | (size > s.prune_scale * extent) | ~seen
        if bool(prune.all()):
            return None  # a run of black views must not empty the model
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
        halved = check_primitive_tensors(halved, own, model_method_label(model.density, "scale_density"))
        copies = {**model.rows(clones), **halved}
        position = torch.full_like(prune, -1, dtype=torch.int64)
        position[kept] = torch.arange(len(kept), device=model.device)
        for name, value in halved.items():
            params[name][position[clones]] = value
        children = split_population(model, splits, SPLIT_SHIFT, SPLIT_GAUSSIAN, SPLIT_GAUSSIAN)
        params = {n: torch.cat([params[n], copies[n], children[n]]) for n in params}
        origin = torch.cat([kept, clones, splits, splits])
        fresh = torch.zeros_like(origin, dtype=torch.bool)
        fresh[len(kept) :] = True
        return PopulationChange(
            params, origin, fresh, f"cloned {len(clones)}, split {len(splits)}, pruned {int(prune.sum())}"
        )

    def state(self) -> dict[str, Tensor]:
        if self.total is None or self.seen is None:
            return {}
        return {"total": self.total, "seen": self.seen}

    def load_state(self, state: dict[str, Tensor]) -> None:
        self.total = state["total"].clone() if "total" in state else None
        self.seen = state["seen"].clone() if "seen" in state else None


STRATEGIES: dict[str, type[Population]] = {
    "fixed": FixedPopulation,
    "relocate": RelocatePopulation,
    "gradient": GradientPopulation,
}
"""Value of ``train.population.strategy`` -> class of the strategy."""


def check_strategy(name: object) -> None:
    """Raise ConfigError unless ``name`` is a valid value of ``train.population.strategy``."""
    if name not in STRATEGIES:
        *others, last = STRATEGIES
        raise ConfigError(f"train.population.strategy={name!r}: expected {', '.join(others)} or {last}")


def make_population(settings: PopulationSettings) -> Population:
    """Create the population control strategy that the settings name.

    Raises:
        ConfigError: no strategy has this name.
    """
    check_strategy(settings.strategy)
    return STRATEGIES[settings.strategy](settings)
