"""Factors per pixel: where they are asked for, what they multiply, and what they leave alone."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from neuprim.core.cameras.pinhole import RayCamera
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.output import unproject_rendered_depth
from tests import scenes
from tests.backends import BACKENDS, by

BACKGROUND = torch.tensor([0.3, 0.6, 0.9])


def lowered() -> LoweredPrimitives:
    return scenes.lowered(scenes.tensors(12, seed=4))


@pytest.mark.parametrize("backend", BACKENDS)
def test_matter_is_shaded_where_the_depth_image_is_and_the_background_is_not(backend: str) -> None:
    camera, asked = scenes.camera(), []
    settings = RenderSettings(**by(backend))
    plain = render_lowered(lowered(), camera, replace(settings, depth=True))
    assert plain.depth is not None

    def shade(points: torch.Tensor) -> torch.Tensor:
        asked.append(points)
        return torch.full((len(points),), 0.5)

    shaded = render_lowered(replace(lowered(), shade=shade), camera, settings, BACKGROUND)
    hit = plain.alpha > 0
    assert asked[0].dtype == torch.float64 and len(asked[0]) == int(hit.sum())
    view = camera.viewmat.double()
    x, y, z = (asked[0] @ view[:3, :3].T + view[:3, 3]).unbind(-1)
    rows, columns = torch.nonzero(hit, as_tuple=True)
    assert torch.allclose(z, plain.depth[hit].double(), atol=1e-9)
    assert torch.allclose(camera.fx * x / z + camera.cx, columns.double() + 0.5, atol=1e-6)
    assert torch.allclose(camera.fy * y / z + camera.cy, rows.double() + 0.5, atol=1e-6)
    expected = 0.5 * plain.rgb + (1 - plain.alpha)[..., None] * BACKGROUND
    assert shaded.depth is None and torch.equal(shaded.alpha, plain.alpha)
    assert torch.allclose(shaded.rgb, expected.to(shaded.rgb), atol=1e-5)


@pytest.mark.parametrize("backend", BACKENDS)
def test_gradients_are_those_of_the_product(backend: str) -> None:
    """Against a factor put on by hand to the picture over black; a depth image that nothing is asked of adds
    nothing."""
    camera, settings = scenes.camera(), RenderSettings(**by(backend))
    weights = torch.randn(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(1))
    grads = []
    for shaded in (True, False):
        t = {k: v.clone().requires_grad_() for k, v in scenes.tensors(12, seed=4).items()}
        scene = scenes.lowered(t)
        if shaded:
            rgb = render_lowered(replace(scene, shade=lambda p: torch.sigmoid(p[:, 0])), camera, settings).rgb
        else:
            plain = render_lowered(scene, camera, replace(settings, depth=True))
            assert plain.depth is not None
            points = unproject_rendered_depth(plain.depth, camera)
            factor = torch.where(plain.alpha > 0, torch.sigmoid(points[..., 0]).to(plain.rgb), 1.0).detach()
            rgb = plain.rgb * factor[..., None]
        (rgb * weights.to(rgb)).sum().backward()
        grads.append({k: v.grad for k, v in t.items() if v.grad is not None})
    assert grads[0].keys() == grads[1].keys() and len(grads[0]) >= 7
    for name, found in grads[0].items():
        assert torch.equal(found, grads[1][name]), name


def test_more_rays_per_pixel_are_shaded_one_by_one() -> None:
    """A factor of 0 or 1 with an edge inside pixels gives values in between."""
    camera = scenes.camera()

    def edge(points: torch.Tensor) -> torch.Tensor:
        return (points[:, 0] > 0.0137).float()

    full = render_lowered(lowered(), camera, RenderSettings(samples=3)).rgb
    cut = render_lowered(replace(lowered(), shade=edge), camera, RenderSettings(samples=3)).rgb
    ratio = (cut / full.clamp_min(1e-6))[full.sum(-1) > 0.1]
    assert bool(((ratio > 0.05) & (ratio < 0.95)).any()) and bool((ratio > 0.999).any()) and bool((ratio < 0.001).any())


def test_ray_cameras_are_shaded_at_a_distance() -> None:
    pinhole = scenes.camera()
    y, x = torch.meshgrid(*(torch.arange(n).double() + 0.5 for n in (pinhole.height, pinhole.width)), indexing="ij")
    rays = torch.stack([(x - pinhole.cx) / pinhole.fx, (y - pinhole.cy) / pinhole.fy, torch.ones_like(x)], -1).double()
    length = rays.norm(dim=-1)
    camera = RayCamera(pinhole.viewmat, rays / length[..., None])
    depth = torch.rand(pinhole.height, pinhole.width, generator=torch.Generator().manual_seed(0)).double() + 1.0
    assert torch.allclose(
        unproject_rendered_depth(depth * length, camera), unproject_rendered_depth(depth, pinhole), atol=1e-12
    )
