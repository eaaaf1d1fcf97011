"""What photographs show where a reconstruction has no points: walls without texture, and whatever is far behind."""

from __future__ import annotations

import math

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.data.dataset import PointCloud, ViewSet
from neuprim.core.data.focus import focus_point
from neuprim.core.data.initial import distinct, median_colors

__all__ = ["surrounding_points"]

_VIEWS = 100
_CELLS = (12, 17, 24, 34, 48, 68, 96, 136, 192)
"""Pixels looked at along an image's longer side, grid after grid."""
_NEAREST = 8
_FAR_SIDE = 0.75
"""Of the depths of the nearest points. A wall's pixels beside an object lie beside points of both; a guess too far is
hidden or moves forward as it learns, one too near stands in front of other cameras."""
_SHELL = 0.1
"""Share of the points that surround everything."""


def surrounding_points(views: ViewSet, points: PointCloud, count: int, generator: torch.Generator) -> PointCloud:
    """At most ``count`` points on what the views show and ``points`` leave out, coloured by the pixels that show them.

    A grid of pixels of every view that no point projects near is lifted to the depth of the points beside it, unless
    what has been lifted from other views covers it already. A tenth are a shell around everything, where some view
    looks: the last resort of pixels of whose depth nothing is known.
    """
    if count <= 0 or not len(points.means):
        return points.rows(torch.zeros(0, dtype=torch.int64))
    shell = _shell(views, points.means, max(round(_SHELL * count), 1), generator)
    lifted = _lifted(views, points.means, count, generator)
    wanted = count - len(shell.means)
    if len(lifted.means) > wanted:
        lifted = lifted.rows(torch.randperm(len(lifted.means), generator=generator)[:wanted].sort().values)
    return distinct(PointCloud(torch.cat([lifted.means, shell.means]), torch.cat([lifted.colors, shell.colors])))


def _lifted(views: ViewSet, given: Tensor, count: int, generator: torch.Generator) -> PointCloud:
    """Pixels without points near, at the depth of those beside them; coarse grids first, so that the largest gaps are
    filled before small ones."""
    order = torch.randperm(len(views), generator=generator)[:_VIEWS].tolist()
    known = given.double().numpy()
    means = np.zeros((0, 3))
    colors = np.zeros((0, views.pixels(order[0]).rgb.shape[-1]), dtype=np.float32)
    side = max(views.view(order[0]).camera.width, views.view(order[0]).camera.height)
    for cells in _CELLS:
        for index in order:
            found, seen = _gaps(views, index, known, side / cells)
            known, means, colors = (
                np.concatenate([known, found]),
                np.concatenate([means, found]),
                np.concatenate([colors, seen]),
            )
        if len(means) >= count:
            break
    return PointCloud(torch.from_numpy(means[:count]).float(), torch.from_numpy(colors[:count]).float())


def _gaps(
    views: ViewSet, index: int, known: NDArray[np.float64], cell: float
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """(N, 3) positions and (N, C) colours of pixels ``cell`` apart that have no known point within that distance, on
    the image and in space."""
    camera, image = views.view(index).camera, views.pixels(index)
    rotation, shift = camera.viewmat[:3, :3].double().numpy(), camera.viewmat[:3, 3].double().numpy()
    spots = _grid(camera.width, camera.height, cell)
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


def _grid(width: int, height: int, cell: float) -> NDArray[np.float64]:
    """(N, 2) pixel positions (x, y), about ``cell`` apart."""
    across, down = max(round(width / cell), 1), max(round(height / cell), 1)
    x, y = (np.arange(across) + 0.5) * width / across, (np.arange(down) + 0.5) * height / down
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)


def _shell(views: ViewSet, given: Tensor, count: int, generator: torch.Generator) -> PointCloud:
    """At most ``count`` points of a sphere around cameras and points, as far as some view shows them."""
    cameras = [views.view(i).camera for i in range(len(views))]
    center = focus_point(cameras)
    eyes = torch.stack([c.position.double() for c in cameras]) - center
    reach = torch.quantile((given.double() - center).norm(dim=-1)[:1_000_000], 0.99)
    radius = 2.0 * torch.maximum(reach, eyes.norm(dim=-1).max())
    many = 16 * count  # of which those that are seen are thinned
    k = torch.arange(many, dtype=torch.float64)
    z = 1.0 - 2.0 * (k + 0.5) / many
    turn = k * (math.pi * (3.0 - math.sqrt(5.0)))
    ring = (1.0 - z * z).sqrt()
    means = center + radius * torch.stack([ring * turn.cos(), ring * turn.sin(), z], dim=-1)
    seen = torch.zeros(many, dtype=torch.bool)
    for camera in cameras:
        seen |= camera.sees(means)
    rows = seen.nonzero()[:, 0]
    if len(rows) > count:
        rows = rows[torch.randperm(len(rows), generator=generator)[:count]].sort().values
    chosen = means[rows].float()
    return PointCloud(
        chosen, median_colors(views, chosen) if len(chosen) else torch.zeros(0, views.pixels(0).rgb.shape[-1])
    )
