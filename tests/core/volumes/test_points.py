"""Extinction and source at scattered points, forward and backward, against every primitive at every point in
float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.fields import Conditions
from neuprim.core.model.gaussian import GaussianDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.volumes.density_grid import density_at
from neuprim.core.volumes.points import find_point_pairs, volume_values_at
from neuprim.core.volumes.points_cpu import sort_points_into_cells
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.scattering import ScatteringHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.static import SphericalHarmonics
from tests.cosine_models import model as cosine_model

pytestmark = pytest.mark.usefixtures("either_way")


def static(neurons: int, edge: int, count: int = 40) -> Primitives:
    return wide(cosine_model(neurons, edge, count=count))


def initialised(model: tuple, count: int, extent: float, scale: float) -> Primitives:
    generator = torch.Generator().manual_seed(0)
    means, colors = (torch.rand(count, 3, generator=generator) for _ in range(2))
    times = {"time": torch.rand(count, generator=generator)}
    context = InitContext(extent * (means - 0.5), torch.full((count,), scale), colors, generator, conditions=times)
    made = Primitives.initialise(*model, context)
    for value in made.params.values():
        value += 0.05 * torch.randn(value.shape, generator=generator)
    return wide(made)


def moving() -> Primitives:
    density, colour = TimeDensity(3, "window+motion+offset", edge=2, gain=True), TimeHarmonics(0, powers=2, waves=1)
    return initialised((density, colour), 60, 1.0, 0.3)


def gaussians() -> Primitives:
    return initialised((GaussianDensity(), SphericalHarmonics(0)), 5, 0.3, 0.4)


def wide(model: Primitives) -> Primitives:
    """Parameters in float64, so that only the arithmetic is compared."""
    model.params = {name: value.detach().double().requires_grad_() for name, value in model.params.items()}
    return model


def reference(
    model: Primitives, conditions: Conditions, x: Tensor, colors: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Sigma (M,) and source (M, 3) by all pairs, in float64 with autograd; with other ``colors``, if given."""
    active = model.active(conditions)
    g = active.geometry
    if colors is None:
        own = {s.name: active.params[s.name] for s in model.colour.parameters()}
        harmonics = model.colour.harmonics(own, conditions)
        assert harmonics is not None
        colors = (harmonics[0] * 0.28209479177387814 + 0.5).clamp_min(0)
    point, prim = (i.reshape(-1) for i in torch.meshgrid(torch.arange(len(x)), torch.arange(g.count), indexing="ij"))
    y = torch.einsum("pa,pab->pb", x[point] - g.means[prim], g.rotations[prim]) / g.scales[prim]
    sigma = active.sigma(prim, x[point]).clamp_min(0) * (y.square().sum(-1) < 1)
    total = torch.zeros(len(x), dtype=torch.float64).index_add(0, point, sigma)
    return total, torch.zeros(len(x), 3, dtype=torch.float64).index_add(0, point, sigma[:, None] * colors[prim])


def gradients(model: Primitives, sigma: Tensor, source: Tensor) -> dict[str, Tensor]:
    """Of a random weighted sum of both."""
    generator = torch.Generator().manual_seed(5)
    a, b = (torch.randn(x.shape, generator=generator, dtype=torch.float64) for x in (sigma, source))
    loss = (a * sigma.double()).sum() + (b * source.double()).sum()
    made = torch.autograd.grad(loss, list(model.params.values()), allow_unused=True)
    named = zip(model.params.items(), made, strict=True)
    return {name: torch.zeros_like(value) if g is None else g for (name, value), g in named}


def agree(
    model: Primitives, conditions: Conditions, x: Tensor, tolerance: float = 2e-6, exact: Primitives | None = None
) -> None:
    exact = exact or model
    found, (sigma, source) = volume_values_at(model, conditions, x), reference(exact, conditions, x)
    assert found.source is not None and float(sigma.detach().max()) > 0 and found.sigma.dtype == torch.float32
    for fast, slow in ((found.sigma, sigma), (found.source, source)):
        assert torch.allclose(fast.double(), slow, rtol=tolerance, atol=tolerance * float(slow.detach().abs().max()))
    fast_gradients = gradients(model, found.sigma, found.source)
    for name, expected in gradients(exact, sigma, source).items():
        scale = float(expected.abs().max()) if expected.numel() else 0.0
        assert fast_gradients[name].dtype == model.params[name].dtype
        assert torch.allclose(fast_gradients[name].double(), expected, rtol=1e-5, atol=max(1e-5 * scale, 1e-12)), name


def cloud(count: int = 300, size: float = 2.0) -> Tensor:
    return size * (torch.rand(count, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5)


@pytest.fixture(params=["compiled", "Warp"])
def kernels(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """The kernels of the CPU, and those of a GPU on Warp's CPU blocks."""
    if request.param == "Warp":
        pytest.importorskip("warp", reason="the kernels of a GPU are written in Warp: pip install 'neuprim[cuda]'")
        monkeypatch.setattr(device, "on_numba", lambda *tensors: False)
        monkeypatch.setattr(device, "on_warp", lambda *tensors: True)
    return str(request.param)


@pytest.mark.parametrize("edge", [0, 1, 2])
@pytest.mark.parametrize("neurons", [0, 1, 5, 16])
def test_it_equals_all_pairs_forward_and_backward(neurons: int, edge: int, kernels: str) -> None:
    model, x = static(neurons, edge), cloud()
    agree(model, {}, x)
    assert torch.allclose(volume_values_at(model, {}, x).sigma.double(), density_at(model, {}, x), rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("time", [0.0, 0.37, 1.0])
def test_in_a_frame_of_a_moving_model(time: float, kernels: str) -> None:
    agree(moving(), {"time": torch.tensor(time)}, cloud(400, size=1.2))


def test_a_density_in_torch_code() -> None:
    agree(gaussians(), {}, cloud(size=1.0))


@pytest.mark.parametrize("case", ["needles", "huge", "tiny", "far", "one place", "one point", "a line", "on the rim"])
def test_extremes(case: str) -> None:
    model, x = static(2, 2), cloud()
    params = model.params
    with torch.no_grad():
        if case == "needles":
            params["log_scales"] += torch.tensor([4.0, -4.0, -4.0])
            x = params["means"][:, None].expand(-1, 5, -1).reshape(-1, 3) + 1e-3 * cloud(200)
        elif case == "huge":
            params["log_scales"][::3] = 12.0
        elif case == "tiny":
            params["log_scales"][::2] = -14.0
            x = torch.cat([x, params["means"].detach() + 2e-7])
        elif case == "far":
            params["means"][3:6] = torch.tensor([1e25, -1e25, 0.0], dtype=torch.float64)
        elif case == "one place":
            x = params["means"].detach()[:1].expand(50, 3)
        elif case == "one point":
            x = params["means"].detach()[:1] + 0.01
        elif case == "a line":
            x = torch.linspace(-1, 1, 80).double()[:, None] * torch.tensor([1.0, 0.0, 0.0]).double()
        else:
            axes = model.geometry.rotations[:, :, 0] * model.geometry.scales[:, :1]
            x = torch.cat([params["means"] + s * axes for s in (1 - 1e-9, 1.0, 1 + 1e-9, -1.0, 0.5)])
    agree(model, {}, x.contiguous(), 1e-5)


def test_nothing_is_active_or_no_point_is_given(kernels: str) -> None:
    model = moving()
    with torch.no_grad():
        model.params["window_center"].fill_(0.1)
        model.params["log_window"].fill_(-4.0)
    nothing = volume_values_at(model, {"time": torch.tensor(0.9)}, cloud())
    assert nothing.source is not None and not bool(nothing.sigma.any()) and not bool(nothing.source.any())
    none = volume_values_at(static(2, 1), {}, torch.zeros(0, 3))
    assert none.sigma.shape == (0,) and none.source is not None and none.source.shape == (0, 3)


@pytest.mark.parametrize("model", [static(3, 1, count=150), gaussians()], ids=["compiled", "torch"])
def test_shares_are_sums_over_points(model: Primitives, kernels: str) -> None:
    x, error = cloud(), torch.rand(300, generator=torch.Generator().manual_seed(3))
    found = volume_values_at(model, {}, x)
    shares = found.request_shares(error)
    assert not bool(shares.weight.any())
    found.sigma.sum().backward()
    cells = sort_points_into_cells(x.numpy())
    row, prim = find_point_pairs(model.geometry, cells)
    point = torch.from_numpy(cells.order)[row]
    own = model.active({}).sigma(prim, x[point]).clamp_min(0).detach()
    for sums, value in ((shares.weight, own), (shares.error_weight, own * error[point])):
        expected = torch.zeros(model.count, dtype=torch.float64).index_add_(0, prim, value)
        assert bool(expected.any()) and torch.allclose(sums.double(), expected, rtol=1e-5, atol=1e-6)


def test_it_does_not_depend_on_the_number_of_threads() -> None:
    model, x = static(3, 1, count=150), cloud()
    found = [volume_values_at(model, {}, x, threads=n) for n in (1, 2, 5)]
    made = [gradients(model, f.sigma, f.sigma[:, None]) for f in found]
    for other, grads in zip(found[1:], made[1:], strict=True):
        assert torch.equal(found[0].sigma, other.sigma)
        assert all(torch.equal(value, grads[name]) for name, value in made[0].items())


def test_parameters_in_float32_lose_nothing_on_the_way(kernels: str) -> None:
    """Turned needles, whose axes are a thousand apart: values of float32 parameters are right to the last rounding."""
    model = static(2, 2)
    generator = torch.Generator().manual_seed(6)
    with torch.no_grad():
        model.params["log_scales"][:] = torch.tensor([-0.5, -7.4, -7.4]) + 0.1 * torch.randn(40, 3, generator=generator)
        model.params["b2"] += 3
        axes = model.geometry.rotations * model.geometry.scales[:, None, :]
        inside = 0.5 * torch.rand(20, 40, 3, generator=generator, dtype=torch.float64) - 0.25
    params = {name: value.detach().float().requires_grad_() for name, value in model.params.items()}
    narrow = Primitives(model.density, model.colour, params)
    exact = wide(Primitives(model.density, model.colour, dict(params)))
    x = (exact.params["means"].detach() + torch.einsum("nij,pnj->pni", axes, inside)).reshape(-1, 3)
    agree(narrow, {}, x, 1e-6, exact)


def test_pairs_are_all_and_once() -> None:
    model, x = static(0, 0), cloud()
    cells, g = sort_points_into_cells(x.numpy()), model.geometry
    row, prim = find_point_pairs(g, cells)
    y = torch.einsum("mna,nab->mnb", x[:, None] - g.means, g.rotations) / g.scales
    expected = {tuple(pair) for pair in (y.square().sum(-1) < 1).nonzero().tolist()}
    found = list(zip(cells.order[row.numpy()].tolist(), prim.tolist(), strict=True))
    assert len(found) == len(expected) > 100 and set(found) == expected


def test_cells_hold_every_point() -> None:
    x = cloud().numpy()
    cells = sort_points_into_cells(x)
    count = int(cells.counts.prod())
    assert sorted(cells.order) == list(range(300)) and cells.starts[-1] == 300 and len(cells.starts) == count + 1
    owner = np.repeat(np.arange(count), np.diff(cells.starts))
    away = x[cells.order] - (cells.low + np.stack(np.unravel_index(owner, cells.counts), 1) * cells.step)
    assert (away >= -1e-12).all() and (away <= cells.step * (1 + 1e-12)).all()
    assert (cells.points == x[cells.order]).all()
    assert (np.diff(cells.order)[np.diff(owner) == 0] > 0).all(), "in a cell they keep their order"


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [("b2", float("nan"), "b2 of primitive 7"), ("log_scales", -800.0, "product of finite parameters")],
)
def test_what_is_not_finite_is_named(name: str, value: float, message: str) -> None:
    model = static(2, 1)
    with torch.no_grad():
        model.params[name][7] = value
    with pytest.raises(NonFiniteError, match=message):
        volume_values_at(model, {}, cloud())


def test_a_gpu_gives_nan_for_what_is_not_finite(kernels: str) -> None:
    if kernels == "compiled":
        return
    model = static(2, 1)
    with torch.no_grad():
        model.params["log_scales"][7] = -800.0
    assert bool(volume_values_at(model, {}, cloud()).sigma.isnan().all())


def test_scattered_light_is_by_itself() -> None:
    density, colour = TimeDensity(0, "none", edge=2, gain=True), ScatteringHarmonics(0, powers=2, waves=1, typical=5.0)
    model, x, conditions = initialised((density, colour), 60, 1.0, 0.3), cloud(), {"time": torch.tensor(0.4)}
    found = volume_values_at(model, conditions, x)
    emitting = {name: value for name, value in model.params.items() if name != "scattered"}
    plain = Primitives(density, TimeHarmonics(0, powers=2, waves=1), emitting)
    sigma, scattered = reference(model, conditions, x, model.params["scattered"].clamp_min(0) / 5)
    assert found.scattered is not None and found.source is not None and float(scattered.detach().max()) > 0
    for fast, slow in ((found.scattered, scattered), (found.source, reference(plain, conditions, x)[1])):
        assert torch.allclose(fast.double(), slow, rtol=2e-6, atol=2e-6 * float(slow.detach().abs().max()))
    exact = gradients(model, sigma, scattered)
    for name, value in gradients(model, found.sigma, found.scattered).items():
        bound = max(1e-5 * float(exact[name].abs().max()), 1e-12) if value.numel() else 0.0
        assert torch.allclose(value, exact[name], rtol=1e-5, atol=bound), name


def test_colour_is_left_out_where_it_is_not_requested_or_depends_on_direction(monkeypatch: pytest.MonkeyPatch) -> None:
    model, x = static(2, 1), cloud()
    sigma, source = volume_values_at(model, {}, x, colour=False)[:2]
    monkeypatch.setattr(SphericalHarmonics, "harmonics", lambda self, params, conditions: None)
    found = volume_values_at(model, {}, x)
    assert source is None and found.source is None and torch.equal(found.sigma, sigma)
