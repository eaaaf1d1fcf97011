"""Media, cameras and a slow renderer for the tests of the volume renderer; nothing from the package but its data
types."""

from __future__ import annotations

import math

import numpy as np
import torch
from scipy import ndimage

from neuprim.core.cameras import Camera, look_at
from neuprim.core.io.vdb import VdbGrid
from neuprim.tasks.dynamic.volume.medium import Medium


def camera(
    eye: tuple[float, float, float], size: int = 16, fov: float = 27.0, up: tuple[float, float, float] = (0.0, 0.0, 1.0)
) -> Camera:
    """Looks at the origin."""
    focal = 0.5 * size / math.tan(math.radians(fov) / 2)
    viewmat = look_at(torch.tensor(eye), torch.zeros(3), torch.tensor(up))
    return Camera(viewmat, focal, focal, size / 2, size / 2, size, size)


def box(shape: tuple[int, int, int]) -> np.ndarray:
    """(4, 4) index to scene: cubic voxels, longest side about 1, centred in the origin."""
    matrix = np.diag([1.0 / max(shape)] * 3 + [1.0])
    matrix[:3, 3] = -(np.array(shape) - 1) / 2 / max(shape)
    return matrix


def rotation(seed: int) -> np.ndarray:
    """(4, 4) random proper rotation."""
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    result = np.eye(4)
    result[:3, :3] = q * np.sign(np.linalg.det(q))
    return result


def grey(sigma: np.ndarray, color: tuple[float, float, float] = (1.0, 0.5, 0.25)) -> np.ndarray:
    """(X, Y, Z, 4) medium values of one source colour."""
    return np.concatenate([sigma[..., None], sigma[..., None] * np.array(color)], -1).astype(np.float32)


def ragged(seed: int, shape: tuple[int, int, int] = (7, 9, 8), strength: float = 12.0) -> Medium:
    """Random voxels, half of them empty, source colours of their own each."""
    rng = np.random.default_rng(seed)
    sigma = rng.random(shape) * strength * (rng.random(shape) > 0.5)
    values = np.concatenate([sigma[..., None], sigma[..., None] * rng.random((*shape, 3))], -1).astype(np.float32)
    return Medium.dense(values, box(shape)).padded()


def sheet(seed: int, size: int = 32) -> Medium:
    """A flame sheet one voxel thin in a random direction, bright, inside smooth absorbing gas with little light."""
    normal = rotation(seed)[:3, 2]
    where = np.stack(np.meshgrid(*[np.arange(size) - (size - 1) / 2] * 3, indexing="ij"), -1)
    inside = np.linalg.norm(where, axis=-1) < 0.42 * size
    gas = 10.0 * inside
    flame = np.maximum(1.0 - np.abs(where @ normal), 0.0) * inside
    color = 0.05 + flame[..., None] * np.array([1.0, 0.3, 0.03])
    values = np.concatenate([gas[..., None], gas[..., None] * color], -1)
    return Medium.dense(values.astype(np.float32), box((size,) * 3)).padded()


def rays(view: Camera, samples: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """(3,) origin and (H, W, S, 3) unit directions in the scene, float64."""
    inverse = np.linalg.inv(view.viewmat.numpy())
    u = (np.arange(samples) + 0.5) / samples
    y, x, b, a = np.meshgrid(np.arange(view.height), np.arange(view.width), u, u, indexing="ij")
    local = np.stack([(x + a - view.cx) / view.fx, (y + b - view.cy) / view.fy, np.ones_like(x, float)], -1)
    local = local.reshape(view.height, view.width, -1, 3)
    local /= np.linalg.norm(local, axis=-1, keepdims=True)
    return inverse[:3, 3], local @ inverse[:3, :3].T


def march_slowly(
    medium: Medium, view: Camera, samples: int = 1, near: float = 1.5, far: float = 4.0, steps: int = 8000
) -> np.ndarray:
    """(H, W, 4) float64: constant steps, each taken as homogeneous."""
    origin, directions = rays(view, samples)
    flat = directions.reshape(-1, 3)
    step = (far - near) / steps
    inverse = np.linalg.inv(medium.scene_from_index)
    result, through = np.zeros((len(flat), 3)), np.ones(len(flat))
    for first in range(0, steps, 400):
        t = near + step * (np.arange(first, first + 400) + 0.5)
        points = (origin + flat[:, None] * t[:, None]) @ inverse[:3, :3].T + inverse[:3, 3]
        channels = np.moveaxis(medium.values[0], -1, 0).astype(float)
        values = (ndimage.map_coordinates(channel, points.reshape(-1, 3).T, order=1) for channel in channels)
        sigma, *source = (v.reshape(len(flat), -1) for v in values)
        depth = sigma * step
        before = np.cumsum(depth, 1) - depth
        gain = through[:, None] * np.exp(-before) * -np.expm1(-depth) / np.where(sigma > 0, sigma, 1.0)
        result += np.stack([(gain * s).sum(1) for s in source], -1)
        through *= np.exp(-depth.sum(1))
    image = np.concatenate([result, 1.0 - through[:, None]], -1)
    return image.reshape(view.height, view.width, -1, 4).mean(2)


def grid_of(name: str, values: np.ndarray, transform: np.ndarray | None = None) -> VdbGrid:
    """A fog volume of (X, Y, Z) or (X, Y, Z, 3) numbers."""
    return VdbGrid.from_dense(name, values, transform=transform)
