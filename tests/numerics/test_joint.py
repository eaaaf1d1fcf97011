"""The joint volume against closed answers, and the errors of sorting against it."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.errors import ConfigError
from neuprim.core.model.densities.cosine import cosine_density
from neuprim.core.model.fields import Constant, Cosine, CustomColour, CustomDensity
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.unsorted_volume import measure_sorting_errors, render_unsorted_volume
from tests import scenes
from tests.numerics.cases import along_z, needle_and_sphere, spheres
from tests.numerics.equivalence import entries

EXACT = RenderSettings(backend="reference", alpha_min=0.0, alpha_max=0.9999, transmittance_min=0.0, depth=True)
SKY = torch.tensor([0.2, 0.4, 0.7], dtype=torch.float64)


def chord_depths(t: dict[str, Tensor], row: int) -> tuple[Tensor, Tensor, Tensor]:
    """(optical depth, camera-z of entry, optical depth per camera-z) of a homogeneous sphere, per pixel of
    :func:`along_z`."""
    camera = along_z()
    one = {k: v[row : row + 1] for k, v in t.items()}
    depth = -torch.log1p(-render_lowered(scenes.lowered(one), camera, EXACT).alpha)
    x = (torch.arange(21, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    norm = (1 + x[None] ** 2 + x[:, None] ** 2).sqrt()
    return depth, entries(one, camera, EXACT.near)[0], norm * t["b2"][row] / t["log_scales"][row, 0].exp()


@pytest.mark.parametrize("neurons", [0, 3])
def test_without_overlap_all_three_agree(neurons: int) -> None:
    """Spheres in a row along the view, apart from each other."""
    t = scenes.tensors(3, neurons, seed=3, dtype=torch.float64)
    t["means"] = torch.tensor([[0.05, 0.0, 0.6], [0.0, 0.05, 0.0], [0.0, 0.0, -0.6]], dtype=torch.float64)
    t["log_scales"] = torch.tensor([[0.25, 0.2, 0.25]], dtype=torch.float64).log().repeat(3, 1)
    t["b2"] += 1.0  # no negative density
    low, camera = scenes.lowered(t), along_z()
    joint = render_unsorted_volume(low, camera, EXACT, SKY, steps=1)
    for sort in ("center", "entry"):
        out = render_lowered(low, camera, replace(EXACT, sort=sort), SKY)
        assert (out.rgb - joint.rgb).abs().max() < 1e-12 and (out.alpha - joint.alpha).abs().max() < 1e-12
    assert joint.alpha.max() > 0.8
    assert (render_unsorted_volume(low, camera, EXACT, SKY, keep="density").rgb - joint.rgb).abs().max() < 1e-12


def test_coincident_spheres() -> None:
    """Equal colours: all three agree. Different colours: the volume shows their mean, either order the first one too
    much."""
    t = spheres([[0.0, 0.0, 0.0]] * 2, [0.6, 0.6], [1.0, 1.0])
    camera = along_z()
    one = 1 - chord_depths(t, 0)[0].neg().exp()
    both = 1 - (1 - one) ** 2
    assert both.max() > 0.8
    joint = render_unsorted_volume(scenes.lowered(t), camera, EXACT, steps=3).rgb
    assert torch.allclose(joint[..., 0], both / 2, atol=1e-12) and torch.allclose(joint[..., 1], both / 2, atol=1e-12)
    first = torch.stack([one, (1 - one) * one], -1)
    for sort in ("center", "entry"):
        out = render_lowered(scenes.lowered(t), camera, replace(EXACT, sort=sort)).rgb
        assert torch.allclose(out[..., :2], first, atol=1e-12)
    errors = measure_sorting_errors(scenes.lowered(t), camera, EXACT, steps=3)
    assert errors["center"].max_abs == pytest.approx((first[..., 0] - both / 2).max().item(), abs=1e-10)
    assert errors["center"] == errors["entry"]
    t["colors"][1] = t["colors"][0]
    same = measure_sorting_errors(scenes.lowered(t), camera, EXACT, steps=3)
    assert max(e.max_abs for e in same.values()) < 1e-12 and min(e.psnr for e in same.values()) > 200


def test_two_overlapping_spheres() -> None:
    """The ray crosses the first alone, both, then the second alone: three homogeneous layers."""
    t = spheres([[0.0, 0.0, 0.0], [0.1, 0.0, 0.5]], [0.6, 0.6], [1.2, 0.7])
    camera = along_z()
    (d0, z0, s0), (d1, z1, s1) = (chord_depths(t, row) for row in (0, 1))
    out0, out1 = z0 + d0 / s0, z1 + d1 / s1
    layered = (z0 < z1) & (z1 < out0) & (out0 < out1) & (out1 < torch.inf)
    assert layered.sum() > 20
    front = s0 * (z1 - z0)
    both0, both1 = s0 * (out0 - z1), s1 * (out0 - z1)
    back = s1 * (out1 - out0)
    both = both0 + both1
    mixed = (-front).exp() * (1 - (-both).exp())
    red = 1 - (-front).exp() + mixed * both0 / both
    green = mixed * both1 / both + (-front - both).exp() * (1 - (-back).exp())
    for steps in (1, 7):
        joint = render_unsorted_volume(scenes.lowered(t), camera, EXACT, steps=steps)
        found = joint.rgb[layered]
        assert torch.allclose(found[:, 0], red[layered], atol=1e-10) and torch.allclose(
            found[:, 1], green[layered], atol=1e-10
        )
        assert torch.allclose(joint.alpha[layered], (1 - (-d0 - d1).exp())[layered], atol=1e-10)


def test_against_a_plain_march_of_the_density() -> None:
    """Sum of clamped point densities at 4,000 points per ray, three overlapping cosine primitives; and convergence in
    ``steps``."""
    t = scenes.tensors(3, 3, seed=8, radius=0.5, dtype=torch.float64)
    t["means"] *= 0.3
    low, camera = scenes.lowered(t), scenes.camera(5, 4)
    assert isinstance(low.density, Cosine)
    points = 4000
    z = torch.linspace(1.5, 4.5, points + 1, dtype=torch.float64)
    step, z = float(z[1] - z[0]), (z[1:] + z[:-1]) / 2
    to_sphere = low.geometry.rotations / low.geometry.scales[:, None, :]
    expected = torch.zeros(4, 5, 3, dtype=torch.float64)
    for y in range(4):
        for x in range(5):
            ray = torch.tensor(
                [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1.0], dtype=torch.float64
            )
            X = camera.position + z[:, None] * (camera.viewmat[:3, :3].T @ ray)
            sigma = []
            for n in range(3):
                inside = ((X - t["means"][n]) @ to_sphere[n]).norm(dim=1) < 1
                value = cosine_density(low.density, low.geometry, torch.full((points,), n), X)
                sigma.append(torch.where(inside, value.clamp_min(0), torch.zeros_like(value)) * step * ray.norm())
            tau = torch.stack(sigma)
            total = tau.sum(0)
            weight = -torch.expm1(-total) * (total - total.cumsum(0)).exp()
            mixed = (t["colors"].T @ tau) / total.clamp_min(1e-30)
            expected[y, x] = (mixed * weight).sum(1)
    errors = [
        (render_unsorted_volume(low, camera, EXACT, steps=s, keep="density").rgb - expected).abs().max().item()
        for s in (4, 16, 256)
    ]
    assert expected.max() > 0.3
    assert errors[2] < 5e-4, errors  # the march misplaces a chord's ends by half a step
    assert errors[0] > errors[2]
    fine = render_unsorted_volume(low, camera, EXACT, steps=512).rgb
    coarse = [(render_unsorted_volume(low, camera, EXACT, steps=s).rgb - fine).abs().max().item() for s in (8, 32)]
    assert coarse[1] < coarse[0] / 8, coarse


@pytest.mark.parametrize("settings", [EXACT, RenderSettings(backend="reference", transmittance_min=0.0, depth=True)])
def test_every_ray_keeps_the_transmittance_of_the_renderer(settings: RenderSettings) -> None:
    """Negative densities, clamps and cuts included: what differs is the order, nothing else."""
    t = scenes.tensors(40, 4, seed=9, dtype=torch.float64)
    low, camera = scenes.lowered(t), scenes.camera(20, 15)
    joint, plain = render_unsorted_volume(low, camera, settings, SKY), render_lowered(low, camera, settings, SKY)
    assert (joint.alpha - plain.alpha).abs().max() < 1e-12 and joint.alpha.max() > 0.5
    assert joint.depth is not None and plain.depth is not None
    seen = plain.alpha > 0.05
    assert (joint.depth - plain.depth)[seen].abs().max() < 0.5
    assert (render_unsorted_volume(low, camera, settings, SKY, keep="density").alpha - plain.alpha).abs().max() > 1e-3


def test_inside_the_near_plane_and_several_samples() -> None:
    t = scenes.tensors(30, 0, seed=10, dtype=torch.float64)
    t["colors"][:] = SKY
    low = scenes.lowered(t)
    for camera in (scenes.camera(12, 9, distance=0.2, fov=80.0), scenes.camera(12, 9)):
        for settings in (EXACT, replace(EXACT, samples=2), replace(EXACT, near=2.9)):
            joint, plain = render_unsorted_volume(low, camera, settings, steps=2), render_lowered(low, camera, settings)
            assert (joint.rgb - plain.rgb).abs().max() < 1e-12, "one colour: no order matters"


def test_entry_is_the_volume_where_nothing_overlaps() -> None:
    """And the order of centres is not. Where primitives overlap, neither order is, and neither is always the nearer
    one."""
    errors = measure_sorting_errors(scenes.lowered(needle_and_sphere()), along_z(41, 30.0), EXACT, SKY)
    assert errors["entry"].max_abs < 1e-12 and errors["center"].max_abs > 0.3
    assert errors["entry"].psnr > 100 + errors["center"].psnr
    t = scenes.tensors(150, 0, seed=12, radius=0.2, dtype=torch.float64)
    errors = measure_sorting_errors(scenes.lowered(t), scenes.camera(24, 18), EXACT, SKY)
    for error in errors.values():
        assert 25 < error.psnr < 50 and 0 < error.mean_abs < error.max_abs < 0.3


def test_other_forms_of_density_and_colour() -> None:
    t = scenes.tensors(15, 0, dtype=torch.float64)
    low, camera = scenes.lowered(t), scenes.camera(10, 8)
    m = low.geometry.length_scale
    opaque = CustomDensity(lambda prim, o, d, t0, t1: (t1 - t0) * t["b2"][prim, 0] / m[prim])
    colour = CustomColour(lambda prim, x, d: t["colors"][prim], 3)
    assert isinstance(low.colour, Constant)
    first = render_unsorted_volume(low, camera, EXACT, steps=2).rgb
    other = render_unsorted_volume(replace(low, density=opaque, colour=colour), camera, EXACT, steps=2).rgb
    assert (first - other).abs().max() < 1e-12 and first.max() > 0.2


def test_nothing_and_wrong_arguments() -> None:
    low, camera = scenes.lowered({k: v[:0] for k, v in scenes.tensors(2).items()}), scenes.camera(9, 7)
    assert torch.allclose(render_unsorted_volume(low, camera, background=SKY).rgb, SKY.expand(7, 9, 3))
    with pytest.raises(ConfigError, match="steps=0"):
        render_unsorted_volume(low, camera, steps=0)
    with pytest.raises(ConfigError, match="keep='mass'"):
        render_unsorted_volume(low, camera, keep="mass")  # type: ignore[arg-type]
