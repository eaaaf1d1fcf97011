"""Fields that do with less of something: what stays is as it was, and as close to the whole as it can be."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.model import sh
from neuprim.core.model.cosine import OMEGA0, CosineDensity, cosine_density, prune_cosine_neurons
from neuprim.core.model.fields import Field
from neuprim.core.model.gaussian import GaussianDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.relight.colour import LightHarmonics, LightNetwork
from neuprim.tasks.relight.surface import SurfaceColour
from neuprim.tasks.static import SphericalHarmonics, SphericalLobes
from tests.core.model.shaken import CONDITIONS, COUNT, camera, made

PAIRS = [
    (CosineDensity(8, edge=2, gain=True), SphericalHarmonics(3)),
    (TimeDensity(6, "phase+offset+window+motion"), TimeHarmonics(2)),
    (CosineDensity(5), LightHarmonics(4)),
    (CosineDensity(1), SurfaceColour(3)),
    (CosineDensity(1), SphericalLobes(3)),
    (GaussianDensity(), LightNetwork(4, visibility="none")),
    (CosineDensity(0), LightNetwork(6, form="multiplicative", visibility="none")),
]


def level(field: Field, name: str) -> int:
    """How much it has of what a reduction names; a part of time is there or not."""
    settings = field.settings()
    return int(settings[name]) if name in settings else int(name in settings["time"].split("+"))


def reduced(model: Primitives) -> Iterator[tuple[str, str, int, Primitives]]:
    for kind in ("density", "colour"):
        field = getattr(model, kind)
        for name, values in field.reductions().items():
            for value in values:
                fewer, tensors = field.reduce(model.of(field), model.geometry, name, value)
                own = {spec.name for spec in field.parameters()}
                others = {key: tensor for key, tensor in model.params.items() if key not in own}
                fields = (fewer, model.colour) if kind == "density" else (model.density, fewer)
                yield kind, name, value, Primitives(*fields, {**others, **tensors})


@pytest.mark.parametrize(("density", "colour"), PAIRS, ids=lambda field: type(field).__name__)
def test_every_reduction_is_a_model_that_can_be_stored_and_drawn(density: Field, colour: Field) -> None:
    model = made(density, colour)
    found = list(reduced(model))
    for kind, name, value, smaller in found:
        field = getattr(smaller, kind)
        assert level(field, name) == value, (kind, name)
        again = type(field)(**field.settings())
        assert [(s.name, s.shape) for s in again.parameters()] == [(s.name, s.shape) for s in field.parameters()]
        assert smaller.parameters_per_primitive < model.parameters_per_primitive
        smaller.lower(camera(), CONDITIONS).check()
        values = getattr(model, kind).reductions()[name]
        assert values == tuple(sorted(values, reverse=True)) and all(
            v < level(getattr(model, kind), name) for v in values
        )
    offered = {(kind, name) for kind, name, _, _ in found}
    assert offered == {(kind, name) for kind in ("density", "colour") for name in getattr(model, kind).reductions()}


# ---------------------------------------------------------------- bands


def test_dropped_bands_are_the_basis_cut_off() -> None:
    model = made(*PAIRS[0])
    field, params = SphericalHarmonics(3).reduce(model.of(model.colour), model.geometry, "degree", 1)
    origin = camera().position
    seen = field.lower(params, model.geometry, camera(), {}).rgb
    whole = sh.sh_colors(model.params["means"], model.params["sh_dc"], model.params["sh_rest"], origin, 1)
    assert torch.equal(seen, whole) and params["sh_rest"].shape == (COUNT, 3, 3)


# ---------------------------------------------------------------- neurons


def inside(geometry: Geometry, count: int, generator: torch.Generator) -> Tensor:
    """(N, count, 3) points, uniform in each ellipsoid."""
    y = torch.randn((geometry.count, count, 3), generator=generator, dtype=torch.float64)
    radius = torch.rand((geometry.count, count, 1), generator=generator, dtype=torch.float64) ** (1 / 3)
    y = geometry.scales.double()[:, None] * y / y.norm(dim=-1, keepdim=True) * radius
    return geometry.means.double()[:, None] + (geometry.rotations.double()[:, None] @ y[..., None])[..., 0]


def sigma(model: Primitives, x: Tensor, conditions: Mapping[str, Tensor] = CONDITIONS) -> Tensor:
    """(N, count) densities."""
    n, count, _ = x.shape
    form = model.density.lower(model.of(model.density), model.geometry, conditions)
    wide = Geometry(*(model.params[name].double() for name in ("means", "log_scales", "quats")))
    prim = torch.arange(n).repeat_interleave(count)
    return cosine_density(form, wide, prim, x.reshape(-1, 3)).reshape(n, count)


def test_dropped_neurons_leave_their_mean_and_those_that_stay_matter_most() -> None:
    model = made(CosineDensity(8), SphericalHarmonics(0), noise=0.05)
    model.params["log_scales"] += torch.tensor([0.0, -0.7, 0.4])
    x = inside(model.geometry, 4000, torch.Generator().manual_seed(2))
    whole = sigma(model, x)
    for keep in (6, 4, 2, 0):
        params = prune_cosine_neurons(model.of(model.density), model.geometry, keep, OMEGA0)
        smaller = Primitives(CosineDensity(keep), model.colour, {**model.params, **params})
        left = sigma(smaller, x)
        scale = whole.std(1)
        assert ((left - whole).mean(1) / scale).abs().max() < 0.1, "the mean over the ellipsoid stays, but for sampling"
        first = {name: model.params[name][:, :keep] for name in ("b1", "w2")} | {"W1": model.params["W1"][:, :keep]}
        naive = Primitives(CosineDensity(keep), model.colour, {**model.params, **first})
        assert (left - whole).square().mean() < (0.8 if keep else 1.0) * (sigma(naive, x) - whole).square().mean()


def test_means_of_phases_that_advance_are_those_over_the_sequence() -> None:
    model = made(TimeDensity(3, "phase"), SphericalHarmonics(0), noise=0.02)
    model.params["W_t"] *= 3
    x = inside(model.geometry, 1500, torch.Generator().manual_seed(2))
    params = prune_cosine_neurons(model.of(model.density), model.geometry, 0, OMEGA0)
    means = torch.stack([sigma(model, x, {"time": t}).mean(1) for t in torch.linspace(0, 1, 41)])
    mean = torch.trapezoid(means, dx=1 / 40, dim=0)
    amplitude = model.params["w2"].abs().sum(1) / model.geometry.length_scale
    assert ((mean * model.geometry.length_scale - params["b2"][:, 0]).abs() / amplitude.clamp_min(1e-6)).median() < 0.05


# ---------------------------------------------------------------- time


@pytest.mark.parametrize("name", ["powers", "waves"])
def test_fewer_terms_in_time_are_closer_than_terms_cut_off(name: str) -> None:
    model = made(*PAIRS[1])
    colour = model.colour
    assert isinstance(colour, TimeHarmonics)
    whole = model.of(colour)
    field, params = colour.reduce(whole, model.geometry, name, 2)
    cut = TimeHarmonics(**{**colour.settings(), name: 2})
    rows = {"time_poly": 2} if name == "powers" else {"time_cos": 2, "time_sin": 2}
    naive = {key: value[:, : rows[key]] if key in rows else value for key, value in whole.items()}
    fitted = plain = 0.0
    for time in torch.linspace(0.01, 0.99, 50):
        there, _ = colour.harmonics(whole, {"time": time})
        fitted += float((field.harmonics(params, {"time": time})[0] - there).square().mean())
        plain += float((cut.harmonics(naive, {"time": time})[0] - there).square().mean())
    assert fitted < 0.5 * plain


def in_time(time: str, neurons: int = 4) -> Primitives:
    """A density that varies in time, quietly enough for its mean to mean something."""
    return made(TimeDensity(neurons, time), TimeHarmonics(0, powers=0, waves=0), noise=0.05)


def test_a_still_phase_is_the_mean_of_the_moving_one() -> None:
    model = in_time("phase")
    density = model.density
    field, params = density.reduce(model.of(density), model.geometry, "phase", 0)
    assert field.settings()["time"] == "none" and "W_t" not in params
    prim, x = torch.arange(COUNT), model.params["means"] + 0.01
    times = (torch.arange(400) + 0.5) / 400
    moving = [density.density(model.of(density), model.geometry, prim, x, {"time": t}) for t in times]
    mean = torch.stack(moving).mean(0)
    still = field.density(params, model.geometry, prim, x, CONDITIONS)
    assert torch.allclose(still, mean, rtol=1e-3, atol=1e-3 * float(mean.abs().max()))


def test_without_windows_primitives_are_as_dense_as_they_are_in_the_mean() -> None:
    model = in_time("window", 2)
    density = model.density
    _, params = density.reduce(model.of(density), model.geometry, "window", 0)
    times = (torch.arange(400) + 0.5) / 400
    for name in ("w2", "b2"):
        lowered = [getattr(density.lower(model.of(density), model.geometry, {"time": t}), name) for t in times]
        assert torch.allclose(params[name], torch.stack(lowered).mean(0), atol=1e-4)


@pytest.mark.parametrize("time", ["motion", "window+motion"])
def test_without_motion_primitives_stand_in_their_mean_place(time: str) -> None:
    model = in_time(time, 0)
    density = model.density
    field, params = density.reduce(model.of(density), model.geometry, "motion", 0)
    times = (torch.arange(400) + 0.5) / 400
    places = torch.stack([density.move(model.of(density), model.geometry, {"time": t}).means for t in times])
    weights = torch.ones(400, COUNT)
    if "window" in time:
        u = (times[:, None] - model.params["window_center"][None, :, 0]) / model.params["log_window"][None, :, 0].exp()
        weights = (1 - u * u).clamp_min(0).square()
    alive = weights.sum(0) > 0
    mean = (weights[..., None] * places).sum(0) / weights.sum(0).clamp_min(1e-9)[:, None]
    assert bool(alive.any()) and torch.allclose(params["means"][alive], mean[alive], atol=1e-3)
    assert field.settings()["time"] == time.replace("motion", "").strip("+") or field.settings()["time"] == "none"


# ---------------------------------------------------------------- networks of light


@pytest.mark.parametrize("form", ["additive", "multiplicative"])
def test_fewer_units_leave_the_mean_colour_behind(form: str) -> None:
    model = made(CosineDensity(0), LightNetwork(6, form=form, visibility="none", boost=2.0), noise=0.2)
    model.params["c_dc"] = model.params["c_dc"].abs() + 3.0  # far from where colours are cut at zero
    if form == "multiplicative":
        model.params["net_out"] *= 0.3
    colour = model.colour
    generator = torch.Generator().manual_seed(3)
    field, params = colour.reduce(model.of(colour), model.geometry, "hidden", 0)
    few, fewer = colour.reduce(model.of(colour), model.geometry, "hidden", 3)

    def seen(field: Field, params: dict[str, Tensor], view: Tensor, light: Tensor) -> Tensor:
        eye = Camera(look_at(1e3 * view, torch.zeros(3), torch.tensor([0.0, 0.3, 1.0])), 20.0, 20.0, 8.0, 8.0, 16, 16)
        form = field.lower(params, model.geometry, eye, {"light": 1e3 * light, "light_intensity": torch.tensor(1.0)})
        return form.base + (form.Wout * form.bias.cos()[:, None]).sum(-1)

    whole = mean = off = off_few = 0.0
    for _ in range(400):
        view, light = (torch.nn.functional.normalize(torch.randn(3, generator=generator), dim=0) for _ in range(2))
        here = seen(colour, model.of(colour), view, light)
        whole, mean = whole + here, mean + seen(field, params, view, light)
        off += float((here - seen(field, params, view, light)).square().mean())
        off_few += float((here - seen(few, fewer, view, light)).square().mean())
    spread = float((model.params["net_out"].abs().sum(-1) * (3 if form == "multiplicative" else 1)).mean())
    assert float((whole - mean).abs().mean()) / 400 < 0.1 * spread
    assert off_few < off
