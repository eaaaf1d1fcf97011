"""Deep images: the light and opacity of a model in several slices of depth, for compositing with other deep images.

The primitives of a view are divided, by the depth of their centres, into slices with equally many primitives. A pixel
has one sample per slice that it shows. A sample extends from ``Z`` to ``ZBack``; the samples of a pixel touch, but do
not overlap. Composited in order, they are the image.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera, RayCamera
from neuprim.core.data import View
from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import Conditions
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives, Primitives
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.near_plane import resolve_near
from neuprim.core.render.reference import frame_rays


@dataclass(frozen=True)
class DeepImage:
    """Samples of the H x W pixels of a view, S in total, row by row of pixels and front to back in each pixel.

    Attributes:
        counts: (H, W) int64 numbers of samples.
        rgb: (S, C) light over black, premultiplied by alpha.
        alpha: (S,) opacity, above 0.
        front, back: (S,) float32 depths at which each sample begins and ends.
    """

    counts: Tensor
    rgb: Tensor
    alpha: Tensor
    front: Tensor
    back: Tensor


def draw_deep_image(
    model: Primitives,
    view: View,
    settings: RenderSettings,
    lights: Sequence[Conditions],
    most: int,
    on_alpha: Callable[[Tensor], None] = lambda alpha: None,
    scale: float = 1.0,
) -> DeepImage:
    """Draw a view in at most ``most`` slices of depth.

    A sample extends equally far to both sides of its mean depth, as far as its slice allows.

    Args:
        lights: conditions of lights, over which the light of a sample is summed; empty: the view's own light.
        on_alpha: function that is called with the alpha of the whole image, once per light.
        scale: scene units per unit of the returned depths.

    Raises:
        ConfigError: the model shades whole pixels, not primitives.
    """
    pixels, samples = list[Tensor](), list[Tensor]()
    with torch.no_grad():
        frames = [model.lower(view.camera, {**view.conditions, **light}, settings) for light in lights or ({},)]
        if any(frame.shade is not None for frame in frames):
            raise ConfigError("--deep: the model has a shadow per pixel; expected one per primitive or none")
        transmittance = torch.ones(view.camera.height, view.camera.width)
        members, edges = _slice_by_depth(frames[0], view.camera, settings, most, scale)
        for i, rows in enumerate(members):
            weights = torch.zeros(frames[0].geometry.count, device=rows.device).index_fill(0, rows, 1.0)
            slices = [replace(frame, density=frame.density.scaled(weights)) for frame in frames]
            drawn = [render_lowered(part, view.camera, replace(settings, depth=True)) for part in slices]
            rgb = torch.stack([image.rgb.cpu().double() for image in drawn]).sum(0)
            alpha, middle = drawn[0].alpha.cpu(), drawn[0].depth
            assert middle is not None
            transmittance = transmittance * (1 - alpha)
            alpha = alpha.flatten()
            seen = (alpha > 0).nonzero()[:, 0]
            first, last = torch.nextafter(edges[i], torch.tensor(torch.inf)), edges[i + 1]  # no end twice
            middle = (middle.cpu().double().flatten()[seen] / scale).float().clamp(first, last)
            ends = torch.stack([(2 * middle - last).clamp_min(first), (2 * middle - first).clamp_max(last)], 1)
            pixels.append(seen)
            samples.append(torch.cat([rgb.flatten(0, 1)[seen], alpha[seen, None].double(), ends.double()], 1))
    for _ in frames:
        on_alpha(1 - transmittance)
    height, width = view.camera.height, view.camera.width
    of_pixel = torch.cat([torch.zeros(0, dtype=torch.int64), *pixels])
    order = of_pixel.argsort(stable=True)
    channels = model.colour.channels
    values = torch.cat([torch.zeros(0, channels + 3, dtype=torch.float64), *samples])[order].float()
    counts = torch.bincount(of_pixel, minlength=height * width).reshape(height, width)
    return DeepImage(counts, values[:, :channels], *values[:, channels:].unbind(1))


def _slice_by_depth(
    frame: LoweredPrimitives, camera: AnyCamera, settings: RenderSettings, most: int, scale: float
) -> tuple[list[Tensor], Tensor]:
    """Divide the primitives in the image into slices: return the rows of each, and the depths between slices.

    There is one depth more than slices. All depths differ in float32, so that compositing programs keep the order of
    the slices.
    """
    geometry = Geometry(*(values.cpu() for values in frame.geometry.tensors().values()))
    view = camera.viewmat.double()
    centers = geometry.means.double() @ view[:3, :3].T + view[:3, 3]
    near = resolve_near(settings, geometry.means, [camera]).near_plane
    rays = frame_rays(camera, geometry, centers, near)
    rows = rays.order[rays.touched(0, 0, camera.height, camera.width)[rays.order]]
    if not len(rows):
        return [], torch.zeros(1)
    depth = centers.norm(dim=-1) if isinstance(camera, RayCamera) else centers[:, 2]
    reach = geometry.scales.double().amax(1)
    members = list(rows.chunk(most))
    first, last = (depth - reach)[rows].min().clamp_min(near), (depth + reach)[rows].max()
    between = [(depth[a[-1]] + depth[b[0]]) / 2 for a, b in itertools.pairwise(members)]
    edges = (torch.stack([first, *between, last]) / scale).float()
    for i in range(1, len(edges)):
        edges[i] = torch.maximum(edges[i], torch.nextafter(edges[i - 1], torch.tensor(torch.inf)))
    return [part.to(frame.geometry.means.device) for part in members], edges
