"""Colours that vary per pixel, :class:`RayNet`: the cpu backend against the float64 reference, the reference against
finite differences."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.projections import RayCamera
from neuprim.core.errors import BackendUnavailable, NonFiniteError
from neuprim.core.model.fields import Constant, CustomColour, CustomDensity, RayNet
from neuprim.core.render import RenderSettings, choose_backend, render_lowered
from neuprim.core.render.reference.rays import pixel_directions
from neuprim.core.render.unsorted_volume import render_unsorted_volume
from tests import scenes
from tests.backends import BACKENDS, FAST, by
from tests.numerics.compare import assert_same_frame, draw

NET = ("Wx", "bias", "Wout", "base")
ORDERS = ("center", "entry")


def along_the_axes(t: dict[str, Tensor], *thin: float) -> dict[str, Tensor]:
    """The same with semi-axes in the given proportions."""
    t["log_scales"] = t["log_scales"].amax(1, keepdim=True) + torch.tensor(thin).log()
    return t


# ---------------------------------------------------------------- fast against reference


@pytest.mark.parametrize("sort", ORDERS)
@pytest.mark.parametrize("channels", [1, 3])
@pytest.mark.parametrize("hidden", [0, 1, 5, 8, 16])
@pytest.mark.parametrize("neurons", [0, 3, 8])
@pytest.mark.parametrize("backend", FAST)
def test_equals_reference(backend: str, neurons: int, hidden: int, channels: int, sort: str) -> None:
    t = scenes.tensors(40, neurons, channels, seed=7, hidden=hidden)
    fast, slow = assert_same_frame(t, scenes.camera(33, 25), RenderSettings(sort=sort), backend=backend)  # type: ignore[arg-type]
    assert slow.output.alpha.max() > 0.3
    assert fast.output.stats.backend == backend and fast.output.stats.extra.get("float64", 0) == 0
    if hidden:
        assert all(slow.grads[k].abs().max() > 1e-3 for k in NET)


CASES: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "depth": ({}, {}, {"depth": True}),
    "depth C=5": ({"channels": 5}, {}, {"depth": True}),
    "off-centre": ({}, {"shift": (19.3, -11.7)}, {}),
    "principal point outside": ({}, {"shift": (-40.0, 5.0)}, {}),
    "inside": ({"count": 90}, {"distance": 0.15, "fov": 70.0}, {"depth": True}),
    "near plane": ({}, {}, {"near": 2.9}),
    "wide": ({}, {"distance": 1.2, "fov": 120.0}, {}),
    "one pixel": ({"count": 30}, {"width": 1, "height": 1, "fov": 5.0}, {}),
    "many small": ({"count": 700, "radius": 0.04, "neurons": 2}, {}, {}),
    "opaque": ({"count": 250, "radius": 0.35, "neurons": 2}, {}, {}),
    "cuts off": ({}, {}, {"alpha_min": 0.0, "transmittance_min": 0.0}),
    "low ceiling": ({}, {}, {"alpha_max": 0.2}),
    "two rays a side": ({}, {"width": 24, "height": 17}, {"samples": 2}),
    "30 rad over a chord": ({"colour_frequency": 15.0}, {}, {}),
    "100 rad over a chord": ({"colour_frequency": 50.0}, {}, {}),
    "1000 rad over a chord": ({"colour_frequency": 500.0}, {}, {}),
    "1000 rad, inside": ({"colour_frequency": 500.0, "count": 90}, {"distance": 0.15, "fov": 70.0}, {}),
    "far 1e3": ({"radius": 0.01, "spread": 0.05}, {"distance": 10.0, "fov": 0.6}, {}),
    "far 1e5": ({"radius": 0.01, "spread": 0.05}, {"distance": 1000.0, "fov": 0.006}, {}),
    "far 1e5, 100 rad": (
        {"radius": 0.01, "spread": 0.05, "colour_frequency": 50.0},
        {"distance": 1000.0, "fov": 0.006},
        {},
    ),
    "needles": ({"axes": (1.0, 0.02, 0.03), "radius": 0.5}, {}, {}),
    "discs": ({"axes": (1.0, 0.9, 0.01)}, {}, {}),
    "needles, inside": (
        {"axes": (1.0, 0.02, 0.03), "radius": 0.5},
        {"distance": 0.5, "fov": 60.0},
        {"depth_floor": 1e-3},
    ),
    "thin discs, far": (
        {"seed": 10, "axes": (1.0, 0.8, 1e-3), "radius": 0.01, "spread": 0.05, "denser": 50.0},
        {"distance": 100.0, "fov": 0.06},
        {},
    ),
}


def case(name: str) -> tuple[dict[str, Tensor], Camera, RenderSettings]:
    model, view, knobs = CASES[name]
    model = {"seed": 7, "hidden": 8, **model}
    spread, axes, denser = model.pop("spread", 1.0), model.pop("axes", None), model.pop("denser", 1.0)
    t = scenes.tensors(**model)
    t["means"] *= spread
    t["b2"] *= denser  # thin discs have short chords
    if axes:
        t = along_the_axes(t, *axes)
    return t, scenes.camera(**{"width": 40, "height": 29, **view}), RenderSettings(**knobs)


# at distance/radius 1e5 entries differ by less than float32 knows of their depth
@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize(("name", "sort"), [(n, s) for n in CASES for s in ORDERS if s == "center" or "1e5" not in n])
def test_extremes(name: str, sort: str, backend: str) -> None:
    t, camera, settings = case(name)
    fast, slow = assert_same_frame(t, camera, replace(settings, sort=sort), backend=backend)  # type: ignore[arg-type]
    assert slow.output.alpha.max() > 0.1, "the view must show something"
    if " rad" in name:  # float32 knows the slower phases well enough, the others not
        assert (fast.output.stats.extra["float64"] > 30) == ("30 rad" not in name)


def test_cases_mean_what_they_say() -> None:
    """Colours really vary within a primitive, and really are clamped here and there but not everywhere."""
    t, camera, settings = case("depth")
    one = {k: v[:1] for k, v in t.items()}
    one["means"], one["b2"] = one["means"] * 0, one["b2"] * 0 + 1.0
    rgb = render_lowered(scenes.lowered(one), camera, settings)
    seen = rgb.alpha > 0.1
    colours = rgb.rgb[seen] / rgb.alpha[seen][:, None]
    assert (colours.amax(0) - colours.amin(0)).max() > 0.2
    black = colours < 1e-6
    assert 0.01 < black.float().mean() < 0.9


def test_any_number_of_threads_gives_the_same_bits() -> None:
    t, camera = scenes.tensors(1500, 5, seed=3, radius=0.06, hidden=5), scenes.camera(100, 70)
    for sort in ORDERS:
        frames = [draw("cpu", t, camera, RenderSettings(sort=sort, threads=n)) for n in (1, 2, 3)]  # type: ignore[arg-type]
        for other in frames[1:]:
            assert torch.equal(frames[0].output.rgb, other.output.rgb)
            for name, grad in frames[0].grads.items():
                assert torch.equal(grad, other.grads[name]), name
        assert frames[0].output.alpha.max() > 0.5


# ---------------------------------------------------------------- constants


@pytest.mark.parametrize("sort", ORDERS)
@pytest.mark.parametrize("hidden", [0, 3])
def test_without_units_or_weights_it_is_the_constant(hidden: int, sort: str) -> None:
    t = scenes.tensors(40, 4, seed=2, hidden=hidden)
    t["Wout"] *= 0
    camera, plain = scenes.camera(33, 25), {k: v for k, v in t.items() if k not in NET}
    plain["colors"] = t["base"].clamp_min(0)
    assert 0.02 < (t["base"] < 0).float().mean() < 0.5
    for backend in BACKENDS:
        net, constant = (draw(backend, x, camera, RenderSettings(sort=sort)) for x in (t, plain))  # type: ignore[arg-type]
        assert (net.output.rgb - constant.output.rgb).abs().max() < 1e-6
        for name in ("means", "log_scales", "quats", "W1", "b1", "w2", "b2", "viewmat"):
            assert torch.allclose(net.grads[name], constant.grads[name], rtol=1e-3, atol=1e-5), name
        shown = t["base"] >= 0
        assert torch.allclose(net.grads["base"], constant.grads["colors"] * shown, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("sort", ORDERS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_negative_colours_are_black_and_pass_no_gradient(backend: str, sort: str) -> None:
    t = scenes.tensors(40, 4, seed=2, hidden=5)
    t["base"] -= 10.0
    leaves = {k: v.requires_grad_() for k, v in t.items()}
    out = render_lowered(scenes.lowered(leaves), scenes.camera(33, 25), RenderSettings(**by(backend), sort=sort))  # type: ignore[arg-type]
    assert out.alpha.max() > 0.3 and out.rgb.abs().max() == 0
    out.rgb.sum().backward()
    assert all(v.grad is not None and v.grad.abs().max() == 0 for v in leaves.values())


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_network_that_starts_at_zero_can_learn(backend: str) -> None:
    """A colour of exactly 0 is not clamped."""
    t = scenes.tensors(20, 2, seed=2, hidden=3)
    t["Wout"] *= 0
    t["base"] *= 0
    leaves = {k: v.requires_grad_() for k, v in t.items()}
    out = render_lowered(scenes.lowered(leaves), scenes.camera(33, 25), RenderSettings(**by(backend)))
    out.rgb.sum().backward()
    seen = leaves["base"].grad
    assert (
        seen is not None
        and (seen > 0.1).any()
        and leaves["Wout"].grad is not None
        and leaves["Wout"].grad.abs().max() > 0.1
    )


# ---------------------------------------------------------------- the reference


@pytest.mark.parametrize(
    ("hidden", "distance", "near", "sort"), [(3, 3.0, 0.01, "center"), (2, 0.4, 0.05, "entry"), (1, 3.0, 2.9, "center")]
)
def test_reference_gradients_are_finite_differences(hidden: int, distance: float, near: float, sort: str) -> None:
    t = scenes.tensors(4, 2, seed=11, radius=0.4, dtype=torch.float64, hidden=hidden)
    camera = scenes.camera(6, 5, distance=distance, fov=50 if distance > 1 else 80, shift=(0.37, -0.21))
    settings = RenderSettings(backend="reference", near=near, alpha_min=1e-9, depth_floor=1e-14, sort=sort)  # type: ignore[arg-type]

    def image(view: Tensor, *values: Tensor) -> Tensor:
        return render_lowered(
            scenes.lowered(dict(zip(t, values, strict=True))), replace(camera, viewmat=view), settings
        ).rgb

    inputs = [camera.viewmat.clone(), *(v.clone() for v in t.values())]
    assert image(*inputs).max() > 0.1
    assert torch.autograd.gradcheck(image, [x.requires_grad_() for x in inputs], eps=1e-7, atol=2e-6, rtol=1e-5)


def as_opaque(t: dict[str, Tensor]) -> CustomColour:
    """The formula, from chord middles in the scene."""
    m = t["log_scales"].amax(1).exp()

    def radiance(prim: Tensor, x: Tensor, d: Tensor) -> Tensor:
        local = (x - t["means"][prim]) / m[prim, None]
        waves = torch.cos(torch.einsum("mhj,mj->mh", t["Wx"][prim], local) + t["bias"][prim])
        return (t["base"][prim] + torch.einsum("mch,mh->mc", t["Wout"][prim], waves)).clamp_min(0)

    return CustomColour(radiance, t["base"].shape[1])


@pytest.mark.parametrize("sort", ORDERS)
def test_the_formula_in_the_scene(sort: str) -> None:
    t, camera = scenes.tensors(30, 3, seed=5, dtype=torch.float64, hidden=4), scenes.camera(30, 22)
    low, s = scenes.lowered(t), RenderSettings(backend="reference", sort=sort)  # type: ignore[arg-type]
    assert isinstance(low.colour, RayNet) and low.colour.channels == 3 and low.colour.hidden == 4
    other = replace(low, colour=as_opaque(t))
    for settings in (s, replace(s, near=2.9), replace(s, samples=2)):
        a, b = (render_lowered(x, camera, settings).rgb for x in (low, other))
        assert a.max() > 0.2 and (a - b).abs().max() < 1e-12
    assert (
        render_unsorted_volume(low, camera, s, steps=4).rgb - render_unsorted_volume(other, camera, s, steps=4).rgb
    ).abs().max() < 1e-12


def test_a_ray_camera_sees_the_same() -> None:
    t, camera = scenes.tensors(30, 3, seed=5, dtype=torch.float64, hidden=4), scenes.camera(30, 22)
    rays = RayCamera(camera.viewmat, pixel_directions(camera))
    low = scenes.lowered(t)
    assert choose_backend(low, RenderSettings(), rays).name == "reference"
    s = RenderSettings(backend="reference", sort="entry", near=1e-6)
    a, b = render_lowered(low, rays, s).rgb, render_lowered(low, camera, s).rgb
    # entries are ordered by distance here and by depth there, which few pixels tell apart
    assert ((a - b).abs().amax(-1) < 1e-12).double().mean() > 0.98


# ---------------------------------------------------------------- choice and refusals


def test_the_kernels_know_the_form() -> None:
    low = scenes.lowered(scenes.tensors(3, hidden=2))
    assert choose_backend(low, RenderSettings()).name == "cpu"
    with pytest.raises(BackendUnavailable, match="CustomDensity density, RayNet colour"):
        choose_backend(
            replace(low, density=CustomDensity(lambda prim, o, d, t0, t1: t1 - t0)), RenderSettings(backend="cpu")
        )
    assert isinstance(scenes.lowered(scenes.tensors(3)).colour, Constant)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", NET)
def test_not_a_number_is_refused_by_name(name: str, value: float, backend: str) -> None:
    t = scenes.tensors(20, hidden=3)
    t[name][13].view(-1)[-1] = value
    with pytest.raises(NonFiniteError, match=rf"\b{name} of primitive 13\b"):
        render_lowered(scenes.lowered(t), scenes.camera(20, 20), RenderSettings(**by(backend)))


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", NET)
def test_denormals_and_huge_phases_are_drawn(name: str, backend: str) -> None:
    for value in (1e-42, 1e30 if name in ("Wx", "bias") else 1e6):
        leaves = {k: v.requires_grad_() for k, v in scenes.tensors(20, hidden=3).items()}
        with torch.no_grad():
            leaves[name][5] = value
        out = render_lowered(scenes.lowered(leaves), scenes.camera(20, 20), RenderSettings(**by(backend)))
        assert torch.isfinite(out.rgb).all() and out.alpha.max() > 0.2
        out.rgb.sum().backward()
        assert all(v.grad is not None and torch.isfinite(v.grad).all() for v in leaves.values())


@pytest.mark.parametrize("backend", BACKENDS)
def test_no_primitives_at_all(backend: str) -> None:
    leaves = {k: v[:0].clone().requires_grad_() for k, v in scenes.tensors(2, hidden=3).items()}
    sky = torch.tensor([0.5, 0.25, 1.0])
    out = render_lowered(scenes.lowered(leaves), scenes.camera(20, 17), RenderSettings(**by(backend)), sky)
    assert torch.equal(out.rgb, sky.expand(17, 20, 3))


def test_only_colours_may_learn() -> None:
    """Geometry and density without gradients: the network's are the same."""
    t, camera = scenes.tensors(30, 3, seed=5, hidden=4), scenes.camera(30, 22)
    both = []
    for names in (tuple(t), NET):
        leaves = {k: v.clone().requires_grad_(k in names) for k, v in t.items()}
        render_lowered(scenes.lowered(leaves), camera, RenderSettings()).rgb.square().sum().backward()
        both.append([leaves[k].grad for k in NET])
    assert all(torch.equal(a, b) for a, b in zip(*both, strict=True) if a is not None and b is not None)


@pytest.mark.parametrize("backend", FAST)
def test_double_precision_models(backend: str) -> None:
    t, camera = scenes.tensors(30, 3, seed=5, hidden=4), scenes.camera(30, 22)
    wide = {k: v.double().requires_grad_() for k, v in t.items()}
    out = render_lowered(scenes.lowered(wide), camera, RenderSettings(**by(backend)))
    assert out.rgb.dtype == torch.float64
    out.rgb.sum().backward()
    assert wide["Wx"].grad is not None and wide["Wx"].grad.dtype == torch.float64
    assert (out.rgb - render_lowered(scenes.lowered(t), camera, RenderSettings(**by(backend))).rgb).abs().max() < 2e-6
