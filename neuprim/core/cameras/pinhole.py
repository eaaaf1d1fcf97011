"""Pinhole cameras, and other central projections, which are stored as one ray direction per pixel.

Camera axes are OpenCV's (x right, y down, z forward). View matrices are world to camera. Pixel centres are at +0.5.
"""

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
    """A pinhole camera with an image size; lengths are in pixels."""

    viewmat: Tensor  # (4, 4) world to camera, OpenCV axes; float64 unless it carries gradients of another dtype
    fx: float  # focal length in x
    fy: float  # focal length in y
    cx: float  # principal point in x; may lie outside of the image
    cy: float  # principal point in y
    width: int  # width of the image
    height: int  # height of the image

    @property
    def position(self) -> Tensor:
        """Camera centre, (3,), scene units."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @property
    def K(self) -> Tensor:
        """Intrinsic matrix [[fx, 0, cx], [0, fy, cy], [0, 0, 1]], (3, 3) float64, in pixels."""
        return torch.tensor([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]], dtype=torch.float64)

    def resized(self, width: int, height: int) -> Camera:
        """Return this camera for another image size in pixels; the intrinsics scale with width and height."""
        sx, sy = width / self.width, height / self.height
        return Camera(self.viewmat, self.fx * sx, self.fy * sy, self.cx * sx, self.cy * sy, width, height)

    def reduced(self, factor: int) -> Camera:
        """Return this camera with pixels ``factor`` times as wide and high; remaining columns and rows are cut off."""
        fx, fy, cx, cy = (value / factor for value in (self.fx, self.fy, self.cx, self.cy))
        return Camera(self.viewmat, fx, fy, cx, cy, self.width // factor, self.height // factor)

    def strided(self, stride: int, column: int, row: int) -> Camera:
        """Return a camera with the rays of every ``stride``-th pixel in x and y, from the pixel (column, row) on."""
        cx, cy = ((c - first - 0.5) / stride + 0.5 for c, first in ((self.cx, column), (self.cy, row)))
        width, height = -(-(self.width - column) // stride), -(-(self.height - row) // stride)
        return Camera(self.viewmat, self.fx / stride, self.fy / stride, cx, cy, width, height)

    def project(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Project (N, 3) points; return (N, 2) pixels (x, y), valid for depth > 0, and (N,) depths along z, float64."""
        view = self.viewmat.double()
        x, y, z = (points.double() @ view[:3, :3].T + view[:3, 3]).unbind(-1)
        return torch.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy], dim=-1), z

    def sees(self, points: Tensor) -> Tensor:
        """Return (N,) bool: which points (N, 3) lie in front of the camera and inside its image."""
        pixels, z = self.project(points)
        return (z > 0) & (pixels >= 0).all(1) & (pixels < torch.tensor([self.width, self.height])).all(1)

    def validate(self, where: str) -> Camera:
        """Return this camera; raise DataError naming ``where`` for invalid intrinsics, image size or view matrix."""
        numbers = torch.tensor([self.fx, self.fy, self.cx, self.cy], dtype=torch.float64)
        if not (torch.isfinite(numbers).all() and self.fx > 0 and self.fy > 0):
            found = f"intrinsics fx={self.fx} fy={self.fy} cx={self.cx} cy={self.cy}"
            raise DataError(f"{where}: {found}; expected finite numbers and focal lengths above 0")
        if self.width <= 0 or self.height <= 0:
            raise DataError(f"{where}: image size {self.width}x{self.height}; expected positive numbers")
        check_viewmat(self.viewmat, where)
        return self


def check_viewmat(viewmat: Tensor, where: str) -> None:
    """Raise DataError naming ``where`` unless ``viewmat`` is finite, (4, 4), and its upper left (3, 3) a rotation."""
    view = viewmat.detach().double().cpu()
    if view.shape != (4, 4) or not torch.isfinite(view).all():
        found = f"camera matrix has shape {tuple(view.shape)} or non-finite entries"
        raise DataError(f"{where}: {found}; expected a 4x4 matrix of finite numbers")
    R = view[:3, :3]
    error = (R @ R.T - torch.eye(3, dtype=torch.float64)).abs().max().item()
    if error > 1e-3:
        found = f"camera rotation is singular or scaled (|R R^T - 1| = {error:.2g})"
        raise DataError(f"{where}: {found}; expected a rotation")
    if torch.linalg.det(R).item() < 0:
        raise DataError(f"{where}: camera rotation is mirrored (determinant -1); expected a rotation")


def opengl_to_viewmat(c2w: Tensor) -> Tensor:
    """Convert a camera-to-world matrix with OpenGL axes to a world-to-camera matrix with OpenCV axes, both (4, 4).

    OpenGL and Blender cameras have x right, y up, z backward; OpenCV's have x right, y down, z forward.
    """
    c2w = c2w.double()
    flip = torch.diag(torch.tensor([1.0, -1.0, -1.0, 1.0], dtype=torch.float64))
    c2w_cv = c2w @ flip
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3] = c2w_cv[:3, :3].T
    view[:3, 3] = -c2w_cv[:3, :3].T @ c2w_cv[:3, 3]
    return view


def look_at(eye: Tensor, target: Tensor, up: Tensor) -> Tensor:
    """Return the (4, 4) world-to-camera matrix, OpenCV axes, at ``eye`` looking at ``target``, with ``up`` upwards."""
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


def horizontal_axes(up: Tensor) -> tuple[Tensor, Tensor]:
    """Return two (3,) float64 unit vectors a and b, at right angles to the unit vector ``up``, with b = up x a."""
    helper = torch.tensor([1.0, 0, 0] if abs(up[0]) < 0.9 else [0, 1.0, 0], dtype=torch.float64)
    a = torch.linalg.cross(up, helper)
    a = a / a.norm()
    return a, torch.linalg.cross(up, a)


def orbit(template: Camera, center: Tensor, up: Tensor, radius: float, elevation: float, count: int) -> list[Camera]:
    """Return ``count`` copies of the camera ``template`` on a circle, all looking at ``center``.

    ``radius`` is the distance of the cameras from ``center``, in scene units. ``elevation`` is the angle of the cameras
    above the plane through ``center`` at right angles to ``up``, in radians.
    """
    up = (up / up.norm()).double()
    a, b = horizontal_axes(up)
    views = []
    for i in range(count):
        t = 2 * math.pi * i / count
        eye = center.double() + radius * (
            math.cos(elevation) * (math.cos(t) * a + math.sin(t) * b) + math.sin(elevation) * up
        )
        views.append(replace(template, viewmat=look_at(eye, center, up)))
    return views


MAX_CAMERAS = 100_000  # most cameras of one file
MAX_IMAGE_SIDE = 32768  # pixels
FRAME_RATES = (0.1, 240.0)  # least and most frames per second of a film, as ``--fps`` takes them


@dataclass(frozen=True)
class CameraViews:
    """The cameras that a file contains, in order."""

    named: tuple[tuple[str, Camera], ...]  # (name, camera) pairs
    times: tuple[float, ...] | None = None  # time of each camera, in the file's own unit
    fps: float | None = None  # frames per second, if the file names them
    notes: tuple[str, ...] = ()  # lines for the user on conventions, and on what cannot be rendered
    codes: tuple[float, ...] | None = None  # time code of each camera of a USD stage: its frame number


def camera_exr_attributes(camera: Camera, near: float) -> dict[str, Any]:
    """Return header attributes, by name, that describe a camera in an OpenEXR file.

    The standard attributes are ``worldToCamera``, ``worldToNDC``, ``screenWindowCenter`` and ``screenWindowWidth``. The
    matrices multiply row vectors. Camera space is left-handed, with y up and z forward. Device coordinates (NDC) run
    from (0, 0) at the upper left to (1, 1). neuprim adds ``neuprim:worldToCamera`` in float64, ``neuprim:focalLength``
    and ``neuprim:principalPoint`` (x, y, pixels), and ``neuprim:near``, the depth of the near plane.
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


_UNIT = 1e-6  # how far from 1 a direction's length may be: float32 rounding passes, a forgotten normalisation does not


@dataclass(frozen=True)
class RayCamera:
    """A camera with one ray direction per pixel, such as a fisheye or a panorama.

    Only the backend ``reference`` renders a RayCamera. All rays start at one point; rays may point backwards (z < 0).
    The near distance, depth images and the order of primitives use distances along the rays, whereas a :class:`Camera`
    uses depths along z. So the two kinds of camera give different images where the near distance cuts a primitive.
    Raises DataError if ``viewmat`` is not a rotation and a translation, or directions are not of unit length.
    """

    viewmat: Tensor  # (4, 4) world to camera, OpenCV axes
    directions: Tensor  # (H, W, 3) unit vectors in camera axes, float64 for full accuracy; zero for no ray

    def __post_init__(self) -> None:
        check_viewmat(self.viewmat, "RayCamera.viewmat")
        d = self.directions.detach().double()
        if d.dim() != 3 or d.shape[-1] != 3 or not d.numel():
            raise DataError(f"RayCamera.directions has shape {tuple(d.shape)}; expected (H, W, 3), one pixel or more")
        length = d.norm(dim=-1)
        wrong = ~(((length - 1).abs() <= _UNIT) | (length == 0))
        if bool(wrong.any()):
            y, x = wrong.nonzero()[0].tolist()
            found = f"pixel (x={x}, y={y}) is {d[y, x].tolist()} of length {length[y, x]:.9g}"
            raise DataError(f"RayCamera.directions: {found}; expected length 1, or a zero vector for no ray")

    @property
    def width(self) -> int:
        return int(self.directions.shape[1])

    @property
    def height(self) -> int:
        return int(self.directions.shape[0])

    @property
    def position(self) -> Tensor:
        """Camera centre, (3,), scene units."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @classmethod
    def fisheye(cls, width: int, height: int, viewmat: Tensor, fov_degrees: float = 180.0) -> RayCamera:
        """Return a fisheye camera whose shorter image side spans ``fov_degrees``, at most 360.

        The fisheye is equidistant: a ray's angle to the axis is proportional to its distance from the image centre.
        Pixels more than 180 degrees from the axis have no ray. Raises DataError for an invalid size or field of view.
        """
        _check_ray_camera_size("fisheye", width, height)
        if not 0.0 < fov_degrees <= 360.0:
            raise DataError(f"RayCamera.fisheye: fov_degrees={fov_degrees!r}; expected a number in (0, 360]")
        per_pixel = math.radians(fov_degrees) / min(width, height)
        y, x = _pixel_centre_grid(width, height)
        x, y = x - width / 2, y - height / 2
        radius = torch.hypot(x, y)
        theta = radius * per_pixel
        side = theta.sin() / torch.where(radius > 0, radius, torch.ones_like(radius))
        directions = torch.stack([x * side, y * side, theta.cos()], -1)
        return cls(viewmat, torch.where((theta <= math.pi)[..., None], directions, torch.zeros_like(directions)))

    @classmethod
    def equirectangular(cls, width: int, height: int, viewmat: Tensor) -> RayCamera:
        """Return a full panorama: columns are longitudes -180..180 degrees, rows latitudes 90 (up, -y) to -90."""
        _check_ray_camera_size("equirectangular", width, height)
        y, x = _pixel_centre_grid(width, height)
        longitude, latitude = (x / width - 0.5) * (2 * math.pi), (0.5 - y / height) * math.pi
        flat = latitude.cos()
        return cls(viewmat, torch.stack([longitude.sin() * flat, -latitude.sin(), longitude.cos() * flat], -1))


AnyCamera = Camera | RayCamera
"""Any camera that can be rendered; all kinds have ``viewmat``, ``position``, ``width`` and ``height``."""


def _check_ray_camera_size(name: str, width: int, height: int) -> None:
    if width <= 0 or height <= 0:
        raise DataError(f"RayCamera.{name}: image size {width}x{height}; expected positive numbers")


def _pixel_centre_grid(width: int, height: int) -> tuple[Tensor, Tensor]:
    """Return the coordinates y and x of all pixel centres, each (H, W) float64, in pixels."""
    ys, xs = torch.arange(height, dtype=torch.float64) + 0.5, torch.arange(width, dtype=torch.float64) + 0.5
    y, x = torch.meshgrid(ys, xs, indexing="ij")
    return y, x
