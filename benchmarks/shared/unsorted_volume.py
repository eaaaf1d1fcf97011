"""The volume that sorting approximates, integrated numerically: it measures the error of ``sort = "center"`` and
``sort = "entry"``.

Compositing draws primitives one behind the other, also where they overlap. In the volume that the primitives describe,
all of them absorb and emit together: the density at a point is the sum of theirs, its colour their density-weighted
mean. ``keep = "opacity"`` clamps each chord's density pointwise and scales it so that the primitive keeps exactly the
opacity that the renderer gives it, so that only the order differs. ``keep = "density"`` draws the sum of the clamped
densities, the field of an exported volume, so that the error also counts what the renderer's clamps and cuts do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.metrics import psnr
from neuprim.core.model.geometry import PrimitiveChords, quaternion_to_matrix
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import render_lowered
from neuprim.core.render.near_plane import resolve_near
from neuprim.core.render.reference.backend import pixel_ray_directions, screen_boxes
from neuprim.core.settings import RenderSettings, SortOrder

Keep = Literal["opacity", "density"]
_BLOCK = 8  # pixels on a side; bounds memory, changes nothing
_ORDERS: tuple[SortOrder, ...] = ("center", "entry")


@dataclass(frozen=True)
class SortingError:
    """Error of one order of compositing: PSNR in dB over all pixels and channels, and mean absolute difference."""

    psnr: float
    mean_abs: float


@torch.no_grad()
def measure_sorting_errors(
    lowered: LoweredPrimitives, camera: Camera, settings: RenderSettings, background: Tensor, steps: int, keep: Keep
) -> dict[SortOrder, SortingError]:
    """Return the errors of both orders against :func:`render_unsorted_volume`, all drawn with ``settings``."""
    errors: dict[SortOrder, SortingError] = {}
    truth = render_unsorted_volume(lowered, camera, settings, background, steps, keep)
    for order in _ORDERS:
        image = render_lowered(lowered, camera, replace(settings, sort=order), background).rgb.double()
        errors[order] = SortingError(psnr(image, truth), (image - truth).abs().mean().item())
    return errors


@torch.no_grad()
def render_unsorted_volume(
    lowered: LoweredPrimitives, camera: Camera, settings: RenderSettings, background: Tensor, steps: int, keep: Keep
) -> Tensor:
    """Render the emission-absorption image of the summed densities, (H, W, C) float64.

    Each ray is cut into cells at the ends of all its chords and at ``steps`` even divisions. Within a cell the set of
    primitives is fixed, the optical depth of each is its closed line integral, and only their mixture is taken as
    constant: errors go as steps^-2.
    """
    settings = resolve_near(settings, lowered.geometry.means, [camera])
    return _Volume(lowered, camera, settings, steps, keep).draw(background)


class _Volume:
    """One frame, drawn block by block."""

    def __init__(
        self, lowered: LoweredPrimitives, camera: Camera, settings: RenderSettings, steps: int, keep: Keep
    ) -> None:
        self.lowered, self.camera, self.settings, self.steps, self.keep = lowered, camera, settings, steps, keep
        g = lowered.geometry
        self.channels = lowered.colour.channels
        scaled = quaternion_to_matrix(g.quats.double()) / g.log_scales.double().exp()[:, None, :]
        self.whiten = scaled.transpose(1, 2)  # scene -> unit sphere

    def draw(self, background: Tensor) -> Tensor:
        camera, channels = self.camera, self.channels
        directions = pixel_ray_directions(camera)
        boxes = screen_boxes(self.lowered.geometry, camera, self.settings.near_plane)
        image = torch.zeros(camera.height, camera.width, channels + 1, dtype=torch.float64)
        for y in range(0, camera.height, _BLOCK):
            for x in range(0, camera.width, _BLOCK):
                window = directions[y : y + _BLOCK, x : x + _BLOCK]
                h, w = window.shape[:2]
                near_block = (boxes[:, 0] < x + w) & (boxes[:, 2] > x) & (boxes[:, 1] < y + h) & (boxes[:, 3] > y)
                rays = self._march(near_block.nonzero()[:, 0], window.reshape(-1, 3))
                image[y : y + h, x : x + w] = rays.reshape(h, w, channels + 1)
        return image[..., :channels] + image[..., channels:] * background.double()

    def _march(self, rows: Tensor, d: Tensor) -> Tensor:
        """(P, channels + 1): premultiplied colour and transmittance of P unit rays ``d`` (camera axes) against
        ``rows``."""
        g, camera, settings, channels = self.lowered.geometry, self.camera, self.settings, self.channels
        whiten = self.whiten[rows]
        origin = camera.position.detach().double()
        world = d @ camera.viewmat.detach().double()[:3, :3]

        # chords in scene units, one per (ray, primitive) that meet; sorted by ray
        p = (whiten @ (origin - g.means[rows].double())[:, :, None])[..., 0]
        v = torch.einsum("rij,pj->pri", whiten, world)
        a = (v * v).sum(-1)
        tm = -(v * p).sum(-1) / a
        x = p + tm[..., None] * v
        half = ((1 - (x * x).sum(-1)).clamp_min(0) / a).sqrt()
        start, end = torch.maximum(tm - half, (settings.near_plane / d[:, 2])[:, None]), tm + half
        ray, row = ((half > 0) & (end > start)).nonzero(as_tuple=True)
        prim, t0, t1 = rows[row], start[ray, row], end[ray, row]
        chords = PrimitiveChords.of(g, prim, origin, world[ray], t0, t1)
        alpha = -torch.expm1(-self.lowered.optical_depth(chords).clamp_min(0))
        alpha = torch.where(alpha >= settings.alpha_min, alpha.clamp_max(settings.alpha_max), torch.zeros_like(alpha))
        P = d.shape[0]
        if len(prim) == 0:
            return torch.cat([d.new_zeros(P, channels), d.new_ones(P, 1)], 1)

        # cells of every ray
        most = int(torch.bincount(ray, minlength=P).max())
        place = torch.arange(len(ray)) - torch.searchsorted(ray, ray)  # the chord's number within its ray
        first = torch.full((P,), torch.inf, dtype=torch.float64).scatter_reduce(0, ray, t0, "amin")
        last = torch.full((P,), -torch.inf, dtype=torch.float64).scatter_reduce(0, ray, t1, "amax")
        empty = first > last  # rays that meet nothing
        first, last = first.masked_fill(empty, 0.0), last.masked_fill(empty, 0.0)
        ends = last[:, None].repeat(1, 2 * most)
        ends[ray, 2 * place], ends[ray, 2 * place + 1] = t0, t1
        even = first[:, None] + (last - first)[:, None] * torch.linspace(0, 1, self.steps + 1, dtype=torch.float64)
        edges = torch.cat([ends, even], 1).sort(1).values
        low, high = edges[:, :-1], edges[:, 1:]

        # optical depth of every chord in every cell of it
        middle = (low + high) / 2
        inside = (middle[ray] > t0[:, None]) & (middle[ray] < t1[:, None]) & (high > low)[ray]
        chord, cell = inside.nonzero(as_tuple=True)
        pieces = PrimitiveChords.of(
            g, prim[chord], origin, world[ray[chord]], low[ray[chord], cell], high[ray[chord], cell]
        )
        tau = self.lowered.optical_depth(pieces).clamp_min(0)
        if self.keep == "opacity":
            total = torch.zeros_like(alpha).index_add(0, chord, tau)
            wanted = torch.where(total > 0, -torch.log1p(-alpha), torch.zeros_like(total))
            tau = tau * (wanted / torch.where(total > 0, total, torch.ones_like(total)))[chord]

        # emission and absorption: a cell's colour is the mean of its primitives', weighted by optical depth
        c = self.lowered.chord_colours(chords)
        cells = middle.shape[1]
        at = ray[chord] * cells + cell
        depth = torch.zeros(P * cells, dtype=torch.float64).index_add(0, at, tau)
        mixed = torch.zeros(P * cells, channels, dtype=torch.float64).index_add(0, at, tau[:, None] * c[chord])
        mixed = (mixed / torch.where(depth > 0, depth, torch.ones_like(depth))[:, None]).reshape(P, cells, channels)
        depth = depth.reshape(P, cells)
        behind = depth.cumsum(1)
        weight = -torch.expm1(-depth) * (depth - behind).exp()
        rgb = (weight[..., None] * mixed).sum(1)
        return torch.cat([rgb, (-behind[:, -1:]).exp()], 1)
