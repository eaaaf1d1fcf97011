"""Rays of a camera for the reference backend, the order of primitives, and exact screen bounds of ellipsoids; float64."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.projections import AnyCamera, RayCamera
from neuprim.core.model.geometry import Geometry, quaternion_to_matrix


@dataclass(frozen=True)
class Rays:
    """Rays from the camera centre, float64."""

    directions: Tensor  # (..., 3) unit vectors in camera axes; a zero vector meets nothing
    near: Tensor  # (...) ray distance before which chords are cut, scene units
    depth: Tensor  # (...) depth per unit of ray distance


class FrameRays(ABC):
    """The rays (H, W) of one frame, and its primitives front to back."""

    rays: Rays  # one per pixel
    order: Tensor  # (N,) primitive rows, front to back

    @abstractmethod
    def touched(self, y: int, x: int, h: int, w: int) -> Tensor:
        """(N,) whether a ray of the h x w pixels at (y, x) may meet each primitive; never false for one that is met."""

    def block(self, y: int, x: int, h: int, w: int) -> tuple[Rays, Tensor]:
        """The h*w rays of a block of pixels, flat, and the rows they may meet, front to back."""
        window, r = (slice(y, y + h), slice(x, x + w)), self.rays
        rays = Rays(r.directions[window].reshape(-1, 3), r.near[window].reshape(-1), r.depth[window].reshape(-1))
        return rays, self.order[self.touched(y, x, h, w)[self.order]]


def pixel_directions(camera: Camera) -> Tensor:
    """(H, W, 3) float64 unit ray directions in camera axes; differentiable in intrinsics that are tensors."""
    x = (torch.arange(camera.width, dtype=torch.float64) + 0.5 - camera.cx) / camera.fx
    y = (torch.arange(camera.height, dtype=torch.float64) + 0.5 - camera.cy) / camera.fy
    gy, gx = torch.meshgrid(y, x, indexing="ij")
    d = torch.stack([gx, gy, torch.ones_like(gx)], -1)
    return d / d.norm(dim=-1, keepdim=True)


class _Pinhole(FrameRays):
    """Near is a camera-z plane, depth is camera-z, the order is that of the centres' z, the cull exact screen boxes."""

    def __init__(self, camera: Camera, geometry: Geometry, center: Tensor, near: float) -> None:
        d = pixel_directions(camera)
        self.rays = Rays(d, near / d[..., 2], d[..., 2])
        with torch.no_grad():
            self.order = torch.argsort(center[:, 2], stable=True)
            self.boxes = screen_boxes(geometry, camera, near)

    def touched(self, y: int, x: int, h: int, w: int) -> Tensor:
        b = self.boxes
        return (b[:, 0] < x + w) & (b[:, 2] > x) & (b[:, 1] < y + h) & (b[:, 3] > y)


class _Central(FrameRays):
    """Near, depth and the order are distances from the camera; the cull is a cone round each block's rays."""

    def __init__(self, camera: RayCamera, geometry: Geometry, center: Tensor, near: float) -> None:
        d = camera.directions.double()
        self.rays = Rays(d, torch.full_like(d[..., 0], near), torch.ones_like(d[..., 0]))
        with torch.no_grad():
            distance = center.norm(dim=-1)
            self.order = torch.argsort(distance, stable=True)
            radius = geometry.log_scales.double().amax(-1).exp() if geometry.count else distance
            inside = radius >= distance
            safe = torch.where(inside, torch.ones_like(distance), distance)
            self.toward = center / safe[:, None]
            # half angle under which the bounding sphere appears; all directions from inside it
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
    """The frame's rays; ``center`` (N, 3) are the primitives' centres in camera axes, float64."""
    make = _Central if isinstance(camera, RayCamera) else _Pinhole
    return make(camera, geometry, center, near)  # type: ignore[arg-type]


def screen_boxes(geometry: Geometry, camera: Camera, near: float) -> Tensor:
    """(N, 4) float64 pixel bounds (x0, y0, x1, y1) of each ellipsoid's projection.

    In the plane of image axis i and the optical axis, the tangents are x_i/z = (k +- sqrt(D))/(z^2 - S_zz) with
    k = c_i z - S_iz, D = z^2 S_ii - 2 c_i z S_iz + c_i^2 S_zz - (S_ii S_zz - S_iz^2), S = B diag(s^2) B^T and centre c.
    An ellipsoid that the near plane cuts has the whole screen, one behind it nothing (x1 < x0).
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
