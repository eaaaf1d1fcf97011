"""Where matter is at the start of a moving scene: visual hulls of single moments, united over time.

One hull of all masks would carve away whatever moves, as no place shows matter in all of them. Masks are taken together
by their times instead. Where several cameras share each time, as in a rig, a moment is one time. Where every image has
its own time, as in D-NeRF, a moment is a run of four neighbours in time: a thing that moves by less than its own size
meanwhile keeps its middle, and the next runs, which overlap, supply the rest.

The other ways were tried with a moving ball: a hull of all masks that forgives most of them either loses the path's
ends or fills the room, points in a box mostly miss the ball, and longer runs carve the more away the faster it moves;
the tests compare them. A camera that moves slowly cannot tell depth and leaves cones: too many points, but few places
without one.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import torch
from torch import Tensor

from neuprim.core.data import PointCloud, ViewSet
from neuprim.core.data.dataset import ViewSubset
from neuprim.core.data.hull import EmptyHull, hull_surface
from neuprim.core.data.initial import (
    box_points,
    check_point_count,
    drop_repeated_points,
    farthest_points,
    median_colors,
    views_have_alpha,
)
from neuprim.core.data.ray_points import ray_points
from neuprim.core.data.scene_frame import optical_axes_meet

__all__ = ["moving_points"]

_SHARED = 2
"""Cameras per time that make a hull of one time; with fewer, neighbours in time help."""
_RUN = 4
_MOMENTS = 64
_RESOLUTION = 64
_SEEN = 0.75
"""Of four cameras three must look: what lies at the side of a scene, in two frusta only, would often be taken for
matter."""
_MATTER = 0.1
"""Smoke is seldom more opaque than this at its edges."""


def moving_points(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
    """At most ``count`` distinct starting points of a moving scene, in scene units and the images' colour space.

    Where the cameras do not look at one point they begin along rays, see :func:`~neuprim.core.data.ray_points.ray_points`.
    With alpha they are spread evenly over the surfaces of all moments' hulls, each with the "time" and the colour of a
    moment
    in which it was found (one of them at random); moments without matter give none. Without alpha, or where every image
    has its own time and all hulls are empty because things move too fast, they fill a box in front of the cameras, with
    times of random views.

    Args:
        views: each with the condition "time", 0..1.

    Raises:
        ConfigError: ``count`` is not positive.
        DataError: cameras share times, but their masks have no common volume at any; or an image is damaged.
    """
    check_point_count(count)
    times = torch.stack([views.view(i).conditions["time"] for i in range(len(views))]).float()
    if not optical_axes_meet([views.view(i).camera for i in range(len(views))]):
        rays, owner = ray_points(views, count, generator, _MATTER)
        return drop_repeated_points(PointCloud(rays.means, rays.colors, {"time": times[owner]}))
    if views_have_alpha(views):
        points = _hull_points(views, times, count, generator)
        if points is not None:
            return points
    points = box_points(views, count, generator)
    drawn = torch.randint(len(times), (len(points.means),), generator=generator)
    return PointCloud(points.means, points.colors, {"time": times[drawn]})


def _hull_points(views: ViewSet, times: Tensor, count: int, generator: torch.Generator) -> PointCloud | None:
    """Points on the hulls; None where every image has its own time and no hull holds anything."""
    moments, shared = _moments(times)
    surfaces, owners, sides = [], [], []
    empty: EmptyHull | None = None
    for number, (indices, _) in enumerate(moments):
        try:
            found, side = hull_surface(ViewSubset(views, indices), _RESOLUTION, seen_views=_SEEN, matter=_MATTER)
        except EmptyHull as error:
            empty = error
            continue
        surfaces.append(found)
        owners.append(torch.full((len(found),), number))
        sides.append(side)
    if not surfaces:
        if shared and empty is not None:
            raise empty
        return None
    centers, owner = torch.cat(surfaces), torch.cat(owners)
    voxel = torch.cat([torch.full((len(s),), side) for s, side in zip(surfaces, sides, strict=True)])
    rows = _one_per_cell(centers, float(np.median(sides)), generator)
    rows = (
        rows[farthest_points(centers[rows], count, generator)]
        if count <= len(rows)
        else rows[torch.arange(count) % len(rows)]
    )
    jitter = torch.rand((len(rows), 3), generator=generator) - 0.5
    means, owner = centers[rows] + jitter * voxel[rows, None], owner[rows]
    colors = torch.empty_like(means)
    for number in owner.unique().tolist():
        mine = owner == number
        colors[mine] = median_colors(ViewSubset(views, moments[number][0]), means[mine], _MATTER)
    when = torch.tensor([time for _, time in moments], dtype=torch.float32)
    return drop_repeated_points(PointCloud(means, colors, {"time": when[owner]}))


def _moments(times: Tensor) -> tuple[list[tuple[list[int], float]], bool]:
    """(views of a moment, its time) in order of time, evenly thinned to a bound; and whether moments are single
    times."""
    values = times.tolist()
    sharing = Counter(values)
    shared = float(np.median(list(sharing.values()))) >= _SHARED
    order = sorted(range(len(values)), key=values.__getitem__)  # stable: equal times stay in order of their views
    if shared:
        moments = [([i for i in order if values[i] == t], t) for t in sorted(sharing) if sharing[t] >= _SHARED]
    else:
        last = max(0, len(order) - _RUN)
        runs = [order[start : start + _RUN] for start in sorted({*range(0, last + 1, _RUN // 2), last})]
        moments = [(run, values[run[len(run) // 2]]) for run in runs]
    kept = sorted({round(i) for i in np.linspace(0, len(moments) - 1, min(len(moments), _MOMENTS))})
    return [moments[i] for i in kept], shared


def _one_per_cell(points: Tensor, side: float, generator: torch.Generator) -> Tensor:
    """Rows of one random point in every cubic cell that holds some: what rests is found at all times, but counts
    once."""
    shuffled = torch.randperm(len(points), generator=generator)
    cells = ((points[shuffled] - points.min(0).values) / side).floor().long().numpy()
    _, first = np.unique(cells, axis=0, return_index=True)
    return shuffled[torch.from_numpy(np.sort(first))]
