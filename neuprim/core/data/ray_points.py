"""Starting points along rays, for cameras that do not look at one point: arrays, outward rings, tripods."""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from neuprim.core.data.dataset import PointCloud, ViewSet
from neuprim.core.data.scene_frame import camera_extent
from neuprim.core.errors import DataError

GIVE_POINTS = "pass points with model.init.points=FILE.ply, or with ply_file_path in transforms.json"
"""What to do where no starting point can be inferred."""

_VIEWS = 100
_PROBES = 2000  # pixels whose depth is looked for
_OTHERS = 32  # views that they are compared with
_STEPS = 2.0 ** torch.arange(-2.0, 8.5, 0.5, dtype=torch.float64)  # depths that are tried, in camera extents
_INFINITY = 1e6  # in camera extents
_SEEN = 0.1  # share of these pixels that must be seen at a depth, for it to be judged
_SAME = 1.02  # up to this ratio of differences, infinity agrees with the images as well as the best depth does
_TRIED = 8  # depths of a ray, of which the one counts at which other views agree best
_PRIOR = 0.5  # weight of how well a depth fits all rays, relative to how well it fits one: some views agree by chance
_ROUNDS = 8


def count_seeing_views(views: ViewSet, means: Tensor) -> Tensor:
    """(N,) int64: how many of at most 100 views contain the points (N, 3)."""
    return torch.stack([views.view(i).camera.sees(means) for i in evenly_spaced(len(views), _VIEWS)]).sum(0)


def ray_starting_points(
    views: ViewSet, count: int, generator: torch.Generator, matter: float = 0.5
) -> tuple[PointCloud, Tensor]:
    """Place at most ``count`` points on rays through random pixels, uniform in 1/z, with pixel colours.

    Depths range over those at which other views show the same colours. If no depth fits better than infinity, the
    cameras count as one and the depth unit is arbitrary. Points must be seen by two cameras, unless the cameras count
    as one. A pixel shows matter where alpha is above ``matter``. Returned are the points, and the (N,) views that they
    come from. Raises DataError: no two cameras see the same place, or no pixel shows matter.
    """
    depths, mean, needed = _find_starting_depths(views, generator, matter)
    found: list[tuple[Tensor, Tensor, Tensor]] = []
    for _ in range(_ROUNDS):
        eyes, rays, colors, owner = _draw_starting_pixels(views, count, generator, matter)
        share = torch.rand((_TRIED if needed > 1 else 1, len(owner)), generator=generator).double()
        z = 1.0 / (share / depths[0] + (1.0 - share) / depths[-1])
        tried = eyes + z[..., None] * rays
        if needed > 1:
            usual = torch.from_numpy(np.interp(z.log().numpy(), depths.log().numpy(), mean.numpy()))
            errors = torch.stack([_starting_color_difference(views, t, colors, owner) for t in tried]).nan_to_num(
                nan=math.inf
            )
            tried = tried[(errors + _PRIOR * usual).argmin(0), torch.arange(len(owner))][None]
        means = tried[0].float()
        keep = count_seeing_views(views, means) >= needed
        found.append((means[keep], colors[keep], owner[keep]))
        if sum(len(f[0]) for f in found) >= count:
            break
    means, colors, owner = (torch.cat(parts)[:count] for parts in zip(*found, strict=True))
    if not len(means):
        what = f"no place is in the images of {needed} training cameras"
        raise DataError(f"{what}, so that no starting point can be inferred; {GIVE_POINTS}")
    return PointCloud(means, colors), owner


def evenly_spaced(count: int, most: int) -> list[int]:
    """At most ``most`` evenly spaced indices below ``count``."""
    return sorted({round(i * (count - 1) / max(min(count, most) - 1, 1)) for i in range(min(count, most))})


def _draw_starting_pixels(
    views: ViewSet, count: int, generator: torch.Generator, matter: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Random pixels that show matter: eyes and rays with camera z = 1 (N, 3) float64, colours (N, C), views (N,)."""
    drawn = torch.randint(len(views), (count,), generator=generator)
    spots = torch.rand((count, 2), generator=generator).double()
    found = []
    for index in drawn.unique().tolist():
        camera, pixels = views.view(index).camera, views.pixels(index)
        u, v = (spots[drawn == index] * torch.tensor([camera.width, camera.height])).unbind(-1)
        row, column = v.long(), u.long()
        keep = torch.ones_like(row, dtype=torch.bool) if pixels.mask is None else pixels.mask[row, column]
        color = pixels.rgb[row, column]
        if pixels.alpha is not None:
            alpha = pixels.alpha[row, column]
            keep, color = keep & (alpha > matter), color / alpha.clamp_min(matter)[:, None]
        view = camera.viewmat.double()
        local = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, torch.ones_like(u)], dim=-1)
        eye, owner = camera.position.double().expand(len(local), 3), torch.full((len(local),), index)
        found.append((eye[keep], (local @ view[:3, :3])[keep], color[keep].float(), owner[keep]))
    eyes, rays, colors, owner = (torch.cat(parts) for parts in zip(*found, strict=True))
    return eyes, rays, colors, owner


def _find_starting_depths(views: ViewSet, generator: torch.Generator, matter: float) -> tuple[Tensor, Tensor, int]:
    """Depths that fit, the mean colour difference at each, and how many cameras must see a point."""
    cameras = [views.view(i).camera for i in range(len(views))]
    same = all(torch.equal(c.position, cameras[0].position) for c in cameras)
    unit = camera_extent(cameras)
    if not same:
        eyes, rays, colors, owner = _draw_starting_pixels(views, _PROBES, generator, matter)
        depths = torch.cat([unit * _STEPS, torch.tensor([unit * _INFINITY])])
        errors = torch.stack(
            [_starting_color_difference(views, eyes + z * rays, colors, owner) for z in depths.tolist()]
        )  # (D, N)
        mean = torch.where((~errors.isnan()).double().mean(1) > _SEEN, errors.nanmean(1).double(), math.inf)
        if math.isinf(mean[-1]):  # no two images overlap far away
            return depths, torch.zeros_like(depths), 2
        same = bool(mean[-1] <= _SAME * mean.min())
    if same:
        unit = max(1.0, 100.0 * unit) if len(cameras) > 1 and unit < 1 else 1.0
        return torch.tensor([1.0, 4.0], dtype=torch.float64) * unit, torch.zeros(2, dtype=torch.float64), 1
    fits = (mean <= (mean.min() + mean[-1]) / 2).nonzero()[:, 0]  # where colours agree better than half-way to infinity
    # one depth nearer, as the nearest surfaces are few and outweighed in the mean
    chosen = slice(max(int(fits[0]) - 1, 0), int(fits[-1]) + 1)
    return depths[chosen], mean[chosen].clamp_max(mean[-1]), 2


def _starting_color_difference(views: ViewSet, points: Tensor, colors: Tensor, owner: Tensor) -> Tensor:
    """(N,) median colour difference to other views at the points; NaN where no view shows them."""
    found = []
    for index in evenly_spaced(len(views), _OTHERS):
        camera, pixels = views.view(index).camera, views.pixels(index)
        spots, _ = camera.project(points)
        inside = camera.sees(points) & (owner != index)
        column, row = torch.where(inside[:, None], spots, 0.0).long().unbind(-1)
        color = pixels.rgb[row, column]
        if pixels.alpha is not None:
            color = color / pixels.alpha[row, column].clamp_min(0.5)[:, None]
        if pixels.mask is not None:
            inside &= pixels.mask[row, column]
        found.append(torch.where(inside, (color - colors).abs().mean(-1), math.nan))
    return torch.stack(found).nanmedian(0).values
