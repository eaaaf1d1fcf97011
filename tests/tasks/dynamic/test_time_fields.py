"""Densities and colours that change in time."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.model.cosine import OMEGA0, CosineDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.layer_frame import LayerFrame
from neuprim.core.render.output import Contributions
from neuprim.core.train.population import RelocatePopulation, split_population
from neuprim.core.train.settings import PopulationSettings
from neuprim.tasks.dynamic import TASK, invisible_fraction_over_time
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TIME_PARTS, TimeDensity
from tests import scenes
from tests.backends import BACKENDS, by
from tests.chords import chords
from tests.timed_models import COUNT, model

VARIANTS = [
    "none",
    *("+".join(c) for n in range(1, len(TIME_PARTS) + 1) for c in itertools.combinations(TIME_PARTS, n)),
]


def at(time: float) -> dict[str, Tensor]:
    return {"time": torch.tensor(time)}


def sigma(m: Primitives, params: dict[str, Tensor], prim: Tensor, x: Tensor, time: float) -> Tensor:
    own = {s.name: params[s.name].detach() for s in m.density.parameters()}
    geometry = Geometry(*(params[n].detach() for n in ("means", "log_scales", "quats")))
    return m.density.density(own, geometry, prim, x, at(time))


# ---------------------------------------------------------------- what is stored


@pytest.mark.parametrize(("degree", "expected"), [(3, 143), (0, 98)])
def test_equation_13_has_the_papers_number_of_parameters(degree: int, expected: int) -> None:
    m = Primitives.initialise(TimeDensity(8, "phase"), TimeHarmonics(degree), _context(5))
    assert m.parameters_per_primitive == expected


@pytest.mark.parametrize("wrong", ["phases", "phase+", "phase+phase", "", "window motion"])
def test_unknown_variants_are_refused(wrong: str) -> None:
    with pytest.raises(ValueError, match="expected none or some of phase, offset, window, motion"):
        TimeDensity(8, wrong)


def _context(count: int, **settings: object) -> InitContext:
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator)
    times = {"time": torch.linspace(0, 1, count)}
    return InitContext(means, torch.full((count,), 0.1), torch.full((count, 3), 0.5), generator, settings, times)


def test_windows_start_when_their_points_were_seen() -> None:
    m = Primitives.initialise(TimeDensity(8, "window"), TimeHarmonics(0), _context(5, window=0.25))
    assert torch.equal(m.params["window_center"][:, 0], torch.linspace(0, 1, 5))
    assert torch.allclose(m.params["log_window"].exp(), torch.tensor(0.25))


# ---------------------------------------------------------------- one frame


def test_phase_is_equation_13() -> None:
    m = model("phase")
    own = {k: v.detach() for k, v in m.of(m.density).items()}
    static = CosineDensity(4)
    shifted = {**{k: own[k] for k in ("W1", "w2", "b2")}, "b1": own["b1"] + 0.3 * own["W_t"]}
    prim, x = torch.arange(COUNT), m.params["means"].detach() + 0.01
    expected = static.density(shifted, m.geometry, prim, x, {})
    found = m.density.density(own, m.geometry, prim, x, {"time": torch.tensor(0.3, dtype=torch.float64)})
    assert torch.allclose(found, expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("time", [1e3, -1e6, 1e9])
def test_a_phase_far_outside_the_sequence_keeps_its_digits(time: float) -> None:
    m = model("phase", dtype=torch.float32)
    own = {k: v.detach() for k, v in m.of(m.density).items()}
    found = m.density.lower(own, m.geometry, {"time": torch.tensor(time, dtype=torch.float64)})
    exact = OMEGA0 * (own["b1"].double() + time * own["W_t"].double())
    assert torch.allclose((OMEGA0 * found.b1.double()).cos(), exact.cos(), atol=2e-6 + abs(time) * 1e-14)


@pytest.mark.parametrize("time", VARIANTS)
def test_every_variant_draws_finite_images_at_and_beyond_the_ends(time: str) -> None:
    m = model(time, dtype=torch.float32)
    for t in (0.0, 0.5, 1.0, 40.0, -40.0):
        assert bool(torch.isfinite(render(m, scenes.camera(), at(t)).rgb).all())


def test_primitives_outside_their_window_are_left_out_and_nothing_changes() -> None:
    m = model("window+motion", dtype=torch.float32)
    camera, settings = scenes.camera(), RenderSettings(alpha_min=0.0)
    rows = m.density.active_rows(m.of(m.density), at(0.5))
    assert rows is not None and 0 < len(rows) < COUNT
    lowered = m.lower(camera, at(0.5))
    assert lowered.geometry.count == len(rows)
    culled = render(m, camera, at(0.5), settings).rgb
    m.density.active_rows = lambda params, conditions: None  # type: ignore[method-assign]
    assert torch.allclose(culled, render(m, camera, at(0.5), settings).rgb, atol=1e-6)


@pytest.mark.parametrize("backend", BACKENDS)
def test_gradients_reach_living_primitives_and_no_others(backend: str) -> None:
    m = model("phase+offset+window+motion", dtype=torch.float32)
    output = render(m, scenes.camera(), at(0.5), RenderSettings(**by(backend)))
    tally = output.request_contributions(torch.ones(output.rgb.shape[:2]))
    (output.rgb * torch.rand(output.rgb.shape, generator=torch.Generator().manual_seed(1))).sum().backward()
    rows = m.density.active_rows(m.of(m.density), at(0.5))
    assert rows is not None and len(tally.weight) == len(rows)
    weight, _ = tally.of_all(COUNT)
    assert torch.equal(weight[rows], tally.weight)
    dead = torch.ones(COUNT, dtype=torch.bool)
    dead[rows] = False
    assert not bool(weight[dead].any())
    for spec in m.specs:
        grad = m.params[spec.name].grad
        assert grad is not None and not bool(grad[dead].any()), spec.name
        assert bool(grad[~dead].any()), spec.name


@pytest.mark.parametrize("time", ["phase", "offset", "window", "phase+offset+window+motion"])
def test_gradients_of_time_parameters_are_the_derivatives(time: str) -> None:
    m = model(time, neurons=2, count=4)
    names = [s.name for s in m.density.parameters()]
    if "window" in time:  # all of them alive
        m.params["window_center"] = torch.full((4, 1), 0.4, dtype=torch.float64, requires_grad=True)
        m.params["log_window"] = torch.full((4, 1), math.log(0.5), dtype=torch.float64, requires_grad=True)

    def field(*values: Tensor) -> Tensor:
        own = dict(zip(names, values, strict=True))
        return m.density.density(own, m.geometry, torch.arange(4), m.params["means"].detach() + 0.02, at(0.5))

    assert torch.autograd.gradcheck(field, [m.params[n] for n in names])


# ---------------------------------------------------------------- colour


def test_colour_follows_equations_10_to_12() -> None:
    for frequencies, w in (("periods", 2 * math.pi), ("printed", 1.0)):
        field = TimeHarmonics(0, 3, powers=2, waves=2, frequencies=frequencies)
        generator = torch.Generator().manual_seed(0)
        p = {s.name: torch.rand((6, *s.shape), generator=generator, dtype=torch.float64) for s in field.parameters()}
        xi = 0.3
        s = p["sh_dc"] + p["time_poly"][:, 0] * xi + p["time_poly"][:, 1] * xi**2
        s = s + p["time_cos"][:, 0] * math.cos(w * xi) + p["time_cos"][:, 1] * math.cos(2 * w * xi)
        s = s + p["time_sin"][:, 0] * math.sin(w * xi) + p["time_sin"][:, 1] * math.sin(2 * w * xi)
        geometry = Geometry(torch.zeros(6, 3), torch.zeros(6, 3), torch.tensor([[1.0, 0, 0, 0]] * 6))
        found = field.lower(p, geometry, scenes.camera(), {"time": torch.tensor(xi, dtype=torch.float64)}).rgb
        assert torch.allclose(found, (s * 0.28209479177387814 + 0.5).clamp_min(0), atol=1e-12)


# ---------------------------------------------------------------- population


@pytest.mark.parametrize("time", VARIANTS)
def test_a_split_carries_the_field_at_all_times(time: str) -> None:
    m = model(time)
    parents = torch.arange(0, COUNT, 3)
    children = split_population(m, parents, 0.5, 0.6, 0.9)
    rows = torch.arange(2 * len(parents))
    for t in (0.0, 0.37, 1.0):
        own = {s.name: children[s.name] for s in m.density.parameters()}
        place = m.density.move(own, Geometry(*(children[n] for n in ("means", "log_scales", "quats"))), at(t))
        x = place.means + 0.3 * place.scales
        whole = {k: v.detach() for k, v in m.params.items()}
        before = sigma(m, whole, torch.cat([parents, parents]), x, t)
        assert torch.allclose(sigma(m, children, rows, x, t), before, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("time", VARIANTS)
def test_a_clone_halves_the_density_at_all_times(time: str) -> None:
    m = model(time)
    whole = {k: v.detach() for k, v in m.params.items()}
    own = {k: v.detach() for k, v in m.of(m.density).items()}
    half = {**whole, **m.density.scale_density(own, torch.full((COUNT,), 0.5, dtype=torch.float64))}
    for t in (0.1, 0.8):
        x = m.density.move(own, m.geometry, at(t)).means.detach()
        prim = torch.arange(COUNT)
        assert torch.allclose(sigma(m, half, prim, x, t), 0.5 * sigma(m, whole, prim, x, t))


def test_relocation_counts_frames_in_which_a_primitive_lives() -> None:
    m = model("window", dtype=torch.float32)
    population = RelocatePopulation(PopulationSettings(fraction=0.1))
    rows = torch.tensor([2, 5, 7])
    population.observe(m, Contributions(torch.ones(3), torch.tensor([1.0, 9.0, 1.0]), rows))
    change = population.intervene(m, 1.0)
    assert change is not None and int(change.origin[0]) == 5  # the first of the idle ones moved to the busiest


def test_invisible_primitives_are_counted() -> None:
    m = model("window", neurons=0, dtype=torch.float32)
    params = {k: v.detach().clone() for k, v in m.params.items()}
    params["b2"][:] = 1.0
    params["b2"][:3] = -1.0  # never absorbs
    params["window_center"][3:5] = 9.0  # lives after the end
    m.params = params
    params["log_scales"][:] = math.log(0.3)
    times = [torch.tensor(t) for t in torch.linspace(0, 1, 50).tolist()]
    assert invisible_fraction_over_time(m, times) == pytest.approx(5 / COUNT)


@pytest.mark.parametrize(
    ("settings", "step", "expected"),
    [
        ({"window": 0.3, "window_frames": 12}, 0.01, 0.12),
        ({"window": 0.3, "window_frames": 12}, 0.05, 0.3),  # a short sequence
        ({"window": 0.3}, 0.01, 0.3),
        ({"window": 0.3, "window_frames": None}, 0.01, 0.3),
        ({"window": 0.3, "window_frames": 12}, None, 0.3),  # images with a time each
    ],
)
def test_a_fresh_window_is_so_many_frames_at_most(
    settings: dict[str, object], step: float | None, expected: float
) -> None:
    spec = next(spec for spec in TimeDensity(0, "window").parameters() if spec.name == "log_window")
    made = spec.init(replace(_context(7, **settings), steps={} if step is None else {"time": step}))
    assert made.shape == (7, 1) and torch.allclose(made.exp(), torch.tensor(expected), rtol=1e-5)


# ---------------------------------------------------------------- layers


def test_beauty_is_what_is_emitted_less_what_is_absorbed() -> None:
    settings = RenderSettings(alpha_min=0.0, transmittance_min=0.0, alpha_max=0.9999)
    camera = scenes.camera(20, 16, distance=2.6)
    frame = LayerFrame(model("window+motion", count=16, dtype=torch.float32), camera, at(0.4), settings)
    found = chords(frame.lowered, camera)
    colours = frame.lowered.colour.flat
    assert colours is not None and colours.min() >= 0
    emitted = torch.einsum("nhw,nc->hwc", found.tau, colours.double())
    arrived = torch.einsum("nhw,nc->hwc", found.weight, colours.double())
    drawn = [(spec, image) for spec in TASK.layers if (image := spec.draw(frame)) is not None]
    layers = {spec.name: image for spec, image in drawn}  # those of lights are of models that know one
    assert list(layers) == ["emission", "absorption"] and all(spec.light for spec, _ in drawn)
    assert (layers["emission"] - emitted).abs().max() < 1e-5 * emitted.max()
    assert (layers["absorption"] - (emitted - arrived)).abs().max() < 1e-5 * emitted.max()
    assert (layers["emission"] - layers["absorption"] - arrived).abs().max() < 1e-5 * emitted.max()
    assert (emitted - arrived).max() > 0.05 * emitted.max(), "something is absorbed"


def test_motion_is_a_parabola_about_the_middle_of_life() -> None:
    m = model("window+motion")
    own = m.of(m.density)
    since = 0.75 - own["window_center"]
    moved = m.density.move(own, m.geometry, at(0.75)).means
    assert torch.allclose(moved, m.params["means"] + own["velocity"] * since + own["acceleration"] * since**2)
