"""Central cameras that are no pinholes: one unit direction per pixel (fisheye, panorama, any calibrated lens)."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, check_viewmat
from neuprim.core.errors import DataError

_UNIT = 1e-6  # how far from 1 a direction's length may be: float32 rounding passes, a forgotten normalisation does not


@dataclass(frozen=True)
class RayCamera:
    """A view whose rays all leave one point, each in its own direction, backwards (z < 0) too.

    Distances along the ray take the place of depths: for ``near``, depth images and the order of primitives. Images
    therefore differ from a pinhole's where a near plane cuts chords. Only the reference backend draws these cameras.
    A zero vector marks a pixel without a ray. Raises DataError for no rigid transform, or directions not of unit
    length.
    """

    viewmat: Tensor  # (4, 4) world to camera, OpenCV axes
    directions: Tensor  # (H, W, 3) unit vectors in camera axes, float64 for full accuracy

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
        """(3,) camera centre in scene units."""
        return -self.viewmat[:3, :3].T @ self.viewmat[:3, 3]

    @classmethod
    def fisheye(cls, width: int, height: int, viewmat: Tensor, fov_degrees: float = 180.0) -> RayCamera:
        """Make an equidistant fisheye, whose ``fov_degrees``, at most 360, span the shorter side.

        Pixels beyond 180 degrees off the axis have no ray. Raises DataError for an impossible size or field of view.
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
        """Make a full panorama: columns are longitudes -180..180 degrees, rows latitudes from 90 (up, -y) to -90."""
        _check_ray_camera_size("equirectangular", width, height)
        y, x = _pixel_centre_grid(width, height)
        longitude, latitude = (x / width - 0.5) * (2 * math.pi), (0.5 - y / height) * math.pi
        flat = latitude.cos()
        return cls(viewmat, torch.stack([longitude.sin() * flat, -latitude.sin(), longitude.cos() * flat], -1))


AnyCamera = Camera | RayCamera
"""What the renderer and the colour fields accept; both have ``viewmat``, ``position``, ``width`` and ``height``."""


def _check_ray_camera_size(name: str, width: int, height: int) -> None:
    if width <= 0 or height <= 0:
        raise DataError(f"RayCamera.{name}: image size {width}x{height}; expected positive")


def _pixel_centre_grid(width: int, height: int) -> tuple[Tensor, Tensor]:
    """(y, x) of the pixel centres, each (H, W), float64."""
    ys, xs = torch.arange(height, dtype=torch.float64) + 0.5, torch.arange(width, dtype=torch.float64) + 0.5
    y, x = torch.meshgrid(ys, xs, indexing="ij")
    return y, x
