"""Several rays per pixel: a finer image of the same view, averaged (``RenderSettings.samples``)."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.primitives import Lowered
from neuprim.core.render.output import RenderOutput, mean_depth
from neuprim.core.render.shading import Draw
from neuprim.core.settings import RenderSettings

__all__ = ["render_samples"]


def _pool(image: Tensor, n: int) -> Tensor:
    """Means over n x n pixels of (n H, n W) or (n H, n W, C)."""
    h, w = image.shape[0] // n, image.shape[1] // n
    return image.reshape(h, n, w, n, *image.shape[2:]).mean((1, 3))


def render_samples(
    draw: Draw, lowered: Lowered, camera: Camera, background: Tensor | None, settings: RenderSettings
) -> RenderOutput:
    """One frame of ``samples`` x ``samples`` rays per pixel by a backend's ``draw``; memory and time grow with
    samples^2.

    rgb and alpha are means over the rays; depth is their mean weighted by alpha, the mean over everything the pixel
    shows.
    """
    n = settings.samples
    fine = draw(lowered, camera.resized(camera.width * n, camera.height * n), background, replace(settings, samples=1))
    alpha = _pool(fine.alpha, n)
    depth = None if fine.depth is None else mean_depth(_pool(fine.depth * fine.alpha, n), alpha)
    fine.stats.samples = n  # what is watched is given and summed per pixel; pairs and extra count the work really done
    return RenderOutput(_pool(fine.rgb, n), alpha, depth, fine.stats)
