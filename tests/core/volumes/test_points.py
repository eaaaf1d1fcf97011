"""Extinction and source at scattered points, forward and backward, against every primitive at every point in
float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.errors import NonFiniteError
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.densities.gaussian import GaussianDensity
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.volumes import points as at_points
from neuprim.core.volumes.grid import density_at
from neuprim.core.volumes.points import cells_of, pairs_of, values_at
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.density import TimeDensity
from neuprim.tasks.static.fields import SphericalHarmonics
from tests import scenes

pytestmark = pytest.mark.usefixtures("either_way")


def static(neurons: int, edge: int, seed: int = 2, count: int = 40) -> Primitives:
    """Parameters in float64, so that only the arithmetic is compared."""
    t = scenes.tensors(count, neurons, seed=seed)
    params = {**{k: v for k, v in t.items() if k != "colors"}, "sh_dc": t["colors"]}
    return wide(Primitives(CosineDensity(neurons, edge=edge), SphericalHarmonics(0), params))


def moving(seed: int = 0) -> Primitives:
    generator = torch.Generator().manual_seed(seed)
    density, colour = TimeDensity(3, "window+motion+offset", edge=2, gain=True), TimeHarmonics(0, powers=2, waves=1)
    means, times = torch.rand(60, 3, generator=generator) - 0.5, torch.rand(60, generator=generator)
    context = InitContext(
        means, torch.full((60,), 0.3), torch.rand(60, 3, generator=generator), generator, conditions={"time": times}
    )
    model = Primitives.initialise(density, colour, context)
    for value in model.params.values():
        value += 0.05 * torch.randn(value.shape, generator=generator)
    return wide(model)


def gaussians() -> Primitives:
    generator = torch.Generator().manual_seed(0)
    context = InitContext(
        0.3 * torch.rand(5, 3, generator=generator),
        torch.full((5,), 0.4),
        torch.rand(5, 3, generator=generator),
        generator,
    )
    return wide(Primitives.initialise(GaussianDensity(), SphericalHarmonics(0), context))


def wide(model: Primitives) -> Primitives:
    model.params = {name: value.double().requires_grad_() for name, value in model.params.items()}
    return model


def oracle(model: Primitives, conditions: Conditions, x: Tensor) -> tuple[Tensor, Tensor]:
    """Sigma (M,) and source (M, 3) by all pairs, in float64 with autograd."""
    active = model.active(conditions)
    g = active.geometry
    own = {spec.name: active.params[spec.name] for spec in model.colour.parameters()}
    harmonics = model.colour.harmonics(own, conditions)
    assert harmonics is not None
    colors = (harmonics[0] * 0.28209479177387814 + 0.5).clamp_min(0)
    point, prim = (i.reshape(-1) for i in torch.meshgrid(torch.arange(len(x)), torch.arange(g.count), indexing="ij"))
    y = torch.einsum("pa,pab->pb", x[point] - g.means[prim], g.rotations[prim]) / g.scales[prim]
    sigma = active.sigma(prim, x[point]).clamp_min(0) * (y.square().sum(-1) < 1)
    total = torch.zeros(len(x), dtype=torch.float64).index_add(0, point, sigma)
    return total, torch.zeros(len(x), 3, dtype=torch.float64).index_add(0, point, sigma[:, None] * colors[prim])


def gradients(model: Primitives, sigma: Tensor, source: Tensor, seed: int = 5) -> dict[str, Tensor]:
    """Of a random weighted sum of both."""
    generator = torch.Generator().manual_seed(seed)
    a = torch.randn(sigma.shape, generator=generator, dtype=torch.float64)
    b = torch.randn(source.shape, generator=generator, dtype=torch.float64)
    made = torch.autograd.grad((a * sigma).sum() + (b * source).sum(), list(model.params.values()), allow_unused=True)
    return {
        name: torch.zeros_like(v) if g is None else g for (name, v), g in zip(model.params.items(), made, strict=True)
    }


def agree(model: Primitives, conditions: Conditions, x: Tensor, tolerance: float = 2e-6) -> None:
    found, (sigma, source) = values_at(model, conditions, x), oracle(model, conditions, x)
    assert found.source is not None and float(sigma.detach().max()) > 0
    for fast, slow in ((found.sigma, sigma), (found.source, source)):
        assert torch.allclose(fast.double(), slow, rtol=tolerance, atol=tolerance * float(slow.detach().abs().max()))
    fast_g, slow_g = gradients(model, found.sigma.double(), found.source.double()), gradients(model, sigma, source)
    for name, expected in slow_g.items():
        scale = float(expected.abs().max()) if expected.numel() else 0.0
        assert torch.allclose(fast_g[name], expected, rtol=1e-5, atol=max(1e-5 * scale, 1e-12)), name


def cloud(count: int = 300, seed: int = 1, size: float = 2.0) -> Tensor:
    return size * (torch.rand(count, 3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64) - 0.5)


@pytest.mark.parametrize("edge", [0, 1, 2])
@pytest.mark.parametrize("neurons", [0, 1, 5, 16])
def test_it_equals_all_pairs_forward_and_backward(neurons: int, edge: int) -> None:
    agree(static(neurons, edge), {}, cloud())


@pytest.mark.parametrize("time", [0.0, 0.37, 1.0])
def test_in_a_frame_of_a_moving_model(time: float) -> None:
    agree(moving(), {"time": torch.tensor(time)}, cloud(400, size=1.2))


def test_a_density_in_torch_code() -> None:
    agree(gaussians(), {}, cloud(size=1.0))


def test_it_is_the_density_that_grids_show() -> None:
    model, x = static(4, 1), cloud()
    assert torch.allclose(values_at(model, {}, x).sigma.double(), density_at(model, {}, x), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("case", ["needles", "huge", "tiny", "far", "one place", "one point", "a line", "on the rim"])
def test_extremes(case: str) -> None:
    model, x = static(2, 2), cloud()
    with torch.no_grad():
        if case == "needles":
            model.params["log_scales"][:, 0] += 4
            model.params["log_scales"][:, 1:] -= 4
            x = model.params["means"][:, None].expand(-1, 5, -1).reshape(-1, 3) + 1e-3 * cloud(200)
        elif case == "huge":
            model.params["log_scales"][::3] = 12.0
        elif case == "tiny":
            model.params["log_scales"][::2] = -14.0
            x = torch.cat([x, model.params["means"].detach() + 2e-7])
        elif case == "far":
            model.params["means"][3:6] = torch.tensor([1e25, -1e25, 0.0], dtype=torch.float64)
        elif case == "one place":
            x = model.params["means"].detach()[:1].expand(50, 3)
        elif case == "one point":
            x = model.params["means"].detach()[:1] + 0.01
        elif case == "a line":
            x = torch.linspace(-1, 1, 80, dtype=torch.float64)[:, None] * torch.tensor(
                [1.0, 0.0, 0.0], dtype=torch.float64
            )
        else:
            axes = model.geometry.rotations[:, :, 0] * model.geometry.scales[:, :1]
            x = torch.cat([model.params["means"] + s * axes for s in (1 - 1e-9, 1.0, 1 + 1e-9, -1.0, 0.5)])
    agree(model, {}, x.contiguous(), 1e-5)


def test_nothing_lives_or_nothing_is_asked() -> None:
    model = moving()
    with torch.no_grad():
        model.params["window_center"].fill_(0.1)
        model.params["log_window"].fill_(-4.0)
    nothing = values_at(model, {"time": torch.tensor(0.9)}, cloud())
    assert nothing.source is not None and not bool(nothing.sigma.any()) and not bool(nothing.source.any())
    none = values_at(static(2, 1), {}, torch.zeros(0, 3))
    assert none.sigma.shape == (0,) and none.source is not None and none.source.shape == (0, 3)


@pytest.mark.parametrize("model", [static(3, 1, count=150), gaussians()], ids=["compiled", "torch"])
def test_shares_are_sums_over_points(model: Primitives) -> None:
    x, error = cloud(), torch.rand(300, generator=torch.Generator().manual_seed(3))
    found = values_at(model, {}, x)
    shares = found.watch(error)
    assert not bool(shares.weight.any())
    found.sigma.sum().backward()
    point, prim = pairs_of(model.geometry, x.numpy())
    own = model.active({}).sigma(prim, x[point]).clamp_min(0).detach()
    for sums, value in ((shares.weight, own), (shares.error_weight, own * error[point])):
        expected = torch.zeros(model.count, dtype=torch.float64).index_add_(0, prim, value)
        assert bool(expected.any()) and torch.allclose(sums.double(), expected, rtol=1e-5, atol=1e-6)


def test_it_does_not_depend_on_the_number_of_threads() -> None:
    model, x = static(3, 1, count=150), cloud()
    found = [values_at(model, {}, x, threads=n) for n in (1, 2, 5)]
    made = [gradients(model, f.sigma.double(), f.sigma.double()[:, None]) for f in found]
    for other, grads in zip(found[1:], made[1:], strict=True):
        assert torch.equal(found[0].sigma, other.sigma)
        assert all(torch.equal(value, grads[name]) for name, value in made[0].items())


def test_parameters_in_float32_lose_nothing_on_the_way() -> None:
    """Turned needles, whose axes are a thousand apart: what is found of float32 parameters is right to the last
    rounding."""
    model = static(2, 2)
    generator = torch.Generator().manual_seed(6)
    with torch.no_grad():
        model.params["log_scales"][:] = torch.tensor([-0.5, -7.4, -7.4]) + 0.1 * torch.randn(40, 3, generator=generator)
        model.params["b2"] += 3
        axes = model.geometry.rotations * model.geometry.scales[:, None, :]
        inside = 0.5 * torch.rand(20, 40, 3, generator=generator, dtype=torch.float64) - 0.25
    narrow = Primitives(
        model.density, model.colour, {n: v.detach().float().requires_grad_() for n, v in model.params.items()}
    )
    exact = wide(Primitives(model.density, model.colour, {n: v.detach() for n, v in narrow.params.items()}))
    x = (exact.params["means"].detach() + torch.einsum("nij,pnj->pni", axes, inside)).reshape(-1, 3)
    found, (sigma, source) = values_at(narrow, {}, x), oracle(exact, {}, x)
    assert found.source is not None and found.sigma.dtype == torch.float32
    assert torch.allclose(found.sigma.double(), sigma, rtol=1e-6, atol=1e-6 * float(sigma.detach().max()))
    fast, slow = gradients(narrow, found.sigma.double(), found.source.double()), gradients(exact, sigma, source)
    for name, wanted in slow.items():
        assert fast[name].dtype == torch.float32
        assert torch.allclose(fast[name].double(), wanted, rtol=1e-5, atol=2e-6 * float(wanted.abs().max())), name


def test_pairs_are_all_and_once() -> None:
    model, x = static(0, 0), cloud()
    point, prim = pairs_of(model.geometry, x.numpy())
    g = model.geometry
    y = torch.einsum("mna,nab->mnb", x[:, None] - g.means, g.rotations) / g.scales
    expected = {tuple(pair) for pair in (y.square().sum(-1) < 1).nonzero().tolist()}
    assert len(point) == len(expected) > 100 and set(zip(point.tolist(), prim.tolist(), strict=True)) == expected


def test_cells_hold_every_point() -> None:
    x = cloud().numpy()
    cells = cells_of(x)
    assert (
        sorted(cells.order) == list(range(300))
        and cells.starts[-1] == 300
        and len(cells.starts) == cells.counts.prod() + 1
    )
    corner = (
        cells.low
        + np.stack(np.unravel_index(np.repeat(np.arange(cells.counts.prod()), np.diff(cells.starts)), cells.counts), 1)
        * cells.step
    )
    away = x[cells.order] - corner
    assert (away >= -1e-12).all() and (away <= cells.step * (1 + 1e-12)).all()
    assert (cells.placed == x[cells.order]).all()
    inner = np.repeat(np.arange(cells.counts.prod()), np.diff(cells.starts))
    assert (np.diff(cells.order)[np.diff(inner) == 0] > 0).all(), "in a cell they keep their order"


def test_what_is_not_finite_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    model = static(2, 1)
    with torch.no_grad():
        model.params["b2"][7] = float("nan")
    with pytest.raises(NonFiniteError, match="b2 of primitive 7"):
        values_at(model, {}, cloud())
    model = static(2, 1)
    with torch.no_grad():
        model.params["log_scales"][4] = -800.0
    with pytest.raises(NonFiniteError, match="product of finite parameters"):
        values_at(model, {}, cloud())


def test_colour_is_left_out_where_it_is_not_wanted_or_has_no_part_without_direction(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    model, x = static(2, 1), cloud()
    assert values_at(model, {}, x, colour=False).source is None
    monkeypatch.setattr(SphericalHarmonics, "harmonics", lambda self, params, conditions: None)
    found = values_at(model, {}, x)
    assert found.source is None and torch.equal(found.sigma, values_at(model, {}, x, colour=False).sigma)
    assert at_points._SUMS > 1
