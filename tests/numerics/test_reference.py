"""The float64 reference: its gradients against finite differences, other code for the same forms, and its choice."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import RayCamera
from neuprim.core.errors import BackendUnavailable
from neuprim.core.model.fields import Constant, CustomColour, CustomDensity, RayNet
from neuprim.core.render import RenderSettings, choose_backend, render_lowered
from neuprim.core.render.reference import pixel_ray_directions
from tests import scenes
from tests.backends import BACKENDS, by
from tests.numerics.cases import case


@pytest.mark.parametrize(
    ("edge", "neurons", "hidden", "distance", "near", "sort"),
    [
        (0, 2, None, 3.0, 0.01, "center"),
        (0, 0, None, 3.0, 0.01, "entry"),
        (0, 2, None, 0.4, 0.05, "center"),
        (0, 3, None, 3.0, 2.9, "center"),
        (1, 2, None, 3.0, 0.01, "center"),
        (2, 2, None, 3.0, 0.01, "entry"),
        (2, 0, None, 0.4, 0.05, "center"),
        (1, 2, None, 0.4, 0.05, "center"),
        (2, 3, None, 3.0, 2.9, "center"),
        (0, 2, 3, 3.0, 0.01, "center"),
        (0, 2, 2, 0.4, 0.05, "entry"),
        (0, 2, 1, 3.0, 2.9, "center"),
    ],
)
def test_gradients_are_finite_differences(
    edge: int, neurons: int, hidden: int | None, distance: float, near: float, sort: str
) -> None:
    """Soft edges need no floor on grazing rays."""
    t = scenes.tensors(4 if hidden else 5, neurons, seed=11, radius=0.4, dtype=torch.float64, hidden=hidden)
    if edge:
        t["b2"] = t["b2"] + 0.5
    camera = scenes.camera(7, 5, distance=distance, fov=50 if distance > 1 else 80, shift=(0.37, -0.21))
    knobs = {"alpha_min": 1e-4} if edge else {"alpha_min": 1e-9, "depth_floor": 1e-14}
    settings = RenderSettings(backend="reference", near=near, depth=hidden is None, sort=sort, **knobs)  # type: ignore[arg-type]
    g = torch.Generator().manual_seed(0)
    names = [k for k in t if t[k].numel()]
    w_rgb = torch.randn(5, 7, 3, generator=g, dtype=torch.float64)
    w_z = torch.randn(5, 7, generator=g, dtype=torch.float64)

    def functional(view: Tensor, background: Tensor, *values: Tensor) -> Tensor:
        with scenes.soft(edge):
            low = scenes.lowered({**t, **dict(zip(names, values, strict=True))})
        out = render_lowered(low, replace(camera, viewmat=view), settings, background)
        total = (out.rgb * w_rgb).sum() + (out.alpha * w_z).sum()
        return total if out.depth is None else total + (out.depth * w_z.flip(0)).sum()

    background = torch.tensor([0.3, 0.5, 0.1], dtype=torch.float64)
    inputs = [camera.viewmat.clone(), background, *(t[k].clone() for k in names)]
    assert render_lowered(scenes.lowered(t), camera, settings).alpha.max() > 0.1
    assert torch.autograd.gradcheck(functional, [x.requires_grad_() for x in inputs], eps=1e-7, atol=2e-6, rtol=1e-5)


def test_custom_forms_draw_what_the_closed_forms_draw() -> None:
    t = scenes.tensors(15, 0, dtype=torch.float64)
    low, camera, settings = scenes.lowered(t), scenes.camera(20, 15), RenderSettings(backend="reference")
    m = low.geometry.length_scale
    density = CustomDensity(lambda prim, o, d, t0, t1: (t1 - t0) * t["b2"][prim, 0] / m[prim])
    colour = CustomColour(lambda prim, x, d: t["colors"][prim], 3)
    assert isinstance(low.colour, Constant)
    first = render_lowered(low, camera, settings).rgb
    assert first.max() > 0.2
    for change in ({"density": density}, {"colour": colour}, {"density": density, "colour": colour}):
        assert (render_lowered(replace(low, **change), camera, settings).rgb - first).abs().max() < 1e-12


def network_in_the_scene(t: dict[str, Tensor]) -> CustomColour:
    """The colour network's formula from chord middles in scene units."""
    m = t["log_scales"].amax(1).exp()

    def radiance(prim: Tensor, x: Tensor, d: Tensor) -> Tensor:
        local = (x - t["means"][prim]) / m[prim, None]
        waves = torch.cos(torch.einsum("mhj,mj->mh", t["Wx"][prim], local) + t["bias"][prim])
        return (t["base"][prim] + torch.einsum("mch,mh->mc", t["Wout"][prim], waves)).clamp_min(0)

    return CustomColour(radiance, t["base"].shape[1])


@pytest.mark.parametrize("sort", ["center", "entry"])
def test_a_colour_network_is_its_formula(sort: str) -> None:
    t, camera = scenes.tensors(30, 3, seed=5, dtype=torch.float64, hidden=4), scenes.camera(30, 22)
    low, s = scenes.lowered(t), RenderSettings(backend="reference", sort=sort)  # type: ignore[arg-type]
    assert isinstance(low.colour, RayNet) and low.colour.channels == 3 and low.colour.hidden == 4
    other = replace(low, colour=network_in_the_scene(t))
    for settings in (s, replace(s, near=2.9), replace(s, samples=2)):
        a, b = (render_lowered(x, camera, settings).rgb for x in (low, other))
        assert a.max() > 0.2 and (a - b).abs().max() < 1e-12
    rays = RayCamera(camera.viewmat, pixel_ray_directions(camera))
    assert choose_backend(low, RenderSettings(), rays).name == "reference"
    near = replace(s, near=1e-6)
    a, b = render_lowered(low, rays, near).rgb, render_lowered(low, camera, near).rgb
    # ray cameras order by distance and pinholes by depth, which few pixels tell apart
    assert ((a - b).abs().amax(-1) < 1e-12).double().mean() > (0.98 if sort == "entry" else 0.9)


def test_silhouettes_of_soft_edges_need_no_floor() -> None:
    """dI/dD goes as D^(p - 1/2): the floor that tames a hard edge changes nothing."""
    t, camera, settings = case("many small")
    for backend in BACKENDS:
        for edge in (0, 2):
            grads = []
            for floor in (1e-12, 1e-2):
                leaves = {k: v.clone().requires_grad_() for k, v in t.items()}
                knobs = replace(settings, **by(backend), depth=False, depth_floor=floor)
                with scenes.soft(edge):
                    render_lowered(scenes.lowered(leaves), camera, knobs).rgb.sum().backward()
                assert leaves["means"].grad is not None and bool(torch.isfinite(leaves["means"].grad).all())
                grads.append(leaves["means"].grad)
            assert torch.equal(*grads) == (edge > 0), (backend, edge)


OPAQUE = CustomDensity(lambda prim, o, d, t0, t1: t1 - t0)


def test_forms_without_a_kernel_go_to_the_reference() -> None:
    low, net = scenes.lowered(scenes.tensors(3)), scenes.lowered(scenes.tensors(3, hidden=2))
    assert choose_backend(low, RenderSettings()).name == choose_backend(net, RenderSettings()).name == "cpu"
    assert choose_backend(replace(low, density=OPAQUE), RenderSettings()).name == "reference"
    colour = CustomColour(lambda prim, x, d: x, 3)
    assert choose_backend(replace(low, colour=colour), RenderSettings()).name == "reference"
    for form, named in ((low, "CustomDensity density"), (net, "CustomDensity density, RayNet colour")):
        with pytest.raises(BackendUnavailable, match=named):
            render_lowered(replace(form, density=OPAQUE), scenes.camera(8, 8), RenderSettings(backend="cpu"))
