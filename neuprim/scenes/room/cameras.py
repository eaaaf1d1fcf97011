"""Cameras of the scene ``room``: a lens with distortion, and the path that photographs are taken from."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from neuprim.core.cameras import Camera, look_at
from neuprim.core.data.distortion import Radial

__all__ = [
    "FARTHEST",
    "HIGHEST",
    "LENS",
    "LOWEST",
    "Lens",
    "NEAREST",
    "lens_ray_bands",
    "room_camera_poses",
    "camera_positions",
]

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


def lens_ray_bands(lens: Lens, pose: NDArray[np.float64], samples: int) -> Iterator[NDArray[np.float64]]:
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


NEAREST, FARTHEST = 2.6, 4.5
"""Bounds of the distance to the subject's middle, the origin; scene units."""

LOWEST, HIGHEST = 0.3, 2.0
"""Bounds of the height above it."""

_ROUNDS = 2
_SEEDS = {"train": 20250311, "test": 20250312}


def camera_positions(train: int, test: int) -> dict[str, NDArray[np.float64]]:
    """Where on the walk, 0 to 1, the photographs of each split are taken: (train,) and (test,).

    The test ones divide the walk evenly, whatever the training ones are; these fill the gaps, evenly in each.
    """
    held_out = (np.arange(test) + 0.5) / test
    gap = np.arange(train) * test // train
    first = np.searchsorted(gap, gap)
    within = (np.arange(train) - first + 1) / (np.bincount(gap, minlength=test)[gap] + 1)
    return {"train": (gap - 0.5 + within) / test, "test": held_out}


def room_camera_poses(train: int, test: int) -> dict[str, list[NDArray[np.float64]]]:
    """Camera-to-world matrices (4, 4), OpenGL axes, of both splits. Those of the test split depend on their own number
    alone."""
    return {split: _walk(t, _SEEDS[split]) for split, t in camera_positions(train, test).items()}


def _walk(times: NDArray[np.float64], seed: int) -> list[NDArray[np.float64]]:
    shake = 2 * np.random.default_rng(seed).random((len(times), 7)) - 1
    return [_pose(float(t), s) for t, s in zip(times, shake, strict=True)]


def _pose(t: float, shake: NDArray[np.float64]) -> NDArray[np.float64]:
    """(4, 4) at ``t`` of the walk; ``shake`` (7,) of -1..1 moves the hand, the aim and the horizon."""
    turn = 2 * math.pi
    distance = 3.55 + 0.8 * math.sin(turn * (5 * t + 0.15)) + 0.12 * shake[0]
    height = 1.1 - 0.6 * math.cos(turn * t) + 0.1 * math.sin(turn * 7 * t) + 0.06 * shake[1]
    azimuth = turn * _ROUNDS * t + 0.06 * shake[2]
    across = math.sqrt(distance**2 - height**2)
    eye = np.array([across * math.cos(azimuth), across * math.sin(azimuth), height])
    aim = 0.14 * shake[3:6] + [0, 0, -0.05]
    roll = math.radians(2.5) * shake[6]
    sideways = np.array([-math.sin(azimuth), math.cos(azimuth), 0.0])
    up = math.cos(roll) * np.array([0, 0, 1.0]) + math.sin(roll) * sideways
    view = look_at(*(torch.from_numpy(np.asarray(v, dtype=np.float64)) for v in (eye, aim, up)))
    return torch.linalg.inv(view).numpy() @ np.diag([1.0, -1.0, -1.0, 1.0])
