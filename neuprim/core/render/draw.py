"""Wrappers of a backend's draw function: several rays per pixel, deferred shading, another device."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.pinhole import AnyCamera, RayCamera
from neuprim.core.compute import device
from neuprim.core.model.checks import check_primitive_field_result
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render.output import RenderOutput, mean_depth
from neuprim.core.settings import RenderSettings

Draw = Callable[..., RenderOutput]
"""A backend's ``render(lowered, camera, background, settings)``; which cameras it takes differs."""


def draw_pixel_samples(
    draw: Draw, lowered: LoweredPrimitives, camera: Camera, background: Tensor | None, settings: RenderSettings
) -> RenderOutput:
    """Draw ``settings.samples`` squared rays per pixel: means of rgb and alpha, and of depth weighted by alpha."""
    n = settings.samples
    fine = draw(lowered, camera.resized(camera.width * n, camera.height * n), background, replace(settings, samples=1))
    alpha = _average_pixel_samples(fine.alpha, n)
    depth = None if fine.depth is None else mean_depth(_average_pixel_samples(fine.depth * fine.alpha, n), alpha)
    fine.stats.samples = n  # contributions are per pixel; pairs and extra count the work really done
    return RenderOutput(_average_pixel_samples(fine.rgb, n), alpha, depth, fine.stats)


def _average_pixel_samples(image: Tensor, n: int) -> Tensor:
    """Means over n x n pixels of (n H, n W) or (n H, n W, C)."""
    h, w = image.shape[0] // n, image.shape[1] // n
    return image.reshape(h, n, w, n, *image.shape[2:]).mean((1, 3))


def unproject_rendered_depth(depth: Tensor, camera: AnyCamera) -> Tensor:
    """Return the (H, W, 3) float64 scene points at a depth image (H, W); no gradient."""
    depth = depth.detach().double()
    view = device.to_device_like(camera.viewmat.detach(), depth)
    if isinstance(camera, RayCamera):
        local = device.to_device_like(camera.directions.detach(), depth) * depth[..., None]
    else:
        x = (torch.arange(camera.width, dtype=torch.float64, device=depth.device) + 0.5 - camera.cx) / camera.fx
        y = (torch.arange(camera.height, dtype=torch.float64, device=depth.device) + 0.5 - camera.cy) / camera.fy
        local = torch.stack([x[None, :] * depth, y[:, None] * depth, depth], -1)
    return (local - view[:3, 3]) @ view[:3, :3]


def draw_shaded_view(draw: Draw) -> Draw:
    """Return a draw function that multiplies the frame, not its background, by ``lowered.shade`` at the mean depth."""

    def shaded(
        lowered: LoweredPrimitives, camera: AnyCamera, background: Tensor | None, settings: RenderSettings
    ) -> RenderOutput:
        assert lowered.shade is not None
        output = draw(lowered, camera, background, replace(settings, depth=True))
        assert output.depth is not None
        hit = output.alpha.detach() > 0
        factor = torch.ones_like(output.alpha, requires_grad=False)
        points = unproject_rendered_depth(output.depth, camera)[hit]
        values = lowered.shade(points)
        factor[hit] = check_primitive_field_result(values, (len(points),), f"{lowered.owner('colour')}: shade").to(
            factor
        )
        rgb = output.rgb * factor[..., None]
        if background is not None:
            rgb = rgb + ((1 - factor) * (1 - output.alpha))[..., None] * background.to(rgb)
        return replace(output, rgb=rgb, depth=output.depth if settings.depth else None)

    return shaded


def draw_on_device(draw: Draw, place: torch.device) -> Draw:
    """Return a draw function that draws on another device and moves the frame back; differentiable."""

    def moved(
        lowered: LoweredPrimitives, camera: AnyCamera, background: Tensor | None, settings: RenderSettings
    ) -> RenderOutput:
        own = lowered.geometry.means.device
        camera = replace(camera, viewmat=camera.viewmat.to(place))
        output = draw(lowered.to(place), camera, None if background is None else background.to(place), settings)
        output.stats.drawn_on = output.stats.drawn_on or place
        depth = None if output.depth is None else output.depth.to(own)
        return replace(output, rgb=output.rgb.to(own), alpha=output.alpha.to(own), depth=depth)

    return moved
