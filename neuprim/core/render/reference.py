"""The reference backend: the closed-form integral of the method in plain torch, in float64, with autograd.

Tests compare the other backends with the reference backend.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.pinhole import AnyCamera, RayCamera
from neuprim.core.model.geometry import Geometry, PrimitiveChords, quaternion_to_matrix
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render.output import RenderOutput, RenderStats, mean_depth
from neuprim.core.settings import RenderSettings

_BLOCK = 32  # pixels per side of a block; limits memory, does not change results


class _FlooredSqrt(torch.autograd.Function):
    """sqrt(D), whose backward pass takes the derivative at max(D, floor).

    The exact derivative grows as D^-1/2 without bound towards a silhouette, where D = 0.
    """

    @staticmethod
    def forward(ctx: Any, D: Tensor, floor: float) -> Tensor:
        ctx.save_for_backward(D)
        ctx.floor = floor
        return D.sqrt()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # type: ignore[override]
        (D,) = ctx.saved_tensors
        return grad * 0.5 * D.clamp_min(ctx.floor).rsqrt(), None


class _Contributions(torch.autograd.Function):
    """Identity on the compositing weights of a block of rays, whose backward pass sums each primitive's contributions.

    The sums go to ``stats.contributions``.
    """

    @staticmethod
    def forward(ctx: Any, weights: Tensor, rows: Tensor, pixels: Tensor, stats: RenderStats) -> Tensor:
        ctx.save_for_backward(weights, rows, pixels)
        ctx.stats = stats
        return weights.clone()

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        weights, rows, pixels = ctx.saved_tensors
        stats: RenderStats = ctx.stats
        if stats.contributions is not None:
            error = stats.contributions.error.reshape(-1)[pixels].to(weights)
            stats.contributions.add(rows, weights.sum(1), weights @ error)
        return grad, None, None, None


class _PreparedPrimitives:
    """Centres and axes of all primitives of one view, in camera coordinates and float64."""

    def __init__(self, lowered: LoweredPrimitives, camera: AnyCamera) -> None:
        g = lowered.geometry
        view = camera.viewmat.double()
        self.rotation = view[:3, :3]
        self.origin = -self.rotation.T @ view[:3, 3]
        # one layout: on some CPUs the order of a product's sums, and the last bits of gradients, depend on it
        means, log_scales, quats = (x.double().contiguous() for x in (g.means, g.log_scales, g.quats))
        first = log_scales.detach().argmax(dim=-1, keepdim=True)
        log_m = log_scales.gather(-1, first)
        self.m = log_m.exp()[:, 0]
        self.axes = (log_scales - log_m).exp()  # s/m, never over- or underflows
        self.local = quaternion_to_matrix(quats)  # ellipsoid axes -> scene
        self.center = means @ self.rotation.T + view[:3, 3]
        B = self.rotation @ self.local
        self.whiten = B.transpose(1, 2) / self.axes[:, :, None]  # camera -> whitened, times m
        self.start = -(self.whiten @ (self.center / self.m[:, None])[:, :, None])[..., 0]  # camera centre, whitened


def render(
    lowered: LoweredPrimitives, camera: AnyCamera, background: Tensor | None, settings: RenderSettings
) -> RenderOutput:
    """Render in float64; return a frame of the model's dtype.

    For the arguments see ``Draw`` in :mod:`neuprim.core.render.output`.
    """
    frame = _PreparedPrimitives(lowered, camera)
    count = lowered.geometry.count
    seen = frame_rays(camera, lowered.geometry, frame.center, settings.near_plane)
    channels = lowered.colour.channels
    stats = RenderStats("reference", count)
    empty = torch.zeros(_BLOCK, _BLOCK, channels + 2, dtype=torch.float64)
    empty[..., channels] = 1  # transmittance
    rows_of_blocks = []
    for y0 in range(0, camera.height, _BLOCK):
        line = []
        for x0 in range(0, camera.width, _BLOCK):
            h, w = min(_BLOCK, camera.height - y0), min(_BLOCK, camera.width - x0)
            rays, touched = seen.block(y0, x0, h, w)
            if not len(touched) and not torch.is_grad_enabled():  # as most blocks of shadow maps
                line.append(empty[:h, :w])
                continue
            ys, xs = torch.meshgrid(torch.arange(y0, y0 + h), torch.arange(x0, x0 + w), indexing="ij")
            pixels = (ys * camera.width + xs).reshape(-1)
            out = _composite_ray_block(lowered, frame, rays, touched, pixels, channels, settings, stats)
            line.append(out.reshape(h, w, channels + 2))
        rows_of_blocks.append(torch.cat(line, 1))
    image = (
        torch.cat(rows_of_blocks, 0)
        if rows_of_blocks
        else torch.zeros(camera.height, camera.width, channels + 2, dtype=torch.float64)
    )
    dtype = lowered.geometry.means.dtype
    rgb, transmittance, z = image[..., :channels], image[..., channels], image[..., channels + 1]
    if background is not None:
        rgb = rgb + transmittance[..., None] * background.double()
    alpha = 1 - transmittance
    depth = mean_depth(z, alpha).to(dtype) if settings.depth else None
    return RenderOutput(rgb.to(dtype), alpha.to(dtype), depth, stats)


def _composite_ray_block(
    lowered: LoweredPrimitives,
    frame: _PreparedPrimitives,
    rays: ReferenceRays,
    rows: Tensor,
    pixels: Tensor,
    channels: int,
    settings: RenderSettings,
    stats: RenderStats,
) -> Tensor:
    """Composite P rays through the primitives ``rows``, sorted front to back; return (P, channels + 2).

    The columns are premultiplied colour, transmittance and the sum of weight times depth.
    """
    d, P = rays.directions, len(pixels)
    with torch.no_grad():  # find the (primitive, ray) pairs that intersect
        v = frame.whiten[rows].detach() @ d.T  # (R, 3, P)
        p = frame.start[rows].detach()[:, :, None]
        a = (v * v).sum(1)
        tm = -(p * v).sum(1) / a
        x = p + tm[:, None] * v
        D = 1 - (x * x).sum(1)
        far = tm + (D.clamp_min(0) / a).sqrt()
        t_near = rays.near / frame.m[rows].detach()[:, None]
        meet = (D > 0) & (far > t_near)
        i, j = meet.nonzero(as_tuple=True)
    prim = rows[i]
    stats.pairs += int(prim.numel())

    # Chord of every pair, t in units of m: x(t) = p + t v in whitened space.
    dj = d[j]
    v = (frame.whiten[prim] @ dj[:, :, None])[..., 0]
    p = frame.start[prim]
    a = (v * v).sum(-1)
    tm = -(p * v).sum(-1) / a
    x = p + tm[:, None] * v
    # a soft edge has finite gradients at the silhouette by itself
    floor = settings.depth_floor if lowered.density.edge == 0 else 0.0
    h = _FlooredSqrt.apply(1 - (x * x).sum(-1), floor) / a.sqrt()
    m = frame.m[prim]
    t_near = rays.near[j] / m
    t0 = torch.maximum(tm - h, t_near)
    t1 = tm + h
    mid, half = (t0 + t1) / 2, (t1 - t0) / 2
    xm = p + mid[:, None] * v  # whitened chord middle

    world_d = dj @ frame.rotation
    # (x - mu)/m of the chord middle, scene axes
    local = (frame.local[prim] @ (frame.axes[prim] * xm)[:, :, None])[..., 0]
    pairs = PrimitiveChords(prim, world_d, local, half, frame.origin, t0, t1, mid, m, xm, v)
    optical_depth = lowered.optical_depth(pairs)

    alpha = -torch.expm1(-optical_depth.clamp_min(0))
    alpha = alpha.clamp_max(settings.alpha_max)
    counts = (optical_depth.detach() > 0) & (alpha.detach() >= settings.alpha_min)
    alpha = torch.where(counts, alpha, torch.zeros_like(alpha))

    # Front to back: composite, then stop once T < T_min. Rows are already sorted by depth of the centre.
    dense = torch.zeros(len(rows), P, dtype=torch.float64).index_put((i, j), alpha)
    if settings.sort == "entry":
        # sort each ray's chords by entry depth; chords cut by the near plane have equal keys and come first
        with torch.no_grad():
            entry = torch.where(tm - h > t_near, (tm - h) * m * rays.depth[j], torch.zeros_like(h))
            keys = torch.full_like(dense, torch.inf).index_put((i, j), entry)
            by_entry = keys.argsort(dim=0, stable=True)
        dense = dense.gather(0, by_entry)
    ones = torch.ones(1, P, dtype=torch.float64)
    with torch.no_grad():
        before = torch.cat([ones, (1 - dense).cumprod(0)])[:-1]
        live = before >= settings.transmittance_min
    dense = torch.where(live, dense, torch.zeros_like(dense))
    T = torch.cat([ones, (1 - dense).cumprod(0)])
    weights = dense * T[:-1]
    if settings.sort == "entry":
        weights = weights.gather(0, by_entry.argsort(0))
    if weights.requires_grad:
        weights = _Contributions.apply(weights, rows, pixels, stats)

    flat = lowered.colour.flat
    if flat is not None:
        rgb = weights.T @ flat.double()[rows]
    else:
        c = lowered.chord_colours(pairs)
        rgb = torch.zeros(P, channels, dtype=torch.float64).index_add(0, j, weights[i, j][:, None] * c)
    z = (
        torch.zeros(P, dtype=torch.float64).index_add(0, j, weights[i, j] * mid * m * rays.depth[j])
        if settings.depth
        else T[-1] * 0
    )
    return torch.cat([rgb, T[-1][:, None], z[:, None]], -1)


@dataclass(frozen=True)
class ReferenceRays:
    """Rays from the camera centre, in float64."""

    directions: Tensor  # (..., 3) unit vectors in camera axes; a zero vector meets nothing
    near: Tensor  # (...) distance along the ray to the near plane, in scene units; chords begin there at the earliest
    depth: Tensor  # (...) depth divided by distance along the ray


class FrameRays(ABC):
    """Base class: the H x W rays of one frame, and its primitives from front to back."""

    rays: ReferenceRays  # one per pixel
    order: Tensor  # (N,) primitive rows, front to back

    @abstractmethod
    def touched(self, y: int, x: int, h: int, w: int) -> Tensor:
        """Return (N,) bool: whether a ray of the h x w pixels from corner (y, x) may hit each primitive."""

    def block(self, y: int, x: int, h: int, w: int) -> tuple[ReferenceRays, Tensor]:
        """Return the rays of the h x w pixels from corner (y, x), and the primitives that these rays may hit.

        The primitives are (R,) rows, front to back.
        """
        window, r = (slice(y, y + h), slice(x, x + w)), self.rays
        rays = ReferenceRays(
            r.directions[window].reshape(-1, 3), r.near[window].reshape(-1), r.depth[window].reshape(-1)
        )
        return rays, self.order[self.touched(y, x, h, w)[self.order]]


def pixel_ray_directions(camera: Camera) -> Tensor:
    """Return (H, W, 3) float64 unit ray directions in camera axes; differentiable in intrinsics that are tensors."""
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    gy, gx = torch.meshgrid(y, x, indexing="ij")
    d = torch.stack([gx, gy, torch.ones_like(gx)], -1)
    return d / d.norm(dim=-1, keepdim=True)


class _PinholeRays(FrameRays):
    """Rays of a pinhole camera: near plane, depth and order are in camera-z, and culling uses exact screen boxes."""

    def __init__(self, camera: Camera, geometry: Geometry, center: Tensor, near: float) -> None:
        d = pixel_ray_directions(camera)
        self.rays = ReferenceRays(d, near / d[..., 2], d[..., 2])
        with torch.no_grad():
            self.order = torch.argsort(center[:, 2], stable=True)
            self.boxes = screen_boxes(geometry, camera, near)

    def touched(self, y: int, x: int, h: int, w: int) -> Tensor:
        b = self.boxes
        return (b[:, 0] < x + w) & (b[:, 2] > x) & (b[:, 1] < y + h) & (b[:, 3] > y)


class _CentralRays(FrameRays):
    """Rays of a RayCamera: near plane, depth and order are distances from the camera.

    Culling compares a cone around the rays of a block with the cone around each primitive's bounding sphere.
    """

    def __init__(self, camera: RayCamera, geometry: Geometry, center: Tensor, near: float) -> None:
        d = camera.directions.double()
        self.rays = ReferenceRays(d, torch.full_like(d[..., 0], near), torch.ones_like(d[..., 0]))
        with torch.no_grad():
            distance = center.norm(dim=-1)
            self.order = torch.argsort(distance, stable=True)
            radius = geometry.log_scales.double().amax(-1).exp() if geometry.count else distance
            inside = radius >= distance
            safe = torch.where(inside, torch.ones_like(distance), distance)
            self.toward = center / safe[:, None]
            # half angle of the bounding sphere seen from the camera; pi from inside it
            self.angle = torch.where(inside, torch.full_like(distance, math.pi), (radius / safe).clamp_max(1).asin())

    def touched(self, y: int, x: int, h: int, w: int) -> Tensor:
        with torch.no_grad():
            d = self.rays.directions[y : y + h, x : x + w].reshape(-1, 3)
            d = d[d.any(-1)]
            axis = d.sum(0)
            axis = axis / axis.norm().clamp_min(1e-30)
            spread = (d @ axis).clamp(-1, 1).acos().amax() if len(d) else torch.tensor(-math.pi, dtype=torch.float64)
            slack = 1e-6  # arc cosines of nearly parallel unit vectors are good to 1e-8
            return (self.toward @ axis).clamp(-1, 1).acos() <= spread + self.angle + slack


def frame_rays(camera: AnyCamera, geometry: Geometry, center: Tensor, near: float) -> FrameRays:
    """Return the rays of all pixels of a camera, and the order of the primitives along them.

    The order, front to back, follows from ``center``, the (N, 3) float64 centres of the primitives in camera
    coordinates.
    """
    make = _CentralRays if isinstance(camera, RayCamera) else _PinholeRays
    return make(camera, geometry, center, near)  # type: ignore[arg-type]


def screen_boxes(geometry: Geometry, camera: Camera, near: float) -> Tensor:
    """Return the (N, 4) float64 pixel bounds (x0, y0, x1, y1) of each ellipsoid's projection.

    In camera axes, c is the ellipsoid's centre, z its depth and B the orientation; s are the semi-axes. With
    S = B diag(s^2) B^T, the tangents in the plane of image axis i and the optical axis are x_i/z =
    (k +- sqrt(D))/(z^2 - S_zz), where k = c_i z - S_iz and D = z^2 S_ii - 2 c_i z S_iz + c_i^2 S_zz -
    (S_ii S_zz - S_iz^2). An ellipsoid that the near plane cuts gets the whole screen. An ellipsoid wholly before the
    near plane gets an empty box (x1 < x0).
    """
    view = camera.viewmat.detach().double()
    R = view[:3, :3]
    c = geometry.means.detach().double() @ R.T + view[:3, 3]
    s = geometry.log_scales.detach().double().exp()
    B = R @ quaternion_to_matrix(geometry.quats.detach().double())
    L = B * s[:, None, :]
    S = L @ L.transpose(1, 2)
    z, szz = c[:, 2], S[:, 2, 2]
    reach = szz.sqrt()
    front = z - reach > near
    out = []
    for i, f, c0, size in ((0, camera.fx, camera.cx, camera.width), (1, camera.fy, camera.cy, camera.height)):
        ci, sii, siz = c[:, i], S[:, i, i], S[:, i, 2]
        D = z * z * sii - 2 * ci * z * siz + ci * ci * szz - (sii * szz - siz * siz)
        root = D.clamp_min(0).sqrt()
        k = ci * z - siz
        den = torch.where(front, z * z - szz, torch.ones_like(z))
        whole = torch.tensor([0.0, float(size)], dtype=torch.float64)
        out.append(torch.where(front, f * (k - root) / den + c0, whole[0]))
        out.append(torch.where(front, f * (k + root) / den + c0, whole[1]))
    box = torch.stack([out[0], out[2], out[1], out[3]], -1)
    behind = z + reach <= near
    box[behind] = torch.tensor([0.0, 0.0, -1.0, -1.0], dtype=torch.float64)
    return box
