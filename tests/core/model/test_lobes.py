"""Colours of spherical Gaussian lobes: all implementations against the equation in float64, extremes, and the field."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core.errors import FormError
from neuprim.core.model import lobes
from neuprim.core.model.colour_constants import LOG_LIMIT, SHORTEST
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.tasks.static import SphericalLobes
from tests import scenes

pytestmark = pytest.mark.usefixtures("either_way")

Inputs = dict[str, Tensor]
NAMES = ("means", "dc", "amplitude", "axis", "log_sharpness", "origin")


def on_warp(**tensors: Tensor) -> Tensor:
    """The GPU's kernels: on a card where there is one, else on Warp's CPU blocks."""
    pytest.importorskip("warp", reason="the cuda backend's kernels need Warp")
    from neuprim.core.model.colours_warp import fused_lobe_colors

    place = "cuda" if torch.cuda.is_available() else "cpu"
    return fused_lobe_colors(**{name: tensor.to(place) for name, tensor in tensors.items()}).cpu()


EVERY = pytest.mark.parametrize("kernels", [lobes.lobe_colors, on_warp])


def equation(x: Inputs) -> Tensor:
    """As written: float64, by logarithms and angles, without any of the module's functions."""
    offset = x["means"] - x["origin"]
    d, m = offset / offset.norm(dim=-1, keepdim=True), x["axis"] / x["axis"].norm(dim=-1, keepdim=True)
    weight = (x["log_sharpness"].exp() * ((m * d[:, None]).sum(-1) - 1)).exp()
    base = x["dc"] / (2 * math.sqrt(math.pi)) + 0.5
    return torch.relu(base + torch.einsum("nl,nlc->nc", weight, x["amplitude"]))


def drawn(count: int, number: int, channels: int, seed: int) -> Inputs:
    """Float32 numbers, as float64."""
    g = torch.Generator().manual_seed(seed)
    shapes = ((count, 3), (count, channels), (count, number, channels), (count, number, 3), (count, number), (3,))
    return {name: torch.randn(s, generator=g).double() for name, s in zip(NAMES, shapes, strict=True)}


def single(x: Inputs) -> Inputs:
    return {name: value.clone() if name == "origin" else value.float() for name, value in x.items()}


def gradients(colours: Callable[..., Tensor], x: Inputs, pull: Tensor) -> tuple[Tensor, Inputs]:
    leaves = {name: value.clone().requires_grad_() for name, value in x.items()}
    found = colours(**leaves)
    (found * pull.to(found)).sum().backward()
    return found.detach(), {name: value.grad for name, value in leaves.items() if value.grad is not None}


@EVERY
@pytest.mark.parametrize(("number", "channels"), [(1, 3), (2, 1), (3, 5), (8, 3)])
def test_values_and_gradients_are_those_of_the_equation(
    kernels: Callable[..., Tensor], number: int, channels: int
) -> None:
    """Also of the camera's position, and for colours that are cut off at zero."""
    x = drawn(60, number, channels, number)
    pull = torch.randn(60, channels, generator=torch.Generator().manual_seed(9)).double()
    wanted, exact = gradients(lambda **y: equation(y), x, pull)
    found, made = gradients(kernels, single(x), pull)
    assert bool((wanted == 0).any()) and torch.allclose(found.double(), wanted, rtol=1e-6, atol=1e-6)
    assert made.keys() == exact.keys() == set(NAMES)
    for name, value in exact.items():
        assert torch.allclose(made[name].double(), value, rtol=1e-5, atol=2e-6 * float(value.abs().max())), name


def test_float64_tensors_have_the_gradients_of_finite_differences() -> None:
    x = drawn(4, 2, 2, 3)
    leaves = tuple(value.requires_grad_() for value in x.values())
    assert torch.autograd.gradcheck(lambda *y: lobes.lobe_colors(*y), leaves, atol=1e-7)


# ---------------------------------------------------------------- extremes

_X, _Y = torch.tensor([1.0, 0.0, 0.0]), torch.tensor([0.0, 1.0, 0.0])
DIRECTIONS = {"equal": _X, "opposite": -_X, "across": _Y, "nearly equal": torch.tensor([1.0, 1e-4, 0.0])}
SHARPNESS = (0.0, 1e-12, 1e-8, 1.0, 1e4, 1e8, 1e30)
LENGTHS = (0.0, 1e-30, 1e-20, 1.0, 1e18, 1e20)
DISTANCES = (0.0, 1e-30, 1e-20, 1.0, 1e6)
AMPLITUDES = (0.0, 1e-6, 1.0, -1.0, 1e6, -1e6)


def extremes() -> Inputs:
    """Every combination, one lobe each; the origin is the camera."""
    rows = [
        (direction, s, length, far, a)
        for direction in DIRECTIONS.values()
        for s in SHARPNESS
        for length in LENGTHS
        for far in DISTANCES
        for a in AMPLITUDES
    ]
    turn = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).double())[0]
    means = torch.stack([far * turn[0] for _, _, _, far, _ in rows])
    axis = torch.stack([length * (direction.double() @ turn) for direction, _, length, _, _ in rows])
    logs = torch.tensor([math.log(s) if s else -math.inf for _, s, _, _, _ in rows]).clamp(-1e30, 1e30)
    a = torch.tensor([row[-1] for row in rows])
    x = {
        "means": means, "dc": torch.zeros(len(rows), 3), "amplitude": a[:, None, None].expand(-1, 1, 3),
        "axis": axis[:, None], "log_sharpness": logs[:, None], "origin": torch.zeros(3),
    }  # fmt: skip
    return {name: value.float().double() for name, value in x.items()}


def bounded(x: Inputs) -> Inputs:
    """The numbers that the documented limits leave: no direction for what is too short, logarithms within 20."""
    return {**x, "log_sharpness": x["log_sharpness"].clamp(-LOG_LIMIT, LOG_LIMIT)}


def limited_equation(x: Inputs) -> Tensor:
    """The equation where a vector without direction is zero."""

    def unit(v: Tensor) -> Tensor:
        length = v.norm(dim=-1, keepdim=True)
        return torch.where(length > SHORTEST, v / length, torch.zeros(()).double())

    m, d = unit(x["axis"]), unit(x["means"] - x["origin"])
    weight = (x["log_sharpness"].exp() * ((m * d[:, None]).sum(-1) - 1).clamp_max(0)).exp()
    return torch.relu(0.5 + (weight[..., None] * x["amplitude"]).sum(1))


@EVERY
def test_extremes(kernels: Callable[..., Tensor]) -> None:
    """Values within 2e-6 of the largest term; gradients finite, within 1e-5 where float64 says what they are."""
    x = extremes()
    pull = torch.ones(len(x["dc"]), 3).double()
    found, made = gradients(kernels, single(x), pull)
    wanted = limited_equation(bounded(x))
    scale = 1 + x["amplitude"].abs().amax((1, 2))
    # a direction in float32 is off by 1e-7, which a sharp lobe multiplies by the root of its sharpness
    error = (found.double() - wanted).abs().amax(1) / scale
    assert float(error.max()) < 2e-6
    assert all(bool(torch.isfinite(value).all()) for value in made.values())
    twin, exact = gradients(lobes.lobe_colors, bounded(x), pull)
    assert torch.allclose(found.double(), twin, rtol=1e-6, atol=1e-6)
    inside = x["log_sharpness"].abs() <= LOG_LIMIT
    exact["log_sharpness"] = torch.where(inside, exact["log_sharpness"], 0.0)
    for name in ("means", "dc", "amplitude", "axis", "log_sharpness"):
        rows, other = (value.double().reshape(len(scale), -1) for value in (made[name], exact[name]))
        # rounding of a cosine near 1 leaves 1e-16 of the sharpness beside the root of it that a gradient has
        unit = _gradient_scale(name, x)
        assert float(((rows - other).abs().amax(1) / (unit + other.abs().amax(1))).max()) < 1e-5, name


def _gradient_scale(name: str, x: Inputs) -> Tensor:
    """(N,) the largest gradient that an amplitude, a sharpness and a length allow."""
    size = 1 + x["amplitude"].abs().amax((1, 2))
    if name in ("means", "axis"):
        vectors = x["means"] if name == "means" else x["axis"][:, 0]
        s = x["log_sharpness"][:, 0].clamp(-LOG_LIMIT, LOG_LIMIT).exp()
        size = size * s.sqrt().clamp_min(s) / vectors.norm(dim=-1).clamp_min(SHORTEST)
    return size


@EVERY
@pytest.mark.parametrize("name", NAMES)
def test_numbers_that_are_not_finite_are_not_hidden(kernels: Callable[..., Tensor], name: str) -> None:
    for value in (math.nan, math.inf, -math.inf):
        if math.isinf(value) and (name == "log_sharpness" or (name in ("dc", "amplitude") and value < 0)):
            continue  # beyond the limit, which is a number; below zero, where colours are cut off
        x = single(drawn(3, 2, 3, 0))
        x["dc"] += 10
        x[name].reshape(-1)[0] = value
        assert not bool(torch.isfinite(kernels(**x)[0]).all())


def test_what_does_not_fit_is_refused() -> None:
    x = single(drawn(4, 2, 3, 0))
    for name, value, words in (
        ("axis", x["axis"][:, :1], r"axis has shape \(4, 1, 3\); expected \(4, 2, 3\), as means has N=4 and amplitude"),
        ("log_sharpness", x["log_sharpness"].long(), "log_sharpness has dtype torch.int64"),
        ("origin", torch.zeros(2), r"origin has shape \(2,\)"),
    ):
        with pytest.raises(FormError, match=rf"^lobes.lobe_colors: {words}"):
            lobes.lobe_colors(**{**x, name: value})
    with pytest.raises(FormError, match="amplitude has 9 lobes; expected at most 8"):
        lobes.lobe_colors(**single(drawn(4, 9, 3, 0)))


# ---------------------------------------------------------------- the field


def fresh(number: int, channels: int = 3, seed: int = 0) -> Primitives:
    colors = torch.rand(20, channels, generator=torch.Generator().manual_seed(1))
    means = scenes.tensors(20, seed=2)["means"]
    context = InitContext(means, torch.full((20,), 0.1), colors, torch.Generator().manual_seed(seed))
    return Primitives.initialise(CosineDensity(2), SphericalLobes(number, channels), context)


def seen(model: Primitives) -> Tensor:
    form: Any = model.lower(scenes.camera(distance=3.0), {}).colour
    colours: Tensor = form.rgb
    return colours


@pytest.mark.parametrize("number", [0, 1, 8])
@pytest.mark.parametrize("channels", [1, 3, 5])
def test_initial_colour_is_the_given_one(number: int, channels: int) -> None:
    model = fresh(number, channels)
    assert torch.allclose(seen(model), torch.rand(20, channels, generator=torch.Generator().manual_seed(1)), atol=1e-6)
    assert model.colour.script() and len(model.colour.parameters()) == (4 if number else 1)


def test_axes_are_those_of_the_seed_and_all_differ() -> None:
    first, again, other = (fresh(3, seed=seed).params[lobes.AXIS] for seed in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)
    assert torch.allclose(first.norm(dim=-1), torch.ones(20, 3))
    flat = first.reshape(-1, 3)
    assert float((flat @ flat.T - 2 * torch.eye(60)).max()) < 1 - 1e-4
    assert float(flat.mean(0).norm()) < 0.3


def moved(number: int) -> Primitives:
    model = fresh(number)
    g = torch.Generator().manual_seed(4)
    for name in (lobes.AMPLITUDE, lobes.AXIS, lobes.LOG_SHARPNESS):
        model.params[name] = torch.randn(model.params[name].shape, generator=g)
    model.params["sh_dc"] += 10  # far from where colours are cut off
    return model


def test_fewer_lobes_leave_their_mean_and_those_that_vary_most_stay() -> None:
    model = moved(4)
    model.params[lobes.AXIS][0, 1] = 0
    g = torch.Generator().manual_seed(5)
    views = torch.nn.functional.normalize(torch.randn(400, 3, generator=g).double(), dim=-1)

    def around(field: SphericalLobes, params: dict[str, Tensor]) -> Tensor:
        """(views, N, C) colours from all sides."""
        none, still = torch.zeros(20, field.lobes, 3), torch.zeros(20, 3)
        own = (params.get(lobes.AMPLITUDE, none), params.get(lobes.AXIS, none))
        logs = params.get(lobes.LOG_SHARPNESS, none[..., 0])
        return torch.stack([lobes.lobe_colors(still, params["sh_dc"], *own, logs, -view) for view in views]).double()

    colour = model.colour
    assert isinstance(colour, SphericalLobes)
    whole = around(colour, model.params)
    for keep in (3, 2, 1, 0):
        field, params = colour.reduce(model.of(colour), model.geometry, "lobes", keep)
        fewer = around(field, params)
        first = {name: model.params[name][:, :keep] for name in (lobes.AMPLITUDE, lobes.AXIS, lobes.LOG_SHARPNESS)}
        naive = around(field, {**model.params, **first})
        spread = float(whole.std(0).mean())
        assert float((fewer.mean(0) - whole.mean(0)).abs().mean()) < 0.1 * spread
        assert float((fewer - whole).square().mean()) < 0.7 * float((naive - whole).square().mean())


@pytest.mark.parametrize("settings", [{"lobes": 9}, {"lobes": -1}, {"lobes": 1.0}, {"lobes": True}, {"channels": 0}])
def test_other_settings_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected"):
        SphericalLobes(**settings)
