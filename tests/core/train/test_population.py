"""Birth, movement and death of primitives."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core.errors import ConfigError, FormError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions
from neuprim.core.train.population import (
    SPLIT_GAUSSIAN,
    SPLIT_LONG,
    SPLIT_OTHERS,
    SPLIT_SHIFT,
    FixedPopulation,
    GradientPopulation,
    RelocatePopulation,
    make_population,
    split_population,
)
from neuprim.core.train.settings import PopulationSettings
from neuprim.tasks.static import SphericalHarmonics
from tests import scenes

COUNT = 20
DENSITY = ("W1", "b1", "w2", "b2")


def model(count: int = COUNT, neurons: int = 4) -> Primitives:
    t = scenes.tensors(count, neurons, seed=3, dtype=torch.float64)
    params = {k: v.requires_grad_() for k, v in t.items() if k != "colors"}
    return Primitives(CosineDensity(neurons), SphericalHarmonics(0), {**params, "sh_dc": t["colors"].requires_grad_()})


def stats(weight: Tensor, error: Tensor | None = None) -> Contributions:
    return Contributions(weight, weight if error is None else error)


def give_grads(m: Primitives, size: Tensor) -> None:
    """Density gradients whose norms sum to ``size`` (N,)."""
    for name in DENSITY:
        value = m.params[name]
        value.grad = torch.zeros_like(value)
        if value.numel():
            value.grad.view(m.count, -1)[:, 0] = size.double() / sum(m.params[n].numel() > 0 for n in DENSITY)


def sigma(params: dict[str, Tensor], neurons: int, rows: Tensor, x: Tensor) -> Tensor:
    g = Geometry(params["means"], params["log_scales"], params["quats"])
    return CosineDensity(neurons).density({k: params[k] for k in DENSITY}, g, rows, x, {}).detach()


def points_inside(params: dict[str, Tensor], rows: Tensor, each: int = 8) -> tuple[Tensor, Tensor]:
    g = Geometry(params["means"].detach(), params["log_scales"].detach(), params["quats"].detach())
    many = rows.repeat_interleave(each)
    u = torch.randn(len(many), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    u = 0.9 * u / u.norm(dim=1, keepdim=True)
    return many, g.means[many] + (g.rotations[many] @ (g.scales[many] * u)[:, :, None])[..., 0]


def relocate(  # type: ignore[no-untyped-def]
    m: Primitives,
    weight: Tensor,
    error: Tensor,
    fraction: float = 0.25,
    idle: float | None = None,
    grow_to: int | None = None,
):
    population = RelocatePopulation(PopulationSettings(fraction=fraction, idle=idle, grow_to=grow_to))
    population.observe(m, stats(weight, error))
    return population.intervene(m, 1.0)


@pytest.mark.parametrize(
    ("factors", "covered", "twice", "volume"),
    [((SPLIT_LONG, SPLIT_OTHERS), 0.78, 0.02, 0.97), ((SPLIT_GAUSSIAN, SPLIT_GAUSSIAN), 0.45, 0.01, 0.49)],
)
def test_children_cover_what_is_said_of_them(
    factors: tuple[float, float], covered: float, twice: float, volume: float
) -> None:
    """Shares of the parent's volume: in a child, in both, and of the children's own volumes together."""
    m = model(4)
    children = split_population(m, torch.arange(4), SPLIT_SHIFT, *factors)
    g = Geometry(children["means"], children["log_scales"], children["quats"])
    ball = 2 * torch.rand(200_000, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 1
    ball = ball[ball.norm(dim=1) < 1]
    for n in range(4):
        parent = m.geometry[torch.tensor([n])]
        x = (parent.means + (ball * parent.scales) @ parent.rotations[0].T).detach()
        inside = [(((x - g.means[i]) @ g.rotations[i]) / g.scales[i]).norm(dim=1) < 1 for i in (n, n + 4)]
        assert float((inside[0] | inside[1]).double().mean()) == pytest.approx(covered, abs=0.01)
        assert float((inside[0] & inside[1]).double().mean()) == pytest.approx(twice, abs=0.01)
    share = g.scales.prod(1).reshape(2, 4).sum(0) / m.geometry.scales.prod(1)
    assert share.tolist() == pytest.approx([volume] * 4, abs=0.01)


def test_relocation_moves_the_idle_to_the_busy() -> None:
    m = model()
    weight, error = torch.arange(1.0, COUNT + 1), torch.arange(1.0, COUNT + 1).flip(0)
    weight[[4, 7]] = 0.0  # idle
    error[[12, 17]] = 100.0  # busy
    change = relocate(m, weight, error, 0.1)
    assert change is not None and change.text == "moved 2"
    assert all(v.shape == m.params[k].shape for k, v in change.params.items())
    assert sorted(change.origin[[4, 7]].tolist()) == [12, 17]
    others = torch.tensor([i for i in range(COUNT) if i not in (4, 7, 12, 17)])
    assert torch.equal(change.origin[others], others)
    assert change.fresh.nonzero()[:, 0].tolist() == [4, 7, 12, 17]
    for name, value in change.params.items():
        assert torch.equal(value[others], m.params[name][others]), name


@pytest.mark.parametrize("neurons", [0, 4])
def test_relocated_children_carry_their_parents_density(neurons: int) -> None:
    m = model(neurons=neurons)
    change = relocate(m, torch.arange(1.0, COUNT + 1), torch.arange(1.0, COUNT + 1))
    assert change is not None
    rows, x = points_inside(change.params, change.fresh.nonzero()[:, 0])
    after = sigma(change.params, neurons, rows, x)
    before = sigma({k: v.detach() for k, v in m.params.items()}, neurons, change.origin[rows], x)
    assert torch.allclose(after, before, rtol=1e-10, atol=1e-10)
    copied = {**change.params, **{k: m.params[k].detach()[change.origin] for k in DENSITY}}
    assert (sigma(copied, neurons, rows, x) - before).abs().max() > 0.1, "copies of the weights are another field"
    assert torch.equal(change.params["sh_dc"][rows], m.params["sh_dc"].detach()[change.origin[rows]])


def test_relocation_keeps_the_count_and_its_limit() -> None:
    m = model()
    for fraction, moves in ((0.0, 0), (0.04, 0), (0.05, 1), (0.5, 10), (1.0, 0)):  # with all of them busy none is idle
        change = relocate(m, torch.rand(COUNT), torch.rand(COUNT), fraction)
        assert (0 if change is None else len(change.fresh.nonzero()) // 2) == moves
        assert change is None or len(change.origin) == COUNT


def test_relocation_can_be_left_to_the_idle() -> None:
    m = model()
    weight, error = torch.ones(COUNT), torch.arange(1.0, COUNT + 1)
    weight[[2, 6]], weight[9] = torch.tensor([0.0, 0.02]), 0.2  # the mean is 0.86
    change = relocate(m, weight, error, 0.25, 0.05)
    assert change is not None and change.text == "moved 2"
    assert sorted(change.origin[[2, 6]].tolist()) == [18, 19] and change.origin[9] == 9
    assert relocate(m, weight, error, 0.05, 0.05).text == "moved 1", "the share still bounds it"
    assert relocate(m, torch.ones(COUNT), error, 0.25, 0.05) is None, "all are at work"
    assert relocate(m, torch.zeros(COUNT), error, 0.25, 0.05) is None, (
        "a stretch of views without anything says nothing of anyone"
    )


def test_relocation_grows_to_what_was_asked_for_where_the_error_is() -> None:
    m = model()
    weight, error = torch.ones(COUNT), torch.arange(1.0, COUNT + 1)
    weight[[2, 6]] = 0.0
    change = relocate(m, weight, error, 0.1, 0.05, grow_to=COUNT + 3)
    assert change is not None and change.text == "moved 2, grew by 3"
    assert change.origin.tolist()[COUNT:] == [17, 16, 15] and sorted(change.origin[[2, 6]].tolist()) == [18, 19]
    assert change.fresh.nonzero()[:, 0].tolist() == [2, 6, 15, 16, 17, 18, 19, 20, 21, 22]
    rows, x = points_inside(change.params, change.fresh.nonzero()[:, 0])
    before = sigma({k: v.detach() for k, v in m.params.items()}, 4, change.origin[rows], x)
    assert torch.allclose(sigma(change.params, 4, rows, x), before, rtol=1e-10, atol=1e-10)
    others = [i for i in range(COUNT) if i not in (2, 6, 15, 16, 17, 18, 19)]
    assert all(torch.equal(v[others], m.params[k][others]) for k, v in change.params.items())
    assert relocate(m, torch.ones(COUNT), error, 0.1, 0.05, grow_to=1000).text == f"grew by {COUNT // 4}", (
        "a quarter at a time"
    )
    assert relocate(m, torch.ones(COUNT), error, 0.1, 0.05, grow_to=COUNT) is None, "nobody is missing"
    error[:-2] = 0.0
    assert relocate(m, torch.ones(COUNT), error, 0.1, 0.05, grow_to=1000).text == "grew by 2", (
        "nothing is known of the others"
    )


@pytest.mark.parametrize(
    ("steps", "every", "target", "most"),
    [(1000, 100, 2 * COUNT, 3), (1000, 100, 5 * COUNT, 3), (5, 200, 2 * COUNT, 2), (40, 200, 2 * COUNT, 2),
        (500, 200, 2 * COUNT, 2)],
)  # fmt: skip
def test_relocation_reaches_its_count_in_time(steps: int, every: int, target: int, most: int) -> None:
    """However few interventions there are, and in budgets that are over before the first one."""
    m, counts, when = model(), [], []
    population = RelocatePopulation(PopulationSettings(start=0.02, stop=0.35, every=every, grow_to=target))
    for step in range(1, steps + 1):
        population.observe(m, stats(torch.ones(m.count), torch.rand(m.count) + 0.1))
        if population.due(step, step / steps):
            change = population.intervene(m, 1.0)
            if change is not None:
                m = Primitives(m.density, m.colour, change.params)
                counts.append(m.count)
                when.append(step)
    assert counts[-1] == target and len(counts) <= most
    assert when[-1] <= 0.35 * steps + 1, "early enough to learn"
    assert steps < 1000 or counts[0] <= 1 + COUNT * (target / COUNT) ** (1 / 3), "no more at once than is needed"


def test_relocation_keeps_its_interval_where_that_is_soon_enough_or_nobody_is_missing() -> None:
    for steps, grow_to in ((5000, 2 * COUNT), (500, COUNT)):
        interval = PopulationSettings(start=0.02, stop=0.35, every=100, grow_to=grow_to)
        m, population = model(), RelocatePopulation(interval)
        population.observe(m, stats(torch.ones(m.count), torch.rand(m.count) + 0.1))
        found = [step for step in range(1, steps + 1) if population.due(step, step / steps)]
        assert found == list(range(100, int(0.35 * steps - 1e-9) + 1, 100))


def test_relocation_sums_over_views_and_starts_anew() -> None:
    m = model()
    population = RelocatePopulation(PopulationSettings(fraction=0.05))
    first, second = torch.full((COUNT,), 1.0), torch.full((COUNT,), 1.0)
    first[3], second[5] = 9.0, 30.0
    first[8] = second[8] = 0.1
    assert population.intervene(m, 1.0) is None, "nothing was seen yet"
    for s in (first, second):
        population.observe(m, stats(s))
    change = population.intervene(m, 1.0)
    assert change is not None and change.origin[8] == 5
    assert population.intervene(m, 1.0) is None and population.state() == {}


def settings(**changes: object) -> PopulationSettings:
    return PopulationSettings(
        **{
            "strategy": "gradient",
            "grow_threshold": 1.0,
            "prune_threshold": 0.1,
            "clone_scale": 0.1,
            "prune_scale": 2.0,
            **changes,
        }  # type: ignore[arg-type]
    )


def grown(m: Primitives, size: Tensor, weight: Tensor | None = None, extent: float = 1.0, **changes: object):  # type: ignore[no-untyped-def]
    population = GradientPopulation(settings(**changes))
    give_grads(m, size)
    population.observe(m, stats(torch.ones(m.count) if weight is None else weight))
    return population.intervene(m, extent)


def test_gradient_clones_splits_and_prunes() -> None:
    m = model()
    with torch.no_grad():
        m.params["log_scales"].clamp_(-1.6, -1.2)  # between 0.2 and 0.3: larger than clone_scale
        m.params["log_scales"][2] = -3.0  # small
        m.params["log_scales"][6] = 1.0  # larger than prune_scale
    size = torch.full((COUNT,), 0.5)
    size[2] = size[3] = size[6] = 5.0
    size[9] = 0.05
    weight = torch.ones(COUNT)
    weight[11] = 0.0
    change = grown(m, size, weight)
    assert change is not None and change.text == "cloned 1, split 1, pruned 3"
    gone = {3, 6, 9, 11}
    kept = [i for i in range(COUNT) if i not in gone]
    assert change.origin.tolist() == [*kept, 2, 3, 3]
    assert change.fresh.tolist() == [False] * len(kept) + [True] * 3

    # the clone and its original share the density, elsewhere equal
    original, clone = kept.index(2), len(kept)
    for name in m.params:
        factor = 0.5 if name in ("w2", "b2") else 1.0
        assert torch.equal(change.params[name][original], m.params[name].detach()[2] * factor), name
        assert torch.equal(change.params[name][clone], m.params[name].detach()[2] * factor), name

    # the children of the split carry the density
    children = torch.tensor([len(kept) + 1, len(kept) + 2])
    rows, x = points_inside(change.params, children)
    before = sigma({k: v.detach() for k, v in m.params.items()}, 4, torch.full_like(rows, 3), x)
    assert torch.allclose(sigma(change.params, 4, rows, x), before, rtol=1e-10, atol=1e-10)
    shrunk = change.params["log_scales"][children] - m.params["log_scales"].detach()[3]
    assert torch.allclose(shrunk.exp(), torch.tensor(1 / 1.6, dtype=torch.float64), atol=1e-6)

    untouched = [i for i, o in enumerate(change.origin[: len(kept)].tolist()) if o != 2]
    for name in m.params:
        assert torch.equal(change.params[name][untouched], m.params[name].detach()[change.origin[untouched]])


def test_sizes_are_in_units_of_the_extent() -> None:
    m = model()
    size = torch.full((COUNT,), 5.0)
    assert "cloned 0, split 20" in grown(m, size, extent=1.0, clone_scale=0.01).text
    assert "cloned 20, split 0" in grown(m, size, extent=1000.0, clone_scale=0.01).text


def test_growth_cap_keeps_the_most_wanted() -> None:
    m = model()
    size = torch.linspace(1.1, 3.0, COUNT)[torch.randperm(COUNT, generator=torch.Generator().manual_seed(0))]
    change = grown(m, size, max_primitives=COUNT + 3, clone_scale=10.0)
    assert len(change.origin) == COUNT + 3
    assert sorted(change.origin[COUNT:].tolist()) == sorted(size.argsort(descending=True)[:3].tolist())
    change = grown(m, size, max_primitives=COUNT + 3, clone_scale=0.0)
    assert len(change.origin) == COUNT + 3
    for cap in (COUNT, 5):
        assert len(grown(m, size, max_primitives=cap).origin) == COUNT, "the cap stops growth and removes nothing"


def test_the_model_is_never_emptied() -> None:
    m = model()
    assert grown(m, torch.zeros(COUNT)) is None
    assert grown(m, torch.ones(COUNT), torch.zeros(COUNT)) is None, "an all-black view"
    assert grown(m, torch.ones(COUNT), prune_scale=1e-9) is None
    last = torch.zeros(COUNT)
    last[4] = 0.5
    assert grown(m, last).origin.tolist() == [4]


def test_the_mean_is_over_views_that_saw_the_primitive() -> None:
    m = model()
    population = GradientPopulation(settings(clone_scale=10.0))
    one = torch.zeros(COUNT)
    one[0] = 1.0
    give_grads(m, torch.full((COUNT,), 1.5))
    population.observe(m, stats(torch.ones(COUNT)))
    give_grads(
        m, torch.full((COUNT,), 0.7)
    )  # the norm of primitive 0 falls to 1.1; the others were not seen and keep 1.5
    population.observe(m, stats(one))
    state = population.state()
    assert torch.allclose(state["total"] / state["seen"], torch.tensor([1.1] + [1.5] * 19))
    change = population.intervene(m, 1.0)
    assert change is not None and change.text == "cloned 20, split 0, pruned 0"
    assert population.state() == {}


def test_gradients_of_other_fields_do_not_count() -> None:
    m = model()
    population = GradientPopulation(settings())
    give_grads(m, torch.full((COUNT,), 0.5))
    for name in ("means", "sh_dc", "log_scales"):
        m.params[name].grad = torch.full_like(m.params[name], 1e6)
    population.observe(m, stats(torch.ones(COUNT)))
    assert torch.allclose(population.state()["total"], torch.tensor(0.5))


def test_due() -> None:
    population = FixedPopulation(PopulationSettings(every=10, start=0.2, stop=0.6))
    assert [s for s in range(1, 101) if population.due(s, s / 100)] == [20, 30, 40, 50]
    m = model()
    population.observe(m, stats(torch.ones(COUNT)))
    assert population.intervene(m, 1.0) is None and population.state() == {}
    assert isinstance(make_population(PopulationSettings(strategy="fixed")), FixedPopulation)


def test_a_wrong_name_is_told_the_strategies() -> None:
    with pytest.raises(ConfigError, match=r"train\.population\.strategy='grow': expected fixed, relocate or gradient$"):
        make_population(PopulationSettings(strategy="grow"))


# ---------------------------------------------------------------- fields whose methods return something else


def of_waves(**methods: Any) -> Primitives:
    m = model()
    m.density = type("Waves", (CosineDensity,), methods)(4)
    return m


def splits(m: Primitives) -> None:
    relocate(m, torch.arange(1.0, COUNT + 1), torch.arange(1.0, COUNT + 1))


def clones(m: Primitives) -> None:
    grown(m, torch.full((COUNT,), 5.0), clone_scale=10.0)


def changed(method: str, **to: Any) -> dict[str, Any]:
    """The method with some tensors put through a function."""

    def wrong(self: CosineDensity, params: Any, *rest: Any) -> dict[str, Tensor]:
        right = getattr(CosineDensity, method)(self, params, *rest)
        return {**right, **{name: change(right[name]) for name, change in to.items()}}

    return {method: wrong}


@pytest.mark.parametrize(
    ("act", "methods", "message"),
    [
        (splits, changed("on_split", b2=lambda v: v[:, 0]), r"on_split: b2 has shape \(10,\); expected \(10, 1\)"),
        (splits, {"on_split": lambda self, p, old, new: {"W1": p["W1"]}}, r"on_split returned tensors \['W1'\]"),
        (clones, changed("scale_density", w2=lambda v: v.T), r"scale_density: w2 has shape \(4, 20\)"),
    ],
)
def test_what_a_method_returns_is_checked_by_name(act: Any, methods: dict[str, Any], message: str) -> None:
    with pytest.raises(FormError, match=f"^density field Waves: {message}"):
        act(of_waves(**methods))
