"""The camera that takes the photographs: 4:3, a wide angle, and a lens that bends; rays of its pixels, and back from
points to pixels."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from neuprim.core.cameras import Camera
from neuprim.core.data.distortion import Radial

__all__ = ["LENS", "Lens", "bands"]

LENS = Radial(k1=-0.08, k2=0.02, p1=0.001, p2=-0.0005)

RAYS_AT_ONCE = 1 << 15
"""Small enough for the arrays to stay in the processor's cache."""

_STEPS = 60
_CLOSE = 1e-13


@dataclass(frozen=True)
class Lens:
    """Intrinsics of one size of image.

    Attributes:
        width: pixels; the height is three quarters of it, rounded.
        distortion: OpenCV's model; all zeros is a pinhole.
    """

    width: int
    distortion: Radial = LENS

    @property
    def height(self) -> int:
        return round(0.75 * self.width)

    @property
    def focal(self) -> float:
        """In pixels, along both axes: 75 degrees of view across."""
        return 0.65 * self.width

    @property
    def camera(self) -> Camera:
        """The pinhole of the undistorted image, in the camera's own frame; the principal point is a little off the
        middle."""
        centre = 0.504 * self.width, 0.495 * self.height
        return Camera(torch.eye(4, dtype=torch.float64), self.focal, self.focal, *centre, self.width, self.height)

    def pixels(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """(M, 2) photographed pixels of (M, 2) undistorted directions (x/z, y/z), OpenCV axes; pixel centres at
        +0.5."""
        return self.distortion.project(points, self.camera)

    def directions(self, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """(M, 2) undistorted directions (x/z, y/z) of (M, 2) photographed pixels; the inverse of :meth:`pixels`.

        The lens moves nothing by more than a fraction of its distance to the middle, so taking the excess away again
        and again converges.
        """
        camera = self.camera
        bent = (pixels - [camera.cx, camera.cy]) / self.focal
        points = bent.copy()
        for _ in range(_STEPS):
            excess = (self.distortion.project(points, camera) - [camera.cx, camera.cy]) / self.focal - bent
            points -= excess
            if np.abs(excess).max(initial=0.0) < _CLOSE:
                break
        return points

    def rays(self, pose: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.float64]:
        """(M, 3) unit directions in the scene of (M, 2) photographed pixels.

        Args:
            pose: (4, 4) camera to world, OpenGL axes.
        """
        x, y = self.directions(pixels).T
        local = np.stack([x, -y, -np.ones_like(x)], axis=1)
        local /= np.sqrt(np.einsum("nc,nc->n", local, local))[:, None]
        return local @ pose[:3, :3].T


def bands(lens: Lens, pose: NDArray[np.float64], samples: int) -> Iterator[NDArray[np.float64]]:
    """(N, 3) unit directions in the scene, whole rows of pixels at a time from the top, row by row of rays.

    Args:
        pose: (4, 4) camera to world, OpenGL axes.
        samples: rays per pixel along each axis, through the middles of its cells.
    """
    across = (np.arange(lens.width * samples) + 0.5) / samples
    down = (np.arange(lens.height * samples) + 0.5) / samples
    rows = max(1, RAYS_AT_ONCE // (len(across) * samples)) * samples
    for top in range(0, len(down), rows):
        x, y = np.meshgrid(across, down[top : top + rows])
        yield lens.rays(pose, np.stack([x, y], axis=-1).reshape(-1, 2))
