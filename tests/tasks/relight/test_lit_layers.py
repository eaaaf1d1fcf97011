"""Shadows as layers against every chord by brute force; depth images read alike by the kernel and by torch."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.model.fields import RayNet
from neuprim.core.render import RenderSettings
from neuprim.core.render.layer_frame import LayerFrame
from neuprim.core.render.light import (
    EXTENTS,
    FADE,
    PIXEL_FADE,
    _visibility_kernel,
    extents_towards,
    interleave_shadow_maps,
    light_visibility,
    sample_visibility,
)
from neuprim.core.render.output import unproject_rendered_depth
from neuprim.tasks.relight import TASK
from neuprim.tasks.relight.colour import LightHarmonics, LightNetwork
from tests import scenes
from tests.chords import chords
from tests.lit_models import light, model

CAMERA = scenes.camera(20, 16, distance=2.6)
EXACT = RenderSettings(alpha_min=0.0, transmittance_min=0.0, alpha_max=0.9999)


def frame(colour: LightNetwork | LightHarmonics) -> LayerFrame:
    return LayerFrame(model(colour, torch.float32), CAMERA, light(1.5, -2.0, 2.0), EXACT)


def layers(one: LayerFrame) -> dict[str, Tensor | None]:
    return {spec.name: spec.draw(one) for spec in TASK.layers}


def test_shadows_of_primitives() -> None:
    one = frame(LightNetwork(3, visibility="primitive"))
    found, drawn = chords(one.lowered, CAMERA), layers(one)
    geometry, density = one.lowered.geometry, one.lowered.density
    light = one.conditions["light"]
    visible = light_visibility(geometry, density, light, EXACT)
    V = visible(geometry.means, FADE, EXTENTS * extents_towards(geometry, light)).double()
    assert V.min() < 0.7 < V.max()
    alpha = found.weight.sum(0)
    expected = torch.where(alpha > 0, torch.einsum("nhw,n->hw", found.weight, V) / alpha.clamp_min(1e-30), 0.0)
    clear = alpha > 1e-3
    visibility, unshadowed = drawn["visibility"], drawn["unshadowed"]
    assert visibility is not None and unshadowed is not None
    assert (
        (visibility - expected)[clear].abs().max() < 1e-4
        and visibility.max() <= 1
        and (visibility[alpha == 0] == 0).all()
    )
    plain = LayerFrame(model(LightNetwork(3, visibility="none"), torch.float32), CAMERA, one.conditions, EXACT)
    assert isinstance(plain.lowered.colour, RayNet)
    assert (unshadowed - plain.drawn.rgb).abs().max() < 1e-5 and (unshadowed - one.drawn.rgb).abs().max() > 0.01


def test_shadows_of_pixels_multiply() -> None:
    one = frame(LightNetwork(3, visibility="pixel"))
    drawn = layers(one)
    visibility, unshadowed = drawn["visibility"], drawn["unshadowed"]
    assert visibility is not None and unshadowed is not None and one.drawn.depth is not None
    assert visibility[one.drawn.alpha > 0].min() < 0.6
    assert (unshadowed * visibility[..., None] - one.drawn.rgb).abs().max() < 1e-5
    V = light_visibility(one.lowered.geometry, one.lowered.density, one.conditions["light"], EXACT)
    points = unproject_rendered_depth(one.drawn.depth, CAMERA).reshape(-1, 3)
    expected = V(points, PIXEL_FADE).reshape(visibility.shape)
    assert (visibility - torch.where(one.drawn.alpha > 0, expected, 0.0)).abs().max() < 1e-6


SIZE, NEAR, FOCAL = 24, 0.05, 20.0


def light_camera() -> Camera:
    eye, up = torch.tensor([1.0, 2.0, -4.0], dtype=torch.float64), torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    return Camera(look_at(eye, torch.zeros(3, dtype=torch.float64), up), 50.0, 50.0, 8.0, 8.0, 16, 16)


@pytest.mark.parametrize("slabs", [1, 4])
def test_both_read_the_same(slabs: int) -> None:
    """Points anywhere: inside the images, across their borders, behind the camera and at its centre; and not finite."""
    generator = torch.Generator().manual_seed(slabs)
    alphas = torch.rand(slabs, SIZE, SIZE, generator=generator)
    alphas[torch.rand(alphas.shape, generator=generator) < 0.4] = 0.0
    depths = torch.where(alphas > 0, 0.01 + 4 * torch.rand(alphas.shape, generator=generator), 0.0)
    view = light_camera().viewmat[:3].contiguous()
    points = 6 * torch.rand(5000, 3, generator=generator, dtype=torch.float64) - 3
    points[:50] = light_camera().position + 1e-3 * points[:50]
    points[50] = light_camera().position
    points[51:54] = torch.tensor([[torch.nan, 0, 0], [torch.inf, 0, 0], [0, 0, -torch.inf]])
    edge = torch.rand(200, 3, generator=generator, dtype=torch.float64)  # about the border of the images
    side = torch.where(edge[:, 0] < 0.5, -1.0, 1.0) * (SIZE / 2 + (edge[:, 1] - 0.5) * 3) / FOCAL
    local = torch.stack([side, 0.4 * (edge[:, 2] - 0.5), torch.ones(200, dtype=torch.float64)], -1) * 3
    points = torch.cat([points, (local - view[:, 3]) @ view[:, :3]])
    found = np.full(len(points), -1.0, np.float32)
    maps = interleave_shadow_maps(alphas.numpy(), depths.numpy(), NEAR)
    fades = 0.1 + torch.rand(len(points), generator=generator, dtype=torch.float64)
    _visibility_kernel(0, len(points), points.numpy(), view.numpy(), NEAR, FOCAL, maps, fades.numpy(), 0.0, found)
    wanted = sample_visibility(points, view, NEAR, FOCAL, alphas, depths, fades)
    assert wanted.dtype == torch.float32 and torch.allclose(torch.from_numpy(found), wanted, rtol=0, atol=5e-7)
    assert 0.1 < float((wanted < 0.99).float().mean()) and float(wanted.min()) < 0.3
    assert found[50:54].tolist() == wanted[50:54].tolist() == [1.0] * 4
