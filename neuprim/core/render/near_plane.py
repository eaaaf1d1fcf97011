"""Near plane, extent and pixel size of a scene, from the depths of its points in the cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.settings import RenderSettings

_MAX_CAMERAS, _MAX_POINTS = 100, 100_000  # at most, to measure depths
_SHARE, _CLEARANCE = 1.0 / 400.0, 0.1  # upper bounds of the near plane: shares of the typical and of the nearest depth
_MIN_EXTENT = 0.01
_LARGEST_PIXEL = 1.0 / 250.0  # share of the extent: coarse images do not allow larger steps, as primitives stay small
_MIN_NEAR = 1e-6  # share of the typical depth, in case a point lies at a camera's centre


def nearest_and_median_depth(means: Tensor, cameras: Sequence[AnyCamera]) -> tuple[float, float]:
    """Return (nearest, median) depth of points (N, 3) in the pinhole cameras that see the points.

    If no pinhole camera sees any point, the function uses the distances of all points from all cameras instead. Large
    sets of points and cameras are subsampled.
    """
    means = means.detach().double().cpu()[:: max(len(means) // _MAX_POINTS, 1)]
    cameras = [
        replace(c, viewmat=c.viewmat.detach().double().cpu()) for c in cameras[:: max(len(cameras) // _MAX_CAMERAS, 1)]
    ]
    found = []
    for camera in cameras:
        if isinstance(camera, Camera):
            _, z = camera.project(means)
            found.append(z[camera.sees(means)])
    depths = torch.cat(found) if found else means[:0, 0]
    if not len(depths):
        depths = torch.cat([(means - camera.position).norm(dim=-1) for camera in cameras])
    return depths.min().item(), depths.median().item()


def near_plane_extent(extent: float, means: Tensor, cameras: Sequence[AnyCamera]) -> float:
    """Return ``extent``; if the median depth of points (N, 3) is over 100 times ``extent``, return this depth."""
    _, depth = nearest_and_median_depth(means, cameras)
    return extent if extent >= _MIN_EXTENT * depth else depth


def typical_pixel_size(means: Tensor, cameras: Sequence[AnyCamera], extent: float) -> float:
    """Return the size of a pixel, in scene units, at the median depth of points (N, 3); at most 1/250 of ``extent``.

    Uses the median focal length of the pinhole cameras. Without pinhole cameras, returns 1/250 of ``extent``.
    """
    _, depth = nearest_and_median_depth(means, cameras)
    focal = sorted(camera.fx for camera in cameras if isinstance(camera, Camera))
    largest = _LARGEST_PIXEL * extent
    return min(depth / focal[len(focal) // 2], largest) if focal else largest


def resolve_near(settings: RenderSettings, means: Tensor, cameras: Sequence[AnyCamera]) -> RenderSettings:
    """Return the settings with ``near="auto"`` replaced by a near plane chosen from the depths of points (N, 3)."""
    if settings.near != "auto":
        return settings
    if not len(means):
        return replace(settings, near=1.0)  # there is nothing to cut
    nearest, typical = nearest_and_median_depth(means, cameras)
    near = max(min(_SHARE * typical, _CLEARANCE * nearest), _MIN_NEAR * typical)
    return replace(settings, near=near if math.isfinite(near) and near > 0 else 1.0)
