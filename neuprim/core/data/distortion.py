"""Lens distortion: where an undistorted pixel lies in the photograph, and resampling the photograph there."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from scipy import ndimage
from torch import Tensor

from neuprim.core.cameras import Camera


class Distortion(ABC):
    """A lens. Instances are hashable, so that views with the same lens share a resampling grid."""

    @abstractmethod
    def project(self, points: np.ndarray, camera: Camera) -> np.ndarray:
        """(M, 2) photographed pixels of (M, 2) directions (x/z, y/z), float64; pixel centres at +0.5."""


@dataclass(frozen=True)
class RadialDistortion(Distortion):
    """OpenCV's model: radius times 1 + k1 r^2 + k2 r^4 + k3 r^6 + k4 r^8, and tangential terms p1, p2."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def project(self, points: np.ndarray, camera: Camera) -> np.ndarray:
        x, y = points[:, 0], points[:, 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (self.k1 + r2 * (self.k2 + r2 * (self.k3 + r2 * self.k4)))
        xd = x * radial + 2.0 * self.p1 * x * y + self.p2 * (r2 + 2.0 * x * x)
        yd = y * radial + self.p1 * (r2 + 2.0 * y * y) + 2.0 * self.p2 * x * y
        return np.stack([camera.fx * xd + camera.cx, camera.fy * yd + camera.cy], axis=-1)


@dataclass(frozen=True)
class FisheyeDistortion(Distortion):
    """OpenCV's fisheye: the angle t to the axis becomes the radius t (1 + k1 t^2 + k2 t^4 + k3 t^6 + k4 t^8)."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0

    def project(self, points: np.ndarray, camera: Camera) -> np.ndarray:
        r = np.hypot(points[:, 0], points[:, 1])
        t = np.arctan(r)
        t2 = t * t
        bent = t * (1.0 + t2 * (self.k1 + t2 * (self.k2 + t2 * (self.k3 + t2 * self.k4))))
        scale = np.divide(bent, r, out=np.ones_like(r), where=r > 1e-12)
        return points * scale[:, None] * (camera.fx, camera.fy) + (camera.cx, camera.cy)


def undistortion_grid(camera: Camera, distortion: Distortion) -> tuple[Tensor, Tensor]:
    """Where the pixels of the undistorted ``camera`` lie in a photograph of the same size.

    Returned are (H, W, 2) float32 source pixels (x, y), centres at +0.5, and (H, W) bool: inside the photograph and on
    the part of the lens around the principal point where the map does not fold over.
    """
    x = (np.arange(camera.width) + 0.5 - camera.cx) / camera.fx
    y = (np.arange(camera.height) + 0.5 - camera.cy) / camera.fy
    points = np.stack(np.meshgrid(x, y), axis=-1)
    with np.errstate(over="ignore", invalid="ignore"):
        source = distortion.project(points.reshape(-1, 2), camera).reshape(points.shape)
        valid = _unfolded_pixels(camera, source)
        valid &= ((source >= 0.0) & (source <= (camera.width, camera.height))).all(axis=-1)
    # far-off and infinite targets are masked, but must stay finite for the sampler
    source = np.nan_to_num(source, nan=-1.0, posinf=-1.0, neginf=-1.0).clip(-1e6, 1e6)
    return torch.from_numpy(source.astype(np.float32)), torch.from_numpy(valid)


def _unfolded_pixels(camera: Camera, source: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels joined to the principal point's by pixels where the map keeps its orientation."""
    # polynomial lens models turn back beyond some radius and would mirror the middle of the photograph into the corners
    if min(source.shape[:2]) < 2:
        return np.isfinite(source).all(axis=-1)
    dy, dx = np.gradient(source, axis=(0, 1))
    upright = dx[..., 0] * dy[..., 1] - dx[..., 1] * dy[..., 0] > 0.0
    regions, _ = ndimage.label(upright)
    row, column = (min(max(int(c), 0), n - 1) for c, n in ((camera.cy, camera.height), (camera.cx, camera.width)))
    return (regions == regions[row, column]) & upright


def resample_image(image: Tensor, source: Tensor) -> Tensor:
    """(H', W', C) float32 bilinear samples of (H, W, C) at (H', W', 2) source pixels, clamped to the border."""
    height, width = image.shape[:2]
    grid = source / torch.tensor([width, height]) * 2.0 - 1.0  # -1 and 1 are the outer edges of the outer pixels
    planes = image.float().permute(2, 0, 1)[None]
    out = F.grid_sample(planes, grid[None], mode="bilinear", padding_mode="border", align_corners=False)
    return out[0].permute(1, 2, 0).contiguous()
