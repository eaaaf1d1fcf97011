"""Central cameras that are no pinholes, against the pinhole, the closed form of a sphere, and finite differences."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.cameras.pinhole import RayCamera
from neuprim.core.errors import BackendUnavailable, DataError
from neuprim.core.render import RenderSettings, choose_backend, render, render_lowered
from neuprim.core.render.reference import _PreparedPrimitives, frame_rays, pixel_ray_directions
from tests import scenes

EYE = torch.eye(4, dtype=torch.float64)
SETTINGS = RenderSettings(depth=True)


def ball(center: tuple[float, float, float], radius: float, density: float) -> dict[str, Tensor]:
    """One sphere of constant density (optical depth per scene unit: ``density``), float64."""
    t = scenes.tensors(1, 0, dtype=torch.float64)
    t["means"] = torch.tensor([center], dtype=torch.float64)
    t["log_scales"][:] = math.log(radius)
    t["b2"][:] = density * radius
    t["colors"][:] = 1.0
    return t


def same_rays(camera: Camera) -> RayCamera:
    return RayCamera(camera.viewmat, pixel_ray_directions(camera))


def orders_agree(t: dict[str, Tensor], camera: Camera) -> bool:
    center = t["means"].double() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return torch.equal(center[:, 2].argsort(stable=True), center.norm(dim=1).argsort(stable=True))


def test_a_pinhole_s_own_rays_draw_the_pinhole_s_image() -> None:
    """Primitives along the optical axis: both orders agree, and no chord reaches either near limit."""
    t = scenes.tensors(12, 4, seed=2, radius=0.3, dtype=torch.float64)
    camera = scenes.camera(45, 37, fov=50)
    axis = camera.position / 3
    t["means"] = torch.linspace(-1.2, 1.2, 12, dtype=torch.float64)[:, None] * axis + 0.05 * t["means"]
    assert orders_agree(t, camera)
    grads, outs = [], []
    for view in (camera, same_rays(camera)):
        leaves = {k: v.clone().requires_grad_() for k, v in t.items()}
        matrix = camera.viewmat.clone().requires_grad_()
        out = render_lowered(
            scenes.lowered(leaves), replace(view, viewmat=matrix), replace(SETTINGS, backend="reference")
        )
        (out.rgb.square().sum() + out.alpha.sum()).backward()
        outs.append(out)
        grads.append([matrix.grad, *(v.grad for v in leaves.values())])
    first, second = outs
    assert first.alpha.max() > 0.9
    assert torch.equal(first.rgb, second.rgb) and torch.equal(first.alpha, second.alpha)
    for a, b in zip(*grads, strict=True):
        assert a is not None and b is not None and torch.equal(a, b)
    assert first.depth is not None and second.depth is not None
    one = {
        k: v[5:6] for k, v in t.items()
    }  # of one primitive, depths along the ray and along z differ by the ray's slope
    z, distance = (
        render_lowered(scenes.lowered(one), v, replace(SETTINGS, backend="reference")).depth
        for v in (camera, same_rays(camera))
    )
    assert z is not None and distance is not None and z.max() > 1
    assert torch.allclose(distance * pixel_ray_directions(camera)[..., 2], z, rtol=1e-12)


@pytest.mark.parametrize("kind", ["equirectangular", "fisheye"])
def test_every_direction_of_a_ball_round_the_camera(kind: str) -> None:
    """Off the centre of a ball of radius 2 the chord ahead has a closed form; near cuts its first tenth."""
    t = ball((0.3, -0.5, 0.4), 2.0, 0.7)
    camera = (
        RayCamera.equirectangular(64, 40, EYE) if kind == "equirectangular" else RayCamera.fisheye(40, 40, EYE, 360)
    )
    out = render_lowered(scenes.lowered(t), camera, replace(SETTINGS, near=0.1))
    assert out.stats.backend == "reference" and out.depth is not None
    ray = camera.directions.norm(dim=-1) > 0
    assert bool(ray.all()) == (kind == "equirectangular")
    along = camera.directions @ t["means"][0]
    end = along + (along.square() + 4 - t["means"][0].square().sum()).sqrt()
    alpha = 1 - (-0.7 * (end - 0.1)).exp()
    assert (out.alpha - alpha)[ray].abs().max() < 1e-12 and out.alpha[ray].min() > 0.5
    assert (out.depth - (end + 0.1) / 2)[ray].abs().max() < 1e-12
    assert out.alpha[~ray].abs().sum() == 0


@pytest.mark.parametrize("kind", ["equirectangular", "fisheye"])
def test_blocks_leave_out_nothing_that_is_hit(kind: str) -> None:
    """A whole image equals its pixels drawn one by one, and the cull of the blocks does leave most primitives out."""
    t = scenes.tensors(60, 0, seed=4, radius=0.2, dtype=torch.float64)
    t["means"] *= 3
    view = look_at(torch.tensor([0.3, 0.2, 0.1]), torch.tensor([1.0, 0.4, 0.2]), torch.tensor([0.0, 0.0, 1.0]))
    camera = (
        RayCamera.equirectangular(70, 40, view) if kind == "equirectangular" else RayCamera.fisheye(70, 50, view, 300)
    )
    low = scenes.lowered(t)
    whole = render_lowered(low, camera, SETTINGS)
    assert (whole.alpha > 0.05).double().mean() > 0.1
    with torch.no_grad():
        seen = frame_rays(camera, low.geometry, _PreparedPrimitives(low, camera).center, 0.01)
        everything, corner = seen.rays, seen.block(0, 0, 16, 16)
    assert everything.directions.shape == (camera.height, camera.width, 3) and len(corner[1]) < 40
    for y, x in [(y, x) for y in range(0, camera.height, 3) for x in range(0, camera.width, 5)]:
        pixel = replace(camera, directions=camera.directions[y : y + 1, x : x + 1])
        assert torch.allclose(render_lowered(low, pixel, SETTINGS).rgb[0, 0], whole.rgb[y, x], rtol=0, atol=1e-13), (
            y,
            x,
        )


def test_gradients_are_finite_differences() -> None:
    """To the primitives, the pose and the rays themselves (a lens to calibrate), on a panorama from inside the
    primitives."""
    t = scenes.tensors(4, 2, seed=11, radius=0.5, dtype=torch.float64)
    camera = RayCamera.equirectangular(
        8, 4, look_at(torch.tensor([0.2, 0.1, 0.0]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    )
    settings = RenderSettings(backend="reference", near=0.05, alpha_min=1e-9, depth_floor=1e-14, depth=True)
    g = torch.Generator().manual_seed(0)
    w = torch.randn(4, 8, 5, generator=g, dtype=torch.float64)
    names = list(t)

    def functional(view: Tensor, bend: Tensor, *values: Tensor) -> Tensor:
        d = camera.directions + bend
        bent = RayCamera(view, d / d.norm(dim=-1, keepdim=True))
        out = render_lowered(scenes.lowered(dict(zip(names, values, strict=True))), bent, settings)
        assert out.depth is not None
        return (torch.cat([out.rgb, out.alpha[..., None], out.depth[..., None]], -1) * w).sum()

    inputs = [camera.viewmat.clone(), torch.zeros(4, 8, 3, dtype=torch.float64), *(t[k].clone() for k in names)]
    assert render_lowered(scenes.lowered(t), camera, settings).alpha.min() > 0.01
    assert torch.autograd.gradcheck(functional, [x.requires_grad_() for x in inputs], eps=1e-7, atol=2e-6, rtol=1e-5)


def test_only_the_reference_draws_them() -> None:
    low, camera = scenes.lowered(scenes.tensors(3)), RayCamera.fisheye(8, 8, EYE)
    assert choose_backend(low, RenderSettings(), camera).name == "reference"
    assert render_lowered(low, camera, RenderSettings()).stats.backend == "reference"
    with pytest.raises(BackendUnavailable, match=r"backend=cpu cannot draw a RayCamera.*backend=reference"):
        render_lowered(low, camera, RenderSettings(backend="cpu"))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: RayCamera(EYE[:3], torch.ones(2, 2, 3)),
            r"RayCamera\.viewmat.*expected a 4x4 matrix of finite numbers",
        ),
        (lambda: RayCamera(EYE * 2, torch.ones(2, 2, 3)), r"RayCamera\.viewmat.*expected a rotation"),
        (lambda: RayCamera(EYE, torch.ones(2, 3)), r"directions has shape \(2, 3\); expected \(H, W, 3\)"),
        (lambda: RayCamera(EYE, torch.ones(0, 2, 3)), r"one pixel or more"),
        (lambda: RayCamera(EYE, torch.ones(1, 2, 3)), r"pixel \(x=0, y=0\).*length 1\.73.*expected length 1"),
        (lambda: RayCamera(EYE, torch.full((1, 1, 3), float("nan"))), r"pixel \(x=0, y=0\).*nan"),
        (lambda: RayCamera.fisheye(4, 4, EYE, 361.0), r"fov_degrees=361\.0; expected a number in \(0, 360\]"),
        (lambda: RayCamera.fisheye(0, 4, EYE), r"fisheye: image size 0x4"),
        (lambda: RayCamera.equirectangular(4, -1, EYE), r"equirectangular: image size 4x-1"),
    ],
)
def test_impossible_cameras_are_refused(make: object, message: str) -> None:
    with pytest.raises(DataError, match=message):
        make()  # type: ignore[operator]


def test_entry_order_is_by_distance() -> None:
    """Two overlapping spheres whose centres and entries disagree: behind the camera, where z would turn the order
    round."""
    t = {k: v.double() for k, v in scenes.tensors(2, 0).items()}
    t["means"] = torch.tensor([[0.0, 0.0, -3.0], [0.0, 0.0, -3.5]], dtype=torch.float64)
    t["log_scales"] = torch.tensor([[0.5] * 3, [1.5] * 3], dtype=torch.float64).log()
    t["quats"], t["b2"] = torch.tensor([[1.0, 0, 0, 0]] * 2).double(), torch.full((2, 1), 3.0, dtype=torch.float64)
    t["colors"] = torch.tensor([[1.0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)
    camera = RayCamera(torch.eye(4, dtype=torch.float64), torch.tensor([[[0.0, 0.0, -1.0]]], dtype=torch.float64))
    images = {
        s: render_lowered(scenes.lowered(t), camera, RenderSettings(sort=s)).rgb[0, 0] for s in ("center", "entry")
    }  # type: ignore[arg-type]
    assert images["center"][0] > 0.9 > 0.1 > images["center"][1]  # the red centre is nearer,
    assert images["entry"][1] > 0.9 > 0.1 > images["entry"][0]  # the green sphere is entered at 2.0, the red one at 2.5


def test_a_task_s_model_through_a_fisheye() -> None:
    """``render`` lowers view-dependent colours for such a camera as for any other."""
    from neuprim.core.model.cosine import CosineDensity
    from neuprim.core.model.primitives import Primitives
    from neuprim.tasks.static import SphericalHarmonics

    t = ball((0.0, 0.0, -2.0), 0.5, 3.0)
    params = {k: t[k].float() for k in ("means", "log_scales", "quats", "W1", "b1", "w2", "b2")}
    colour = {"sh_dc": torch.zeros(1, 3), "sh_rest": torch.zeros(1, 3, 3)}
    colour["sh_rest"][0, 1] = 0.5  # the band of z
    model = Primitives(CosineDensity(neurons=0), SphericalHarmonics(1), {**params, **colour})
    seen = [
        render(
            model,
            RayCamera.fisheye(21, 21, look_at(torch.tensor([0, 0, z]), torch.zeros(3), torch.tensor([1.0, 0, 0])), 360),
        )
        for z in (1.0, -5.0)
    ]
    first, second = ((o.rgb.sum((0, 1)) / o.alpha.sum())[0].item() for o in seen)
    assert abs(first - second) > 0.3, "the colour depends on the side it is seen from"
