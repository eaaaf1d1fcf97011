"""Cameras as a page knows them (orientation, position, vertical field of view, window) and as the renderer does."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from neuprim.core.cameras import Camera

__all__ = ["Pose", "fitted"]


@dataclass(frozen=True, eq=False)
class Pose:
    """Where one stands and looks, whatever the window.

    Attributes:
        wxyz: (4,) unit quaternion, camera to world, OpenCV axes (x right, y down, z forward).
        position: (3,) scene units.
        fov: vertical field of view, radians.
    """

    wxyz: np.ndarray
    position: np.ndarray
    fov: float

    @classmethod
    def of(cls, camera: Camera) -> Pose:
        """That of a camera; where its principal point lies is lost."""
        view = camera.viewmat.detach().double().cpu().numpy()
        x, y, z, w = Rotation.from_matrix(view[:3, :3].T).as_quat()
        return cls(
            np.array([w, x, y, z]), -view[:3, :3].T @ view[:3, 3], 2 * math.atan(0.5 * camera.height / camera.fy)
        )

    @property
    def rotation(self) -> Rotation:
        """Camera to world."""
        w, x, y, z = self.wxyz
        return Rotation.from_quat([x, y, z, w])

    def camera(self, width: int, height: int) -> Camera:
        """The pinhole of a window of so many pixels, the principal point in its middle."""
        turn = self.rotation.as_matrix().T
        viewmat = torch.eye(4, dtype=torch.float64)
        viewmat[:3, :3] = torch.from_numpy(turn)
        viewmat[:3, 3] = torch.from_numpy(-turn @ np.asarray(self.position, np.float64))
        focal = 0.5 * height / math.tan(0.5 * self.fov)
        return Camera(viewmat, focal, focal, width / 2, height / 2, width, height)


def fitted(size: Sequence[int], longest: int) -> tuple[int, int]:
    """(width, height) of the same shape with at most ``longest`` pixels on a side, and at least one."""
    width, height = size
    scale = min(1.0, longest / max(width, height, 1))
    return max(1, round(scale * width)), max(1, round(scale * height))
