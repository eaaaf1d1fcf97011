"""Choose starting points of primitives: given points, or points inferred from alpha masks, cameras and pixels."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.data.dataset import PointCloud, ViewSet, dataset_axes_meet, dataset_focus_point
from neuprim.core.data.starting_points import count_seeing_views, hull_surface, ray_starting_points
from neuprim.core.errors import ConfigError

__all__ = ["initial_points"]

_FPS_WORK = 5e8  # distances that exact farthest-point sampling may evaluate (1.5 s); above, a grid thins the points
_COLOR_VIEWS = 100
_CHUNK = 20_000
_ROUNDS = 8  # times that points are drawn in the box, until enough of them are seen by cameras


def initial_points(views: ViewSet, points: PointCloud | None, count: int, generator: torch.Generator) -> PointCloud:
    """Return at most ``count`` distinct starting points of a static scene.

    If ``points`` are given, the starting points are drawn from ``points``. Otherwise, the starting points are inferred
    from the images. If the cameras do not look at one point, the points lie along rays; else, for images with alpha, on
    the visual hull; else in a box around the point that the cameras look at. If the cameras have different positions,
    at least two cameras see each inferred point.

    Raises:
        ConfigError: ``count`` is not positive.
        DataError: the alpha masks have no common volume, or an image is damaged.
    """
    check_point_count(count)
    if points is not None:
        return draw_points(points, count, generator)
    if not dataset_axes_meet([views.view(i).camera for i in range(len(views))]):
        return drop_repeated_points(ray_starting_points(views, count, generator)[0])
    if views_have_alpha(views):
        return hull_points(views, count, generator)
    return box_starting_points(views, count, generator)


def check_point_count(count: int) -> None:
    """Raise ConfigError unless ``count`` is positive."""
    if count <= 0:
        raise ConfigError(f"the number of initial points is {count}; expected at least 1")


def views_have_alpha(views: ViewSet) -> bool:
    """Return whether one of the first eight views has a pixel with alpha below 0.5."""
    alphas = (views.pixels(i).alpha for i in range(min(len(views), 8)))
    return any(alpha is not None and bool((alpha < 0.5).any()) for alpha in alphas)


def draw_points(points: PointCloud, count: int, generator: torch.Generator) -> PointCloud:
    """Draw at most ``count`` points with distinct positions, uniformly; the points stay in their order."""
    rows = _distinct_point_rows(points)
    if len(rows) > count:
        rows = rows[torch.randperm(len(rows), generator=generator)[:count]].sort().values
    return points.rows(rows)


def hull_points(views: ViewSet, count: int, generator: torch.Generator, resolution: int = 128) -> PointCloud:
    """Spread ``count`` points over the surface of the visual hull of the views' alpha masks.

    The hull has ``resolution`` voxels along its longest side. Points are placed at random in the hull's surface voxels.
    The colour of a point is from :func:`median_colors`.
    """
    centers, voxel = hull_surface(views, resolution)
    spread = count <= len(centers)
    rows = farthest_points(centers, count, generator) if spread else torch.arange(count) % len(centers)
    means = centers[rows] + (torch.rand((len(rows), 3), generator=generator) - 0.5) * voxel
    return drop_repeated_points(PointCloud(means, median_colors(views, means)))


def box_starting_points(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
    """Draw points in a cube around the focus point of the cameras; each point is in the image of at least two cameras.

    The side of the cube is the median distance of the cameras from the focus point.
    """
    cameras = [views.view(i).camera for i in range(len(views))]
    center = dataset_focus_point(cameras)
    half = 0.5 * torch.stack([c.position for c in cameras]).sub(center).norm(dim=-1).median()
    if half <= 0:
        half = torch.tensor(1.0, dtype=torch.float64)
    found = torch.zeros(0, 3)
    for _ in range(_ROUNDS):
        means = (center + (2.0 * torch.rand((count, 3), generator=generator).double() - 1.0) * half).float()
        found = torch.cat([found, means[count_seeing_views(views, means) >= min(2, len(views))]])[:count]
        if len(found) == count:
            break
    if not len(found):
        return drop_repeated_points(ray_starting_points(views, count, generator)[0])
    return drop_repeated_points(PointCloud(found, median_colors(views, found)))


def drop_repeated_points(points: PointCloud) -> PointCloud:
    """Return the points without repeated positions; the first point at each position remains."""
    rows = _distinct_point_rows(points)
    return points if len(rows) == len(points.means) else points.rows(rows)


def _distinct_point_rows(points: PointCloud) -> Tensor:
    _, first = np.unique(points.means.numpy(), axis=0, return_index=True)
    return torch.from_numpy(np.sort(first))


def farthest_points(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Return (count,) indices of ``points`` (M, 3) that are far from each other, by farthest-point sampling.

    If this takes too long because there are many points, a grid selects the points instead.
    """
    if count * len(points) > _FPS_WORK:
        return _thin_points_by_grid(points, count, generator)
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


def _thin_points_by_grid(points: Tensor, count: int, generator: torch.Generator) -> Tensor:
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


def median_colors(views: ViewSet, means: Tensor, matter: float = 0.5) -> Tensor:
    """Return (N, C) colours of the points ``means`` (N, 3): per channel, the median over the views that show a point.

    A view counts if the point falls on a valid pixel with alpha above ``matter``. Colours are not premultiplied. Points
    in no view get the median colour of the other points, or mid-grey.
    """
    indices = sorted({round(i) for i in np.linspace(0, len(views) - 1, min(len(views), _COLOR_VIEWS))})
    samples = torch.stack(
        [_sample_starting_point_colors(views, i, means, matter) for i in indices]
    )  # (V, N, C), NaN where none counts
    colors = torch.cat([samples[:, i : i + _CHUNK].nanmedian(dim=0).values for i in range(0, len(means), _CHUNK)])
    hidden = colors.isnan().any(dim=-1)
    typical = colors.nanmedian(dim=0).values.nan_to_num(nan=0.5)
    return torch.where(hidden[:, None], typical, colors)


def _sample_starting_point_colors(views: ViewSet, index: int, means: Tensor, matter: float) -> Tensor:
    camera, pixels = views.view(index).camera, views.pixels(index)
    inside = camera.sees(means)
    column, row = torch.where(inside[:, None], camera.project(means)[0], 0.0).long().unbind(-1)
    color = pixels.rgb[row, column]
    if pixels.alpha is not None:
        alpha = pixels.alpha[row, column]
        inside &= alpha > matter
        color /= alpha.clamp_min(matter)[:, None]
    if pixels.mask is not None:
        inside &= pixels.mask[row, column]
    color[~inside] = math.nan
    return color


_VIEWS = 100
_CELLS = (12, 17, 24, 34, 48, 68, 96, 136, 192)  # pixels tested along an image's longer side, one grid after the other
_NEAREST = 8
# Quantile of the depths of the nearest points. Next to an object's edge, a wall's pixels are near points of both. A
# point that is too far is hidden or moves forward in training; one that is too near hides the scene from other cameras.
_FAR_SIDE = 0.75
_SHELL = 0.1  # share of the points that surround everything


def surrounding_points(views: ViewSet, points: PointCloud, count: int, generator: torch.Generator) -> PointCloud:
    """Return at most ``count`` points for surroundings that the views show but the given ``points`` do not cover.

    The given points are projected into the views. A pixel without a projected point nearby becomes a new point with the
    pixel's colour, at the depth of the nearest projected points, unless a point already lies there. A tenth of the
    points lie on a sphere around the scene, each in the image of some view.
    """
    if count <= 0 or not len(points.means):
        return points.rows(torch.zeros(0, dtype=torch.int64))
    shell = _surrounding_shell(views, points.means, max(round(_SHELL * count), 1), generator)
    lifted = _lift_starting_points(views, points.means, count, generator)
    wanted = count - len(shell.means)
    if len(lifted.means) > wanted:
        lifted = lifted.rows(torch.randperm(len(lifted.means), generator=generator)[:wanted].sort().values)
    both = PointCloud(torch.cat([lifted.means, shell.means]), torch.cat([lifted.colors, shell.colors]))
    return drop_repeated_points(both)


def _lift_starting_points(views: ViewSet, given: Tensor, count: int, generator: torch.Generator) -> PointCloud:
    """Convert pixels without a projected point of ``given`` (N, 3) nearby to at most ``count`` new points.

    The pixels are chosen on coarse grids first.
    """
    order = torch.randperm(len(views), generator=generator)[:_VIEWS].tolist()
    known = given.double().numpy()
    means = np.zeros((0, 3))
    colors = np.zeros((0, views.pixels(order[0]).rgb.shape[-1]), dtype=np.float32)
    side = max(views.view(order[0]).camera.width, views.view(order[0]).camera.height)
    for cells in _CELLS:
        for index in order:
            found, seen = _find_starting_pixels(views, index, known, side / cells)
            known, means = np.concatenate([known, found]), np.concatenate([means, found])
            colors = np.concatenate([colors, seen])
        if len(means) >= count:
            break
    return PointCloud(torch.from_numpy(means[:count]).float(), torch.from_numpy(colors[:count]).float())


def _find_starting_pixels(
    views: ViewSet, index: int, known: NDArray[np.float64], cell: float
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Return positions (K, 3) and colours (K, C) of new points, from pixels that show no known point.

    Pixels of view ``index`` on a grid of spacing ``cell`` are chosen if no point of ``known`` (N, 3) projects within
    ``cell`` pixels. The depth of a new point is from the projected points nearest to the pixel.
    """
    camera, image = views.view(index).camera, views.pixels(index)
    rotation, shift = camera.viewmat[:3, :3].double().numpy(), camera.viewmat[:3, 3].double().numpy()
    spots = _starting_pixel_grid(camera.width, camera.height, cell)
    cols, rows = spots.astype(np.int64).T
    counts = np.ones(len(spots), dtype=bool)
    if image.mask is not None:
        counts &= image.mask.numpy()[rows, cols]
    if image.alpha is not None:
        counts &= image.alpha.numpy()[rows, cols] > 0.5
    inside, depth = (x.numpy() for x in camera.project(torch.from_numpy(known)))
    near = (depth > 0) & (inside > -cell).all(1) & (inside < (camera.width + cell, camera.height + cell)).all(1)
    inside, depth = inside[near], depth[near]
    if len(depth) < _NEAREST:
        return known[:0], image.rgb.numpy().reshape(-1, image.rgb.shape[-1])[:0]
    distance, which = cKDTree(inside).query(spots, k=_NEAREST)
    keep = counts & (distance[:, 0] > cell)
    z = np.quantile(depth[which[keep]], _FAR_SIDE, axis=1) if keep.any() else np.zeros(0)
    u, v = spots[keep].T
    local = np.stack([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z], axis=1)
    found = (local - shift) @ rotation  # R^T (x - t)
    fresh = cKDTree(known).query(found)[0] > cell * z / camera.fx if len(found) else np.zeros(0, dtype=bool)
    return found[fresh], image.rgb.numpy()[rows[keep], cols[keep]][fresh]


def _starting_pixel_grid(width: int, height: int, cell: float) -> NDArray[np.float64]:
    """Return the (N, 2) pixel positions (x, y) of a regular grid over an image, about ``cell`` pixels apart."""
    across, down = max(round(width / cell), 1), max(round(height / cell), 1)
    x, y = (np.arange(across) + 0.5) * width / across, (np.arange(down) + 0.5) * height / down
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _surrounding_shell(views: ViewSet, given: Tensor, count: int, generator: torch.Generator) -> PointCloud:
    """Return at most ``count`` points on a sphere around cameras and ``given`` points, each in the image of a view."""
    cameras = [views.view(i).camera for i in range(len(views))]
    center = dataset_focus_point(cameras)
    eyes = torch.stack([c.position.double() for c in cameras]) - center
    reach = torch.quantile((given.double() - center).norm(dim=-1)[:1_000_000], 0.99)
    radius = 2.0 * torch.maximum(reach, eyes.norm(dim=-1).max())
    many = 16 * count  # candidates; those that cameras see are thinned
    k = torch.arange(many, dtype=torch.float64)
    z = 1.0 - 2.0 * (k + 0.5) / many
    turn = k * (math.pi * (3.0 - math.sqrt(5.0)))
    ring = (1.0 - z * z).sqrt()
    means = center + radius * torch.stack([ring * turn.cos(), ring * turn.sin(), z], dim=-1)
    rows = torch.stack([camera.sees(means) for camera in cameras]).any(0).nonzero()[:, 0]
    if len(rows) > count:
        rows = rows[torch.randperm(len(rows), generator=generator)[:count]].sort().values
    chosen = means[rows].float()
    colors = median_colors(views, chosen) if len(chosen) else torch.zeros(0, views.pixels(0).rgb.shape[-1])
    return PointCloud(chosen, colors)
