"""Where matter is at the start: given points, the visual hull of the alpha masks, or a box in front of the cameras."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from neuprim.core.data import PointCloud, ViewSet
from neuprim.core.data.focus import axes_meet, focus_point
from neuprim.core.data.hull import hull_surface
from neuprim.core.data.rays import ray_points, views_that_see
from neuprim.core.errors import ConfigError

__all__ = [
    "box_points",
    "check_count",
    "distinct",
    "farthest_points",
    "has_silhouettes",
    "hull_points",
    "initial_points",
    "median_colors",
    "subset",
]

_FPS_WORK = 5e8
"""Distances that exact farthest-point sampling may evaluate (about 1.5 s on one core); above, a grid thins the
points."""
_COLOR_VIEWS = 100
_CHUNK = 20_000
_ROUNDS = 8
"""Times that a box is filled, for points that cameras see."""


def initial_points(views: ViewSet, points: PointCloud | None, count: int, generator: torch.Generator) -> PointCloud:
    """At most ``count`` distinct starting points of a static scene, in scene units and the images' colour space.

    Given points win. Cameras that do not look at one point begin along their rays, see
    :func:`~neuprim.core.data.rays.ray_points`. Else data with alpha uses the surface of its visual hull, and data
    without a box about that point. Inferred points that fewer than two cameras see do not count.

    Raises:
        ConfigError: ``count`` is not positive.
        DataError: the alpha masks have no common volume, or an image is damaged.
    """
    check_count(count)
    if points is not None:
        return subset(points, count, generator)
    if not axes_meet([views.view(i).camera for i in range(len(views))]):
        return distinct(ray_points(views, count, generator)[0])
    if has_silhouettes(views):
        return hull_points(views, count, generator)
    return box_points(views, count, generator)


def check_count(count: int) -> None:
    """Raises ConfigError unless ``count`` is positive."""
    if count <= 0:
        raise ConfigError(f"the number of initial points is {count}; expected at least 1")


def has_silhouettes(views: ViewSet) -> bool:
    """Whether one of the first views has alpha that is not opaque everywhere."""
    for index in range(min(len(views), 8)):
        alpha = views.pixels(index).alpha
        if alpha is not None and bool((alpha < 0.5).any()):
            return True
    return False


def subset(points: PointCloud, count: int, generator: torch.Generator) -> PointCloud:
    """At most ``count`` of the given points without repeated positions, drawn evenly, in their own order."""
    _, first = np.unique(points.means.numpy(), axis=0, return_index=True)
    rows = torch.from_numpy(np.sort(first))
    if len(rows) > count:
        rows = rows[torch.randperm(len(rows), generator=generator)[:count]].sort().values
    return points.rows(rows)


def hull_points(views: ViewSet, count: int, generator: torch.Generator, resolution: int = 128) -> PointCloud:
    """``count`` points spread over the surface of the visual hull, coloured by the pixels they project to.

    Points are voxel centres with sub-voxel jitter; more points than surface voxels share voxels and differ by their
    jitter.

    Args:
        resolution: voxels along the hull's longest side.

    Raises:
        DataError: the masks have no common volume.
    """
    centers, voxel = hull_surface(views, resolution)
    if count <= len(centers):
        rows = farthest_points(centers, count, generator)
    else:
        rows = torch.arange(count) % len(centers)
    jitter = torch.rand((len(rows), 3), generator=generator) - 0.5
    means = centers[rows] + jitter * voxel
    return distinct(PointCloud(means, median_colors(views, means)))


def box_points(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
    """``count`` points at most, uniform in a cube about the point the cameras look at, coloured by the pixels they
    project to.

    The cube's half side is half the median distance of the cameras to that point. Points that fewer than two cameras
    see (one, where there is one) do not count.
    """
    cameras = [views.view(i).camera for i in range(len(views))]
    center = focus_point(cameras)
    half = 0.5 * torch.stack([c.position for c in cameras]).sub(center).norm(dim=-1).median()
    if half <= 0:
        half = torch.tensor(1.0, dtype=torch.float64)
    found = torch.zeros(0, 3)
    for _ in range(_ROUNDS):
        means = (center + (2.0 * torch.rand((count, 3), generator=generator).double() - 1.0) * half).float()
        found = torch.cat([found, means[views_that_see(views, means) >= min(2, len(views))]])[:count]
        if len(found) == count:
            break
    if not len(found):
        return distinct(ray_points(views, count, generator)[0])
    return distinct(PointCloud(found, median_colors(views, found)))


def distinct(points: PointCloud) -> PointCloud:
    """The points without repeated positions, which jitter makes rare but cannot exclude."""
    _, first = np.unique(points.means.numpy(), axis=0, return_index=True)
    if len(first) == len(points.means):
        return points
    rows = torch.from_numpy(np.sort(first))
    return points.rows(rows)


# ---------------------------------------------------------------- spreading


def farthest_points(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """(count,) int64 rows of ``points`` (M, 3), M >= count, far from each other.

    Exact farthest-point sampling from a random start while that is fast; for large sets one point per cell of a grid
    whose cell size fits the count, filled up at random.
    """
    if count * len(points) > _FPS_WORK:
        return _thinned(points, count, generator)
    start = int(torch.randint(len(points), (1,), generator=generator))
    x, y, z = (np.ascontiguousarray(points[:, i].float().numpy()) for i in range(3))
    nearest = np.full(len(points), np.inf, dtype=np.float32)
    distance, part = np.empty_like(nearest), np.empty_like(nearest)
    rows = np.empty(count, dtype=np.int64)
    for k in range(count):
        rows[k] = row = start if k == 0 else int(nearest.argmax())
        np.subtract(x, x[row], out=distance)
        np.multiply(distance, distance, out=distance)
        for axis in (y, z):
            np.subtract(axis, axis[row], out=part)
            np.multiply(part, part, out=part)
            np.add(distance, part, out=distance)
        np.minimum(nearest, distance, out=nearest)
        nearest[row] = -1.0  # a point is taken once even where others coincide with it
    return torch.from_numpy(rows)


def _thinned(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
    shuffled = torch.randperm(len(points), generator=generator).numpy()
    low = points.min(0).values
    unit = ((points - low) / (points - low).max().clamp_min(1e-30)).double().numpy()[shuffled]
    few, many = 1, 1024  # cells per side; `few` always gives at most `count` cells
    first = np.zeros(1, dtype=np.int64)
    while many - few > 1:
        cells = (few + many) // 2
        index = np.minimum((unit * cells).astype(np.int64), cells - 1)
        _, trial = np.unique((index[:, 0] * cells + index[:, 1]) * cells + index[:, 2], return_index=True)
        few, many, first = (cells, many, trial) if len(trial) <= count else (few, cells, first)
    rest = np.delete(np.arange(len(points)), first)[: count - len(first)]
    return torch.from_numpy(shuffled[np.concatenate([first, rest])])


# ---------------------------------------------------------------- colour


def median_colors(views: ViewSet, means: Tensor, matter: float = 0.5) -> Tensor:
    """(N, C) per-channel median of the pixels that the points (N, 3) project to, straight colour.

    A view counts for a point that falls inside its image, on a pixel that counts and whose alpha is above ``matter``.
    Points that no view shows get the median of the others, or mid-grey.
    """
    indices = sorted({round(i) for i in np.linspace(0, len(views) - 1, min(len(views), _COLOR_VIEWS))})
    samples = torch.stack(
        [_sample(views, i, means, matter) for i in indices]
    )  # (V, N, C), NaN where a view does not count
    colors = torch.cat([samples[:, i : i + _CHUNK].nanmedian(dim=0).values for i in range(0, len(means), _CHUNK)])
    hidden = colors.isnan().any(dim=-1)
    typical = colors.nanmedian(dim=0).values.nan_to_num(nan=0.5)
    return torch.where(hidden[:, None], typical, colors)


def _sample(views: ViewSet, index: int, means: Tensor, matter: float) -> Tensor:
    camera, pixels = views.view(index).camera, views.pixels(index)
    spots, z = camera.project(means)
    u, v = spots.unbind(-1)
    inside = (z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    flat = torch.where(inside, v, 0.0).long() * camera.width + torch.where(inside, u, 0.0).long()
    color = pixels.rgb.reshape(-1, pixels.rgb.shape[-1])[flat].clone()
    if pixels.alpha is not None:
        alpha = pixels.alpha.reshape(-1)[flat]
        inside &= alpha > matter
        color /= alpha.clamp_min(matter)[:, None]
    if pixels.mask is not None:
        inside &= pixels.mask.reshape(-1)[flat]
    color[~inside] = float("nan")
    return color
