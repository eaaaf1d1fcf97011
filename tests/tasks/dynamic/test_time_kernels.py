"""Windows and motion, fused, against their formulas in torch and float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import InitContext
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.dynamic.time_kernels import apply_time_window, move_means, rows_in_time_window

pytestmark = pytest.mark.usefixtures("either_way")


def windowed(w2: Tensor, b2: Tensor, center: Tensor, log_window: Tensor, xi: Tensor) -> tuple[Tensor, Tensor]:
    u = (xi.to(b2) - center) / log_window.exp()
    weight = (1 - u.square()).clamp_min(0).square()
    return w2 * weight, b2 * weight


def moved(means: Tensor, velocity: Tensor, acceleration: Tensor, center: Tensor, xi: Tensor) -> Tensor:
    since = xi.to(means) - center
    return means + (velocity + acceleration * since) * since


def compare(
    found: list[Tensor], wanted: list[Tensor], mine: list[Tensor], exact: list[Tensor], tolerance: float
) -> None:
    """Values, and gradients of a random weighted sum, row by row."""
    pull = [torch.randn(x.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64) for x in wanted]
    torch.autograd.backward(found, [p.to(x) for p, x in zip(pull, found, strict=True)])
    torch.autograd.backward(wanted, [p.to(x).double() for p, x in zip(pull, found, strict=True)])
    pairs = [*zip(found, wanted, strict=True)]
    for a, b in zip(mine, exact, strict=True):
        assert a.grad is not None and b.grad is not None
        pairs.append((a.grad, b.grad))
    for a, b in pairs:
        assert a.shape == b.shape and a.dtype == mine[0].dtype
        if b.numel():
            size = b.reshape(len(b), -1).abs().amax(1) + 1e-3 * b.abs().amax()
            assert ((a - b).reshape(len(b), -1).abs().amax(1) <= tolerance * size + 1e-37).all()


def draw(seed: int, dtype: torch.dtype, *widths: int) -> list[Tensor]:
    g = torch.Generator().manual_seed(seed)
    return [torch.randn(40, n, generator=g, dtype=torch.float64).to(dtype) for n in widths]


@pytest.mark.parametrize("neurons", [0, 3])
@pytest.mark.parametrize("case", ["usual", "outside", "at the middle", "short", "at the edge"])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-4), (torch.float64, 1e-11)])
def test_windows_forward_and_backward(dtype: torch.dtype, tolerance: float, case: str, neurons: int) -> None:
    w2, b2, center, log_window = draw(3, dtype, neurons, 1, 1, 1)
    xi, half = torch.tensor(0.375, dtype=torch.float64), 1e-4 if case == "short" else 0.3
    log_window = (0.1 * log_window + torch.tensor(half).log().to(dtype)).to(dtype)
    share = {
        "usual": 0.8 * center.clamp(-1, 1),
        "outside": 3 + center.abs(),
        "at the middle": 0 * center,
        "short": 0.5 * center.clamp(-1, 1),
    }
    center = xi.to(dtype) + share[case] * log_window.exp() if case in share else xi.to(dtype) - 0.3 + 0 * center
    if case == "at the edge":
        log_window = 0 * log_window + torch.tensor(0.3, dtype=dtype).log()
    mine = [x.detach().requires_grad_() for x in (w2, b2, center, log_window)]
    exact = [x.detach().double().requires_grad_() for x in mine]
    found, wanted = list(apply_time_window(*mine, xi)), list(windowed(*exact, xi))
    assert all(torch.equal(a, b) for a, b in zip(found, windowed(*mine, xi), strict=True))
    if case == "at the edge":
        found, wanted = found[1:], wanted[1:]
        assert found[0].detach().abs().max() < 1e-5
        torch.autograd.backward(found, [torch.ones_like(x) for x in found])
        assert all(x.grad is None or bool(torch.isfinite(x.grad).all()) for x in mine)
        return
    compare(found, wanted, mine, exact, tolerance)
    if case == "outside":
        assert all(x.grad is not None and x.grad.abs().sum() == 0 for x in mine)


@pytest.mark.parametrize("xi", [0.0, 0.37, 1e4])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-5), (torch.float64, 1e-12)])
def test_motion_forward_and_backward(dtype: torch.dtype, tolerance: float, xi: float) -> None:
    mine = [x.requires_grad_() for x in draw(5, dtype, 3, 3, 3, 1)]
    exact = [x.detach().double().requires_grad_() for x in mine]
    time = torch.tensor(xi, dtype=torch.float64)
    found, wanted = move_means(*mine, time), moved(*exact, time)
    assert torch.equal(found, moved(*mine, time))
    compare([found], [wanted], mine, exact, tolerance)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_rows_in_their_windows(dtype: torch.dtype) -> None:
    center, log_window = draw(9, dtype, 1, 1)
    center[:6, 0] = torch.tensor([0.25, 0.25, torch.nan, torch.inf, -torch.inf, 0.25], dtype=dtype)
    log_window[:6, 0] = torch.tensor([-torch.inf, torch.inf, 0.0, 1.0, torch.inf, torch.nan], dtype=dtype)
    wide = torch.stack([center, log_window], 1)[:, :, 0]  # strides do not matter
    for xi in (0.25, 0.0, 1.0, -3.0):
        time = torch.tensor(xi, dtype=torch.float64)
        wanted = [n for n in range(40) if abs(xi - float(center[n])) < float(log_window[n].double().exp())]
        for given in ((center, log_window), (wide[:, :1], wide[:, 1:])):
            rows = rows_in_time_window(*given, time)
            assert rows.dtype == torch.int64 and rows.tolist() == wanted
    assert rows_in_time_window(center[:2], log_window[:2], torch.tensor(0.25)).tolist() == [1]
    assert rows_in_time_window(center[:0], log_window[:0], torch.tensor(0.25)).tolist() == []


@pytest.mark.parametrize("parts", ["window", "motion", "window+motion", "phase+offset+window+motion"])
def test_the_field_uses_them_with_every_part(parts: str) -> None:
    """The whole field in float64 against the formulas of its module's description, parameter by parameter."""
    generator = torch.Generator().manual_seed(1)
    field = TimeDensity(2, parts, edge=2, gain=True)
    places, colours = (torch.rand(6, 3, generator=generator) for _ in range(2))
    context, params = InitContext(places, torch.full((6,), 0.3), colours, generator), {}
    for s in field.parameters():
        value = s.init(context) + 0.1 * torch.randn(6, *s.shape, generator=generator)
        params[s.name] = value.double().requires_grad_()
    means = torch.rand(6, 3, generator=generator, dtype=torch.float64).requires_grad_()
    place = Geometry(means, torch.zeros(6, 3, dtype=torch.float64), torch.ones(6, 4, dtype=torch.float64))
    conditions = {"time": torch.tensor(0.45)}
    xi = conditions["time"].double()
    form, where = field.lower(params, place, conditions), field.move(params, place, conditions)

    steady = {s.name: params[s.name] for s in CosineDensity(2, edge=2, gain=True).parameters()}
    if "offset" in parts:
        angle = torch.pi * xi * torch.arange(1, 5)
        steady["b2"] = steady["b2"] + (params["offset_cos"] @ angle.cos() + params["offset_sin"] @ angle.sin())[:, None]
    gain = steady["log_gain"].exp()
    w2, b2 = steady["w2"] * gain, steady["b2"] * gain
    center = params["window_center"] if "window" in parts else torch.full((6, 1), 0.5, dtype=torch.float64)
    if "window" in parts:
        w2, b2 = windowed(w2, b2, center, params["log_window"], xi)
    wanted = moved(means, params["velocity"], params["acceleration"], center, xi) if "motion" in parts else means

    def pull(own: Tensor, offset: Tensor, x: Tensor) -> list[Tensor | None]:
        total = (own * own.detach().cos()).sum() + 3 * offset.sum() + (x * x.detach().sin()).sum()
        return list(torch.autograd.grad(total, [means, *params.values()], allow_unused=True, retain_graph=True))

    assert isinstance(form, Cosine)
    for name, a, b in zip(["means", *params], pull(form.w2, form.b2, where.means), pull(w2, b2, wanted), strict=True):
        assert (a is None) == (b is None), name
        assert a is None or b is None or torch.allclose(a, b, rtol=1e-10, atol=1e-12), name
