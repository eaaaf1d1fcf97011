"""Several rays per pixel: a finer image of the same view, averaged (``RenderSettings.samples``)."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.primitives import Lowered
from neuprim.core.render.output import RenderOutput, RenderStats, mean_depth
from neuprim.core.render.shading import Draw
from neuprim.core.settings import RenderSettings

__all__ = ["SampledStats", "render_samples"]


class SampledStats(RenderStats):
    """The statistics of a finer frame, read and set per output pixel.

    ``pixel_error`` (H, W) is spread over the sub-pixels of the finer frame; ``weight`` and ``error_weight`` are its sums over
    samples^2, so that they are sums over output pixels of mean weights and compare with frames of one ray per pixel.
    ``pairs`` and ``extra`` count the work really done.
    """

    _pixel_error: Tensor | None

    def __init__(self, fine: RenderStats, samples: int) -> None:
        self._fine, self._samples = fine, samples
        super().__init__(fine.backend, fine.pairs, None, self._mean(fine.weight), self._mean(fine.error_weight), fine.rows, fine.extra)

    @property
    def pixel_error(self) -> Tensor | None:  # type: ignore[override]
        return self._pixel_error

    @pixel_error.setter
    def pixel_error(self, value: Tensor | None) -> None:
        n = self._samples
        self._pixel_error = value
        self._fine.pixel_error = None if value is None else value.repeat_interleave(n, 0).repeat_interleave(n, 1)

    @property
    def weight(self) -> Tensor | None:  # type: ignore[override]
        return self._mean(self._fine.weight)

    @weight.setter
    def weight(self, value: Tensor | None) -> None:
        self._fine.weight = self._sum(value)

    @property
    def error_weight(self) -> Tensor | None:  # type: ignore[override]
        return self._mean(self._fine.error_weight)

    @error_weight.setter
    def error_weight(self, value: Tensor | None) -> None:
        self._fine.error_weight = self._sum(value)

    def _sum(self, mean: Tensor | None) -> Tensor | None:
        return None if mean is None else mean * self._samples**2

    def _mean(self, total: Tensor | None) -> Tensor | None:
        return None if total is None else total / self._samples**2


def _pool(image: Tensor, n: int) -> Tensor:
    """Means over n x n pixels of (n H, n W) or (n H, n W, C)."""
    h, w = image.shape[0] // n, image.shape[1] // n
    return image.reshape(h, n, w, n, *image.shape[2:]).mean((1, 3))


def render_samples(draw: Draw, lowered: Lowered, camera: Camera, background: Tensor | None, settings: RenderSettings) -> RenderOutput:
    """One frame of ``samples`` x ``samples`` rays per pixel by a backend's ``draw``; memory and time grow with samples^2.

    rgb and alpha are means over the rays; depth is their mean weighted by alpha, the mean over everything the pixel shows.
    """
    n = settings.samples
    fine = draw(lowered, camera.resized(camera.width * n, camera.height * n), background, replace(settings, samples=1))
    alpha = _pool(fine.alpha, n)
    depth = None if fine.depth is None else mean_depth(_pool(fine.depth * fine.alpha, n), alpha)
    return RenderOutput(_pool(fine.rgb, n), alpha, depth, SampledStats(fine.stats, n))
