"""The result of rendering with its statistics, and functions that wrap the draw function of a backend."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.pinhole import AnyCamera, RayCamera
from neuprim.core.compute import device
from neuprim.core.model.checks import check_model_tensor_shape, check_primitive_field_result
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.settings import RenderSettings


@dataclass
class Contributions:
    """How much each of N primitives contributes to the image of a frame; 0 until the backward pass fills the values."""

    # (N,) sum over pixels of alpha_i T_i: the opacity of primitive i times the transmittance in front of it; positive
    # exactly for visible primitives
    weight: Tensor
    error_weight: Tensor  # (N,) sum over pixels of alpha_i T_i x error of the pixel
    rows: Tensor | None = None  # (N,) rows of the model, if some primitives were left out of the frame

    def of_all(self, count: int) -> tuple[Tensor, Tensor]:
        """Return ``weight`` and ``error_weight``, each (count,), for all ``count`` primitives of the model.

        Primitives that were left out of the frame get 0.
        """
        if self.rows is None:
            return self.weight, self.error_weight
        weight, error_weight = (
            sums.new_zeros(count).index_copy_(0, self.rows, sums) for sums in (self.weight, self.error_weight)
        )
        return weight, error_weight


def sum_contributions(frames: Sequence[Contributions], count: int) -> Contributions:
    """Return the sums of each primitive's contributions over several frames, for all ``count`` primitives."""
    weight, error = frames[0].of_all(count)
    for contributions in frames[1:]:
        more = contributions.of_all(count)
        weight, error = weight + more[0], error + more[1]
    return Contributions(weight, error)


@dataclass
class ContributionRequest:
    """A request to measure contributions. The backward pass of a backend reads ``error`` and fills ``result``."""

    error: Tensor  # error of each ray, in the shape of the frame as the backend drew it
    result: Contributions
    rays: int = 1  # rays per pixel; divides the sums, so that frames with different ray counts are comparable
    sums: tuple[Tensor, Tensor] | None = None  # (N,) sums of weights and of weights x error over the blocks so far

    def add(self, rows: Tensor, weight: Tensor, error_weight: Tensor) -> None:
        """Add the (R,) sums over one block of rays for primitives ``rows`` (R,), then update ``result``.

        Backends that render in blocks call this method once per block.
        """
        if self.sums is None:
            blank = torch.zeros_like(self.result.weight, device=rows.device)
            self.sums = blank, blank.clone()
        for total, part in zip(self.sums, (weight, error_weight), strict=True):
            total.index_add_(0, rows, part.to(total))
        self.fill(*self.sums)

    def fill(self, weight: Tensor, error_weight: Tensor) -> None:
        """Set ``result`` from (N,) sums over all rays, one per primitive, divided by the number of rays per pixel."""
        n = self.rays
        weight, error_weight = (sums.to(self.result.weight.device) for sums in (weight, error_weight))
        self.result.weight, self.result.error_weight = (
            (weight, error_weight) if n == 1 else (weight / n, error_weight / n)
        )


@dataclass
class RenderStats:
    """Statistics of a rendered frame."""

    backend: str  # name of the backend
    count: int  # number of primitives of the frame
    # number of evaluated pairs: tile and primitive (cpu, cuda), or ray and primitive (reference). In a frame that is
    # replayed as a CUDA graph: number of pairs for which the arrays have room
    pairs: int = 0
    rows: Tensor | None = None  # rows of the model, if some primitives were left out of the frame
    samples: int = 1  # rays per pixel side
    drawn_on: torch.device | None = None  # device of the backend, if it differs from the device of the tensors
    contributions: ContributionRequest | None = None  # see RenderOutput.request_contributions
    extra: dict[str, Any] = field(default_factory=dict)  # further data of the backend

    def request_contributions(self, error: Tensor) -> Contributions:
        """Like :meth:`RenderOutput.request_contributions`, without checking the shape of ``error``."""
        n, error = self.samples, error.detach()
        blank = torch.zeros(self.count, device=error.device)
        result = Contributions(blank, blank.clone(), self.rows)
        rays = error if n == 1 else error.repeat_interleave(n, 0).repeat_interleave(n, 1)
        rays = rays if self.drawn_on is None else rays.to(self.drawn_on)
        self.contributions = ContributionRequest(rays, result, n * n)
        return result


@dataclass(frozen=True)
class RenderOutput:
    """A rendered image with alpha, optional depth and statistics."""

    rgb: Tensor  # (H, W, C) in the model's colour space, composited over the background
    alpha: Tensor  # (H, W) accumulated opacity 1 - T
    # (H, W) weighted mean camera-z (ray distance for a RayCamera) of the middles of the ray's chords, 0 where the ray
    # hits nothing; None without the setting depth
    depth: Tensor | None
    stats: RenderStats

    def request_contributions(self, error: Tensor) -> Contributions:
        """Return how much each primitive contributes to the image, and to an error given per pixel.

        The backward pass fills the result: call this method before ``backward()``. A second call replaces the first.

        Args:
            error: (H, W) any measure of error at each pixel; gets no gradient.
        """
        check_model_tensor_shape("request_contributions: error", error, tuple(self.alpha.shape), ", that of the frame")
        return self.stats.request_contributions(error)


def mean_depth(weighted: Tensor, alpha: Tensor) -> Tensor:
    """Return the (H, W) mean depth, ``weighted`` / ``alpha``; 0 where ``alpha`` is 0.

    ``weighted`` is the sum of weight times depth over the primitives on each ray, ``alpha`` the sum of the weights.
    """
    hit = alpha > 0
    if not (torch.is_grad_enabled() and (weighted.requires_grad or alpha.requires_grad)):
        return (weighted / alpha).masked_fill_(~hit, 0.0)
    return torch.where(hit, weighted / torch.where(hit, alpha, 1.0), 0.0)


Draw = Callable[..., RenderOutput]
"""Type of a backend's function ``render(lowered, camera, background, settings)``. The cameras that the function accepts
depend on the backend."""


def draw_pixel_samples(
    draw: Draw, lowered: LoweredPrimitives, camera: Camera, background: Tensor | None, settings: RenderSettings
) -> RenderOutput:
    """Render with ``settings.samples`` ** 2 rays per pixel; return the means over each pixel.

    The mean of depth is weighted by alpha.
    """
    n = settings.samples
    fine = draw(lowered, camera.resized(camera.width * n, camera.height * n), background, replace(settings, samples=1))
    alpha = _average_pixel_samples(fine.alpha, n)
    depth = None if fine.depth is None else mean_depth(_average_pixel_samples(fine.depth * fine.alpha, n), alpha)
    fine.stats.samples = n  # contributions are per pixel; pairs and extra count the actual work
    return RenderOutput(_average_pixel_samples(fine.rgb, n), alpha, depth, fine.stats)


def _average_pixel_samples(image: Tensor, n: int) -> Tensor:
    """Return the (H, W) or (H, W, C) image of means over blocks of n x n pixels of an image n times as large."""
    h, w = image.shape[0] // n, image.shape[1] // n
    return image.reshape(h, n, w, n, *image.shape[2:]).mean((1, 3))


def unproject_rendered_depth(depth: Tensor, camera: AnyCamera) -> Tensor:
    """Return the (H, W, 3) float64 scene point on each pixel's ray at the pixel's ``depth`` (H, W); no gradient."""
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
    """Return a draw function that shades the image of ``draw`` pixel by pixel, for example with shadows.

    The returned function multiplies the image over black by ``lowered.shade``, a factor evaluated at the scene point of
    each pixel's mean depth.
    """

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
    """Return a draw function that renders on the device ``place``, then moves the result to the model's device.

    The returned function is differentiable.
    """

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
