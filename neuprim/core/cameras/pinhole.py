"""Pinhole cameras: OpenCV axes (x right, y down, z forward), world-to-camera matrices, pixel centres at +0.5."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import DataError


@dataclass(frozen=True)
class Camera:
    """A pinhole view; lengths in pixels."""

    viewmat: Tensor  # (4, 4) world to camera, OpenCV axes; float64 unless it carries gradients of another dtype
    fx: float
    fy: float
    cx: float  # the principal point may lie outside of the image
    cy: float
    width: int
    height: int

    @property
    def position(self) -> Tensor:
        """(3,) camera centre in scene units."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def K(self) -> Tensor:
        """(3, 3) intrinsics, float64."""
        return torch.tensor([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]], dtype=torch.float64)

    def resized(self, width: int, height: int) -> Camera:
        """Return the same view sampled on another pixel grid."""
        sx, sy = width / self.width, height / self.height
        return Camera(self.viewmat, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)

    def reduced(self, factor: int) -> Camera:
        """Return the view with pixels ``factor`` times as large; remainders at the right and bottom are cut off."""
        fx, fy, cx, cy = (value / factor for value in (self.fx, self.fy, self.cx, self.cy))
        return Camera(self.viewmat, fx, fy, cx, cy, self.width // factor, self.height // factor)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Return (N, 2) pixels and (N,) depths of (N, 3) points, float64; pixels are valid for depth > 0."""
        view = self.viewmat.double()
        x, y, z = (points.double() @ view[:3, :3].T + view[:3, 3]).unbind(-1)
        return torch.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], dim=-1), z

    def sees(self, points: Tensor) -> Tensor:
        """(N,) bool: points in front of the camera and inside its image."""
        pixels, z = self.project(points)
        return (z > 0) & (pixels >= 0).all(1) & (pixels < torch.tensor([self.width, self.height])).all(1)

    def validate(self, where: str) -> Camera:
        """Return self, or raise DataError naming ``where`` for non-finite, singular, scaled or mirrored cameras."""
        numbers = torch.tensor([self.fx, self.fy, self.cx, self.cy], dtype=torch.float64)
        if not (torch.isfinite(numbers).all() and self.fx > 0 and self.fy > 0):
            found = f"intrinsics fx={self.fx} fy={self.fy} cx={self.cx} cy={self.cy}"
            raise DataError(f"{where}: {found}; expected finite numbers, focal lengths > 0")
        if self.width <= 0 or self.height <= 0:
            raise DataError(f"{where}: image size {self.width}x{self.height}; expected positive")
        check_viewmat(self.viewmat, where)
        return self


def check_viewmat(viewmat: Tensor, where: str) -> None:
    """Raise DataError naming ``where`` unless ``viewmat`` is finite (4, 4) with a rotation in its upper left."""
    view = viewmat.detach().double().cpu()
    if view.shape != (4, 4) or not torch.isfinite(view).all():
        found = f"camera matrix has shape {tuple(view.shape)} or non-finite entries"
        raise DataError(f"{where}: {found}; expected finite 4x4")
    R = view[:3, :3]
    error = (R @ R.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
    if error > 1e-3:
        found = f"camera rotation is singular or scaled (|R R^T - 1| = {error:.2g})"
        raise DataError(f"{where}: {found}; expected a rotation")
    if torch.linalg.det(R).item() < 0:
        raise DataError(f"{where}: camera rotation is mirrored (determinant -1); expected a rotation")


def opengl_to_viewmat(c2w: Tensor) -> Tensor:
    """World-to-camera OpenCV matrix of an OpenGL/Blender camera-to-world one (x right, y up, z backward)."""
    c2w = c2w.double()
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    c2w_cv = c2w @ flip
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = c2w_cv[:3, :3].T
    view[:3, 3] = -c2w_cv[:3, :3].T @ c2w_cv[:3, 3]
    return view


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """(4, 4) world-to-camera OpenCV matrix of a camera at ``eye`` looking at ``target``; ``up`` is up in the image."""
    eye, target, up = eye.double(), target.double(), up.double()
    z = target - eye
    z = z / z.norm()
    x = torch.linalg.cross(z, up)
    if x.norm() < 1e-9:  # looking along `up`: any horizontal axis will do
        x = torch.linalg.cross(z, up.roll(1))
    x = x / x.norm()
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = torch.stack([x, torch.linalg.cross(z, x), z])
    view[:3, 3] = -view[:3, :3] @ eye
    return view


def orbit(template: Camera, center: Tensor, up: Tensor, radius: float, elevation: float, count: int) -> list[Camera]:
    """``count`` cameras on a circle around ``center``, ``elevation`` radians above the plane normal to ``up``."""
    up = (up / up.norm()).double()
    helper = torch.tensor([1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0], dtype=torch.float64)
    a = torch.linalg.cross(up, helper)
    a = a / a.norm()
    b = torch.linalg.cross(up, a)
    views = []
    for i in range(count):
        t = 2 * math.pi * i / count
        eye = center.double() + radius * (
            math.cos(elevation) * (math.cos(t) * a + math.sin(t) * b) + math.sin(elevation) * up
        )
        views.append(replace(template, viewmat=look_at(eye, center, up)))
    return views


MAX_CAMERAS = 100_000  # of one file
MAX_IMAGE_SIDE = 32768  # pixels
FRAME_RATES = (0.1, 240.0)  # least and most frames per second of a film, as ``--fps`` takes them


@dataclass(frozen=True)
class CameraViews:
    """Cameras of a file, in order."""

    named: tuple[tuple[str, Camera], ...]  # with their names
    times: tuple[float, ...] | None = None  # in the file's own unit
    fps: float | None = None  # of their film
    notes: tuple[str, ...] = ()  # lines for the user on conventions, and on what cannot be drawn


def camera_exr_attributes(camera: Camera, near: float) -> dict[str, Any]:
    """Return the standard camera attributes of an OpenEXR file by name.

    These are ``worldToCamera``, ``worldToNDC``, ``screenWindowCenter`` and ``screenWindowWidth``. They multiply row
    vectors, in a left-handed space with y up and z forward; device coordinates run from (0, 0) at the upper left to
    (1, 1). Added are ``neuprim:worldToCamera`` in float64, ``neuprim:focalLength`` and ``neuprim:principalPoint``
    (x, y, pixels), and ``neuprim:near``.
    """
    view = camera.viewmat.detach().double().cpu().numpy()
    up = np.diag([1.0, -1.0, 1.0, 1.0])
    width, height = float(camera.width), float(camera.height)
    project = np.array(
        [
            [camera.fx / width, 0.0, camera.cx / width, 0.0],
            [0.0, camera.fy / height, camera.cy / height, 0.0],
            [0.0, 0.0, 1.0, -near],  # after the division: 0 at the near plane, 1 far away
            [0.0, 0.0, 1.0, 0.0],
        ]
    )
    return {
        "worldToCamera": np.ascontiguousarray((up @ view).T, dtype=np.float32),
        "neuprim:worldToCamera": np.ascontiguousarray((up @ view).T),
        "worldToNDC": np.ascontiguousarray((project @ view).T, dtype=np.float32),
        "screenWindowCenter": np.array(
            [(width / 2 - camera.cx) / camera.fx, (camera.cy - height / 2) / camera.fy], np.float32
        ),
        "screenWindowWidth": width / camera.fx,
        "neuprim:focalLength": np.array([camera.fx, camera.fy], np.float32),
        "neuprim:principalPoint": np.array([camera.cx, camera.cy], np.float32),
        "neuprim:near": float(near),
    }
