"""Colour under a light: equation 14, its variants, shadows, and the spherical-harmonics baseline."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.errors import ConfigError
from neuprim.core.light_conditions import parse_light_intensities, parse_light_positions
from neuprim.core.model import sh
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import Cosine, RayNet
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.light import FADE, PIXEL_FADE, extents_towards, light_visibility, shade_by_light
from neuprim.core.train.population import split_population
from neuprim.tasks.relight.colour import FORMS, LightHarmonics, LightNetwork, real_light_harmonics
from tests import scenes
from tests.lit_models import COUNT, light, model

SETTINGS = RenderSettings()


def shade(form: RayNet, local: Tensor) -> Tensor:
    """(N, C) colours at one local point per primitive."""
    hidden = torch.cos((form.Wx * local[:, None]).sum(-1) + form.bias)
    return (form.base + (form.Wout * hidden[:, None]).sum(-1)).clamp_min(0)


def test_equation_14_has_the_papers_number_of_parameters() -> None:
    generator = torch.Generator().manual_seed(0)
    context = InitContext(torch.rand(4, 3), torch.ones(4), torch.rand(4, 3), generator)
    assert Primitives.initialise(CosineDensity(8), LightNetwork(), context).parameters_per_primitive == 158
    assert Primitives.initialise(CosineDensity(8), LightHarmonics(5), context).parameters_per_primitive == 159
    assert Primitives.initialise(CosineDensity(8), LightNetwork(0), context).parameters_per_primitive == 54


@pytest.mark.parametrize("form", FORMS)
def test_the_closed_form_is_the_network(form: str) -> None:
    field = LightNetwork(4, form=form, visibility="none", boost=2.5, falloff=True)
    m = model(field)
    p = {k: v.detach() for k, v in m.of(field).items()}
    camera, c = scenes.camera(), light(strength=1.7)
    found = field.lower(p, m.geometry, camera, c)
    local = 0.3 * torch.randn(COUNT, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    means = m.params["means"].detach()
    d = means - camera.position.double()
    l = c["light"].double() - means
    distance = l.norm(dim=1, keepdim=True)
    d, l = d / d.norm(dim=1, keepdim=True), l / distance
    pairs = zip(("net_x", "net_view", "net_light"), (local, d, l), strict=True)
    inputs = sum((p[name] * value[:, None]).sum(-1) for name, value in pairs)
    hidden = torch.cos(2.5 * (inputs + p["net_phase"]))
    out = (p["net_out"] * hidden[:, None]).sum(-1)
    expected = p["c_dc"] + out if form == "additive" else p["c_dc"] * (1 + out)
    assert torch.allclose(shade(found, local), expected.clamp_min(0) * 1.7 / distance**2, atol=1e-6)


@pytest.mark.parametrize("form", FORMS)
def test_a_split_carries_the_colour(form: str) -> None:
    field = LightNetwork(4, form=form, visibility="none")
    m = model(field)
    parents = torch.arange(COUNT)
    children = split_population(m, parents, 0.5, 0.6, 0.9)
    whole = {k: v.detach() for k, v in m.params.items()}
    for half in (slice(0, COUNT), slice(COUNT, 2 * COUNT)):
        child = {k: v[half] for k, v in children.items()}
        geometry = Geometry(child["means"], child["log_scales"], child["quats"])
        x = geometry.means + 0.4 * geometry.scales
        names = [s.name for s in field.parameters()]
        # one place for the directions, so that only the local part differs
        same = Geometry(whole["means"], geometry.log_scales, geometry.quats)
        after = field.lower({n: child[n] for n in names}, same, scenes.camera(), light())
        before = field.lower({n: whole[n] for n in names}, m.geometry, scenes.camera(), light())
        inside = (x - geometry.means) / geometry.length_scale[:, None]
        outside = (x - whole["means"]) / m.geometry.length_scale.detach()[:, None]
        assert torch.allclose(shade(after, inside), shade(before, outside), atol=1e-9)


@pytest.mark.parametrize("where", [(0.0, 0.0, 0.0), (1e8, 0.0, 1e8), (0.3, 0.2, -50.0)])
@pytest.mark.parametrize("kind", ["none", "primitive", "pixel"])
def test_lights_at_a_centre_at_infinity_and_below_the_ground(where: tuple[float, float, float], kind: str) -> None:
    field = LightNetwork(4, visibility=kind)
    m = model(field, torch.float32)
    c = light(*where)
    if where == (0.0, 0.0, 0.0):
        c["light"] = m.params["means"][3].detach().clone()
    output = render(m, scenes.camera(), c)
    assert bool(torch.isfinite(output.rgb).all()) and bool(output.rgb.any())
    output.rgb.sum().backward()
    assert all(bool(torch.isfinite(v.grad).all()) for v in m.params.values() if v.grad is not None)


# ---------------------------------------------------------------- shadows


def slabs() -> tuple[Geometry, Cosine]:
    """A small opaque ball above the middle of a row of balls on the ground."""
    means = torch.tensor([[0.0, 0.0, 1.0], *([x, 0.0, 0.0] for x in (-1.5, -0.75, 0.0, 0.75, 1.5))])
    count = len(means)
    geometry = Geometry(means, torch.full((count, 3), math.log(0.3)), torch.tensor([[1.0, 0, 0, 0]] * count))
    return geometry, Cosine(
        torch.zeros(count, 0, 3), torch.zeros(count, 0), torch.zeros(count, 0), torch.full((count, 1), 8.0)
    )


def visibility(geometry: Geometry, density: Cosine, light: tuple[float, float, float]) -> Tensor:
    """Of the primitives."""
    shading = shade_by_light("primitive", geometry, density, {"light": torch.tensor(light)}, SETTINGS)
    assert shading is not None and shading.primitives is not None
    return shading.primitives


def test_what_lies_behind_something_is_in_its_shadow() -> None:
    geometry, density = slabs()
    straight = visibility(geometry, density, (0.0, 0.0, 5.0))
    assert float(straight[3]) < 0.05 and bool((straight[[0, 1, 2, 4, 5]] > 0.8).all())
    slanted = visibility(geometry, density, (4.0, 0.0, 1.0 + 4.0 * (1.0 / 0.75)))
    assert float(slanted[2]) < 0.3 and float(slanted[3]) > 0.8


@pytest.mark.parametrize("size", [1.0, 50.0])
def test_light_fades_over_parts_of_the_scene_s_diameter(size: float) -> None:
    """Behind a disc of the greatest opacity, 0.99: all, half and none of the rest is kept."""
    geometry = Geometry(
        torch.zeros(1, 3), (size * torch.tensor([[1.0, 1.0, 1e-4]])).log(), torch.tensor([[1.0, 0, 0, 0]])
    )
    density = Cosine(torch.zeros(1, 0, 3), torch.zeros(1, 0), torch.zeros(1, 0), torch.full((1, 1), 1e6))
    visible = light_visibility(geometry, density, torch.tensor([0.0, 0.0, 4.0 * size]), SETTINGS)
    for more in (0.0, size):
        behind = torch.tensor([0.0, 0.5, 1.0, 3.0]) * (FADE * 2 * size + more)
        points = torch.stack([torch.zeros(4), torch.zeros(4), -behind], -1)
        found = visible(points, FADE, torch.full((4,), more))
        assert torch.allclose(found, torch.tensor([1.0, 0.505, 0.01, 0.01]), atol=0.005)


def test_extents_are_those_between_planes_that_touch() -> None:
    """Of random ellipsoids, by points of their surfaces; one whose centre is the point has none."""
    g = torch.Generator().manual_seed(0)
    geometry = Geometry(torch.randn(5, 3, generator=g), torch.randn(5, 3, generator=g), torch.randn(5, 4, generator=g))
    point = torch.tensor([3.0, -2.0, 5.0])
    sphere = torch.nn.functional.normalize(torch.randn(20000, 3, generator=g), dim=-1)
    surface = torch.einsum("nij,nj,pj->pni", geometry.rotations, geometry.scales, sphere)
    towards = torch.nn.functional.normalize(point - geometry.means, dim=-1)
    wanted = 2 * (surface * towards).sum(-1).amax(0)
    assert torch.allclose(extents_towards(geometry, point), wanted, rtol=0.02)
    assert float(extents_towards(geometry, geometry.means[3])[3]) == 0.0


def test_shadows_carry_no_gradient_and_are_bounded() -> None:
    geometry, density = slabs()
    wanted = Geometry(geometry.means.requires_grad_(), geometry.log_scales, geometry.quats)
    found = visibility(wanted, density, (0.5, 0.2, 4.0))
    assert not found.requires_grad and bool(((found >= 0) & (found <= 1)).all())


def covered_floor(opacity: float, height: float = 1.5) -> tuple[Geometry, Cosine]:
    """An opaque floor of 441 flat discs, and the last primitive, a disc of this opacity above its middle, number
    220."""
    side = torch.linspace(-2, 2, 21)
    means = torch.cat([torch.cartesian_prod(side, side, torch.zeros(1)), torch.tensor([[0.0, 0.0, height]])])
    axes = torch.cat([torch.tensor([[0.25, 0.25, 0.03]]).expand(441, 3), torch.tensor([[0.6, 0.6, 0.05]])])
    offsets = torch.full((442, 1), 20.0)
    offsets[-1] = -math.log1p(-opacity) / 2 * 0.6 / 0.05  # straight through its middle
    geometry = Geometry(means, axes.log(), torch.tensor([[1.0, 0, 0, 0]] * 442))
    return geometry, Cosine(torch.zeros(442, 0, 3), torch.zeros(442, 0), torch.zeros(442, 0), offsets)


@pytest.mark.parametrize("opacity", [0.1, 0.55, 0.9, 0.99])
def test_behind_something_translucent_the_rest_of_the_light_arrives(opacity: float) -> None:
    geometry, density = covered_floor(opacity)
    found = visibility(geometry, density, (0.0, 0.0, 6.0))
    assert float(found[220]) == pytest.approx(1 - opacity, abs=0.005)
    assert float(found[-1]) == 1.0


def test_a_thin_thing_shadows_what_is_close_behind_it() -> None:
    """At a twentieth of the scene's diameter."""
    found = visibility(*covered_floor(0.99, 0.3), (0.0, 0.0, 6.0))
    assert float(found[220]) < 0.05 and float(found[-1]) == 1.0


@pytest.mark.parametrize("light", [(0.0, 0.0, 6.0), (4.0, 0.0, 2.5)])
def test_what_nothing_covers_is_lit_fully(light: tuple[float, float, float]) -> None:
    geometry, density = covered_floor(0.9)
    found = visibility(geometry, density, light)
    towards = torch.tensor(light)[:2] / torch.tensor(light).norm()
    clear = (geometry.means[:, :2] @ towards > 0.3) if light[0] else (geometry.means[:, :2].norm(dim=1) > 1)
    assert int(clear.sum()) > 100 and float(found[clear].min()) > 0.999


@pytest.mark.parametrize("light", [(0.0, 0.0, 0.0), (0.1, -0.05, 0.02)])
def test_a_light_amid_things_casts_shadows_all_around(light: tuple[float, float, float], either_way: str) -> None:
    """Balls along the axes, and along the diagonals, where three maps meet; nothing lies in other directions."""
    place = torch.tensor(light)
    units = torch.nn.functional.normalize(torch.cartesian_prod(*[torch.tensor([-1.0, 0.0, 1.0])] * 3), dim=-1)
    covered = torch.tensor([int((unit != 0).sum()) in (1, 3) for unit in units])
    clear = torch.tensor([int((unit != 0).sum()) == 2 for unit in units])
    count = int(covered.sum())
    assert count == 14
    shape = torch.full((count, 3), math.log(0.2)), torch.tensor([[1.0, 0, 0, 0]] * count)
    density = Cosine(
        torch.zeros(count, 0, 3), torch.zeros(count, 0), torch.zeros(count, 0), torch.full((count, 1), 50.0)
    )
    visible = light_visibility(Geometry(place + units[covered], *shape), density, place, SETTINGS)
    assert float(visible(place + 3.0 * units[covered], FADE).max()) < 0.02
    assert float(visible(place + 0.5 * units[covered], FADE).min()) == 1.0
    assert float(visible(place + 3.0 * units[clear], FADE).min()) > 0.999


@pytest.mark.parametrize("distance", [1e3, 1e8, 1e18])
def test_distant_lights_cast_the_shadows_of_near_ones(distance: float) -> None:
    geometry, density = slabs()
    near, far = (visibility(geometry, density, (0.2 * d, 0.1 * d, d)) for d in (100.0, distance))
    assert float(near.min()) < 0.1 and float(near.max()) > 0.9 and torch.allclose(near, far, atol=0.05)


@pytest.mark.parametrize("polar", [0.0, 40.0, 70.0, 80.0])
def test_a_flat_floor_does_not_shadow_itself(polar: float) -> None:
    """A floor of flat discs, in points between their centres, under light down to 10 degrees above it."""
    side = torch.linspace(-1, 1, 15)
    means = torch.cat([torch.cartesian_prod(side, side), torch.zeros(225, 1)], -1)
    scales = torch.tensor([0.15, 0.15, 0.01]).log().expand(225, 3)
    geometry = Geometry(means, scales, torch.tensor([[1.0, 0, 0, 0]] * 225))
    density = Cosine(torch.zeros(225, 0, 3), torch.zeros(225, 0), torch.zeros(225, 0), torch.full((225, 1), 100.0))
    angle = math.radians(polar)
    light = 4.5 * torch.tensor([math.sin(angle), 0.0, math.cos(angle)])
    inner = torch.rand(500, 2, generator=torch.Generator().manual_seed(0)) * 1.8 - 0.9
    points = torch.cat([inner, torch.zeros(500, 1)], -1).double()
    visible = light_visibility(geometry, density, light, SETTINGS)
    assert float(visible(points, PIXEL_FADE).min()) > 0.9
    below = points - torch.tensor([0.0, 0.0, 0.6], dtype=torch.float64)
    under = below[(below[:, 0] + 0.6 * math.tan(angle)).abs() < 0.8]  # whose light would have to cross the floor
    assert not len(under) or float(visible(under, PIXEL_FADE).max()) < 0.1


def test_the_recurrence_agrees_with_the_renderers_harmonics() -> None:
    d = torch.randn(50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    d = d / d.norm(dim=1, keepdim=True)
    mine, theirs = real_light_harmonics(d, 3), sh.sh_basis(d, 3)
    assert torch.allclose(mine.abs(), theirs.abs(), atol=1e-6)  # signs are a convention


def test_harmonics_are_orthonormal() -> None:
    n = 200_000
    i = torch.arange(n, dtype=torch.float64) + 0.5
    z, phi = 1 - 2 * i / n, i * math.pi * (1 + 5**0.5)
    d = torch.stack([(1 - z * z).sqrt() * phi.cos(), (1 - z * z).sqrt() * phi.sin(), z], -1)
    y = real_light_harmonics(d, 5)
    assert torch.allclose(y.T @ y * (4 * math.pi / n), torch.eye(36, dtype=torch.float64), atol=1e-3)


def test_lights_on_the_command_line() -> None:
    assert parse_light_positions("1,2,3")[0].tolist() == [1, 2, 3]
    round_ = parse_light_positions("orbit:2:90:4")
    assert len(round_) == 4 and round_[1].tolist() == pytest.approx([0, 2, 0], abs=1e-6)
    assert len(parse_light_positions("orbit")) == 60
    assert parse_light_intensities("2")[0].tolist() == [2, 2, 2]


@pytest.mark.parametrize(
    "text", ["1,2", "a,b,c", "nan,0,0", "orbit:0", "orbit:1:2:1", "orbit:1:2:3:4", "", "1e999,0,0"]
)
def test_impossible_lights(text: str) -> None:
    with pytest.raises(ConfigError, match="expected x,y,z or orbit"):
        parse_light_positions(text)


def test_gradients_reach_every_parameter() -> None:
    m = model(LightNetwork(4), torch.float32)
    render(m, scenes.camera(), light(), RenderSettings(backend="cpu")).rgb.square().sum().backward()
    for name, value in m.params.items():
        assert value.grad is not None and bool(value.grad.any()), name


def test_an_orbit_of_the_light_circles_the_upward_direction() -> None:
    for axis, up in enumerate(torch.eye(3, dtype=torch.float64)):
        orbit = torch.stack(parse_light_positions("orbit:2:60:8", World(up=3 * up)))
        assert torch.allclose(orbit[:, axis], torch.ones(8))
        assert torch.allclose(orbit.norm(dim=1), torch.full((8,), 2.0))
        assert torch.linalg.cross(orbit[0], orbit[1])[axis] > 0, "anticlockwise, seen from above"
