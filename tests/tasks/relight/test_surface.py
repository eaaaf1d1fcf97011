"""Colours of surfaces under a point light: all implementations against the equation in float64, extremes, the field."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core.errors import FormError
from neuprim.core.model.colour_constants import LOG_LIMIT
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.render import RenderSettings, render
from neuprim.tasks.relight.surface import SurfaceColour, surface_colors
from neuprim.tasks.relight.surface_constants import SHORTEST
from tests import scenes

pytestmark = pytest.mark.usefixtures("either_way")

Inputs = dict[str, Tensor]
NAMES = ("means", "sizes", "normal", "albedo", "highlight", "log_gloss", "indirect", "light", "eye")


def on_warp(**tensors: Tensor) -> Tensor:
    """The GPU's kernels: on a card where there is one, else on Warp's CPU blocks."""
    pytest.importorskip("warp", reason="the cuda backend's kernels need Warp")
    from neuprim.tasks.relight.surface_warp import fused_surface_colors

    place = "cuda" if torch.cuda.is_available() else "cpu"
    return fused_surface_colors(*(tensors[name].to(place) for name in NAMES)).cpu()


EVERY = pytest.mark.parametrize("kernels", [surface_colors, on_warp])


def equation(x: Inputs) -> Tensor:
    """As written: float64, without any of the module's functions."""
    n = x["normal"] / x["normal"].norm(dim=-1, keepdim=True)
    l, v = (torch.nn.functional.normalize(x[place] - x["means"], dim=-1) for place in ("light", "eye"))
    h = torch.nn.functional.normalize(l + v, dim=-1)
    cosine, near = (n * l).sum(-1), (n * h).sum(-1) - 1
    diffuse = torch.relu(x["albedo"]) * (cosine / 2 + torch.hypot(cosine, torch.tensor(0.1)) / 2)[:, None]
    lobe = (x["log_gloss"].exp() * near[:, None]).exp() / (1 + (-20 * cosine).exp())[:, None]
    direct = diffuse + torch.einsum("nl,nlc->nc", lobe, torch.relu(x["highlight"]))
    ones = torch.cat([torch.ones(len(l), 1), l], 1)[:, : x["indirect"].shape[1]]
    return torch.stack([direct, torch.relu(torch.einsum("nb,nbc->nc", ones, x["indirect"]))], 1)


def drawn(count: int, lobes: int, numbers: int, channels: int, seed: int) -> Inputs:
    """Float32 numbers, as float64."""
    g = torch.Generator().manual_seed(seed)
    N, C = count, channels
    shapes = ((N, 3), (N,), (N, 3), (N, C), (N, lobes, C), (N, lobes), (N, numbers, C), (3,), (3,))
    found = {name: torch.randn(s, generator=g).double() for name, s in zip(NAMES, shapes, strict=True)}
    return found | {"sizes": found["sizes"].abs() + 0.1, "light": 3 * found["light"], "eye": 3 * found["eye"]}


def single(x: Inputs) -> Inputs:
    return {name: value.clone() if name in ("light", "eye") else value.float() for name, value in x.items()}


def gradients(colours: Callable[..., Tensor], x: Inputs, pull: Tensor) -> tuple[Tensor, Inputs]:
    leaves = {name: value.clone().requires_grad_(name != "sizes") for name, value in x.items()}
    found = colours(**leaves)
    (found * pull.to(found)).sum().backward()
    return found.detach(), {name: value.grad for name, value in leaves.items() if value.grad is not None}


@EVERY
@pytest.mark.parametrize(("lobes", "numbers", "channels"), [(0, 0, 3), (1, 1, 1), (2, 4, 3), (8, 4, 5)])
def test_values_and_gradients_are_those_of_the_equation(
    kernels: Callable[..., Tensor], lobes: int, numbers: int, channels: int
) -> None:
    """Also of the light's and the camera's position, and for colours that are cut off at zero."""
    if kernels is on_warp and not lobes:
        pytest.skip("left to torch code")
    x = drawn(60, lobes, numbers, channels, lobes)
    pull = torch.randn(60, 2, channels, generator=torch.Generator().manual_seed(9)).double()
    wanted, exact = gradients(lambda **y: equation(y), x, pull)
    found, made = gradients(kernels, single(x), pull)
    assert torch.allclose(found.double(), wanted, rtol=1e-6, atol=1e-6)
    assert bool((found[:, 1] == 0).any()) == (numbers != 4 or bool((wanted[:, 1] == 0).any()))
    for name, value in exact.items():
        if value.numel():
            assert torch.allclose(made[name].double(), value, rtol=1e-5, atol=2e-6 * float(value.abs().max())), name


def test_float64_tensors_have_the_gradients_of_finite_differences() -> None:
    x = drawn(4, 2, 4, 2, 3)
    leaves = tuple(value.requires_grad_(name != "sizes") for name, value in x.items())
    assert torch.autograd.gradcheck(surface_colors, leaves, atol=1e-7)


# ---------------------------------------------------------------- extremes

TURN = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(1)).double())[0]
"""So that no vector lies on an axis."""
LIGHTS = {
    "above": (0, 0, 1),
    "grazing": (1, 0, 1e-8),
    "below": (0, 0, -1),
    "aside": (0.6, 0, 0.8),
    "opposite to the eye": (-1, 0, -1),
}
DISTANCES = (0.0, 1e-30, 1e-9, 1e-3, 1.0, 1e6, 1e18)
LENGTHS = (0.0, 1e-30, 1e-7, 1.0, 1e18)
SHARPNESS = (0.0, 1e-8, 1.0, 1e4, 1e30)


def extremes(light: tuple[float, float, float], distance: float) -> Inputs:
    """Every combination of a normal's length, a sharpness and an amplitude, at the origin, of size 1."""
    rows = list(itertools.product(LENGTHS, SHARPNESS, (0.0, 1e-6, 1e6, -1.0)))
    lengths, sharpness, a = torch.tensor(rows, dtype=torch.float64).unbind(1)
    N = len(rows)
    x = {
        "means": torch.zeros(N, 3), "sizes": torch.ones(N), "normal": lengths[:, None] * TURN[2],
        "albedo": a[:, None].expand(-1, 3), "highlight": a[:, None, None].expand(-1, 1, 3),
        "log_gloss": sharpness.clamp_min(1e-300).log()[:, None], "indirect": a[:, None, None].expand(-1, 4, 3),
        "light": distance * torch.tensor(light, dtype=torch.float64) @ TURN,
        "eye": torch.tensor([1.0, 0, 1]).double() @ TURN,
    }  # fmt: skip
    return {name: value.float().double() for name, value in x.items()}


@EVERY
@pytest.mark.parametrize("distance", DISTANCES)
@pytest.mark.parametrize("light", LIGHTS)
def test_extremes(kernels: Callable[..., Tensor], light: str, distance: float) -> None:
    """Values within 2e-6 of the largest term, gradients finite and within 1e-5 of float64's, which no limit rounds."""
    x = extremes(LIGHTS[light], distance)
    pull = torch.ones(len(x["sizes"]), 2, 3).double()
    found, made = gradients(kernels, single(x), pull)
    twin, exact = gradients(surface_colors, x, pull)
    scale = 1 + x["albedo"].abs().amax(1)
    assert float(((found.double() - twin).abs().amax((1, 2)) / scale).max()) < 2e-6
    usual = (x["normal"].norm(dim=-1) > SHORTEST) & (x["log_gloss"][:, 0].abs() <= LOG_LIMIT)
    if 2 * SHORTEST < distance < 1e10 and light != "opposite to the eye":
        wanted = equation(x)
        assert float(((found.double() - wanted).abs().amax((1, 2)) / scale)[usual].max()) < 2e-6
    for name in ("means", "normal", "albedo", "highlight", "log_gloss", "indirect", "light", "eye"):
        assert bool(torch.isfinite(made[name]).all()), name
        if name in ("light", "eye"):
            continue
        rows, other = (value.double().reshape(len(scale), -1) for value in (made[name], exact[name]))
        size = other.abs().amax(1) + scale * (x["log_gloss"][:, 0].clamp(-LOG_LIMIT, LOG_LIMIT).exp() + 1)
        assert float(((rows - other).abs().amax(1) / size).max()) < 1e-5, name


@EVERY
@pytest.mark.parametrize("name", NAMES)
def test_numbers_that_are_not_finite_are_not_hidden(kernels: Callable[..., Tensor], name: str) -> None:
    x = single(drawn(3, 2, 4, 3, 0))
    x["albedo"] += 10
    x["highlight"] += 10
    x["indirect"][:, 0] += 100
    x[name].reshape(-1)[0] = math.nan
    assert not bool(torch.isfinite(kernels(**x)[0]).all())


def test_what_does_not_fit_is_refused() -> None:
    x = single(drawn(4, 2, 4, 3, 0))
    for name, value, words in (
        ("normal", x["normal"][:, :2], r"normal has shape \(4, 2\); expected \(4, 3\)"),
        ("log_gloss", x["log_gloss"].long(), "log_gloss has dtype torch.int64"),
        ("light", torch.zeros(2), r"light has shape \(2,\)"),
        ("indirect", x["indirect"][:, :2], "indirect has 2 numbers a channel; expected 0, 1 or 4"),
    ):
        with pytest.raises(FormError, match=rf"^surface_colors: {words}"):
            surface_colors(**{**x, name: value})
    with pytest.raises(FormError, match="highlight has 9 lobes; expected at most 8"):
        surface_colors(**single(drawn(4, 9, 4, 3, 0)))


# ---------------------------------------------------------------- the field


def fresh(lobes: int = 2, indirect: int = 4, visibility: str = "none") -> Primitives:
    g = torch.Generator().manual_seed(2)
    means = torch.nn.functional.normalize(torch.randn(200, 3, generator=g), dim=-1)
    context = InitContext(means, torch.full((200,), 0.1), torch.rand(200, 3, generator=g), g)
    return Primitives.initialise(
        CosineDensity(0, gain=True), SurfaceColour(lobes, indirect, visibility=visibility), context
    )


def lit(model: Primitives, light: tuple[float, float, float] = (0.0, 0.0, 4.0)) -> Tensor:
    conditions = {"light": torch.tensor(light), "light_intensity": torch.ones(3)}
    form: Any = model.lower(scenes.camera(distance=3.0), conditions).colour
    colours: Tensor = form.rgb
    return colours


def test_normals_of_points_on_a_sphere_point_outward() -> None:
    model = fresh()
    normals, means = model.params["normal"], model.params["means"]
    assert float((normals * means).sum(-1).min()) > 0.9


def test_what_faces_the_light_is_bright() -> None:
    model = fresh(indirect=0)
    up = model.params["means"][:, 2]
    bright = lit(model).mean(1) / model.params["c_dc"].mean(1)
    assert float(bright[up > 0.7].min()) > 5 * float(bright[up < -0.7].max())


def test_shadows_leave_indirect_light() -> None:
    """Half of the sphere hides the other; what is dark there keeps exactly the light that no shadow reaches."""
    model, open_ = fresh(0, 1, "primitive"), fresh(0, 1, "none")
    model.params["log_scales"] += 1.0
    open_.params["log_scales"] += 1.0
    found, free = lit(model), lit(open_)
    assert bool((found <= free + 1e-6).all()) and float(found.min()) >= 0.02 - 1e-6
    assert float((free - found).max()) > 1e-3


@pytest.mark.parametrize(("name", "values"), [("lobes", (1, 0)), ("indirect", (1, 0))])
def test_reductions_keep_what_shows_most(name: str, values: tuple[int, ...]) -> None:
    model = fresh()
    model.params["highlight"][:, 0] = 0.0
    field = model.colour
    assert isinstance(field, SurfaceColour) and field.reductions()[name] == values
    own = model.of(field)
    others = {key: value for key, value in model.params.items() if key not in own}
    for value in values:
        fewer, params = field.reduce(own, model.geometry, name, value)
        reduced = Primitives(model.density, fewer, {**others, **params})
        change = (lit(reduced) - lit(model)).abs().max()
        assert (float(change) < 1e-6) == (value == 1)


def test_a_lit_surface_is_rendered_with_gradients_for_all_parameters() -> None:
    model = fresh(visibility="primitive")
    for value in model.params.values():
        value.requires_grad_()
    conditions = {"light": torch.tensor([1.0, 2.0, 4.0]), "light_intensity": torch.ones(3)}
    render(model, scenes.camera(distance=3.0), conditions, RenderSettings()).rgb.square().sum().backward()
    found = [value.grad for value in (model.params["means"], *model.of(model.colour).values())]
    assert len(found) == 6 and all(grad is not None and bool((grad != 0).any()) for grad in found)


@pytest.mark.parametrize(
    "settings",
    [{"lobes": 9}, {"lobes": True}, {"indirect": 2}, {"channels": 0}, {"visibility": "pixel"}, {"typical": 0.0}],
)
def test_other_settings_are_refused(settings: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="expected"):
        SurfaceColour(**settings)
