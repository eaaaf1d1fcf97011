"""Infer starting points of primitives from images: on the visual hull of alpha masks, or on rays through pixels."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.data.dataset import PointCloud, ViewSet, camera_extent, dataset_focus_point
from neuprim.core.errors import DataError

_VIEWS = 100
_MASK_SIDE = 400
_COARSE = 64


class EmptyHull(DataError):
    """Error: the visual hull has no voxel, because masks and cameras disagree or nothing is opaque."""


@dataclass(frozen=True)
class _Silhouette:
    """Camera of an alpha mask, and the (H+1, W+1) int32 summed-area table of its pixels that may show matter."""

    camera: Camera
    table: Tensor


@dataclass(frozen=True)
class _VoxelGrid:
    """Cubic voxels: lower ``corner`` (3,), side ``voxel``, and ``full`` (X, Y, Z) bool, False where carved away."""

    corner: Tensor
    voxel: float
    full: Tensor

    def centers(self, cells: Tensor) -> Tensor:
        return self.corner + (cells.double() + 0.5) * self.voxel


def hull_surface(
    views: ViewSet, resolution: int, seen_views: float = 0.5, wrong_views: float = 0.02, matter: float = 0.5
) -> tuple[Tensor, float]:
    """Return centres (M, 3) float32 of the visual hull's surface voxels, and the side of a voxel, in scene units.

    ``resolution`` is the number of voxels along the hull's longest side. A voxel belongs to the hull under two
    conditions. The voxel is in the image of at least the fraction ``seen_views`` of the views. At most the fraction
    ``wrong_views`` of the views shows only alpha of at most ``matter`` at the voxel. Raises EmptyHull if the hull has
    no voxel.
    """
    silhouettes = _read_silhouettes(views, matter)
    cameras = [s.camera for s in silhouettes]
    center = dataset_focus_point(cameras)
    half = torch.stack([c.position.double() for c in cameras]).sub(center).norm(dim=-1).median().item() or 1.0
    everything = torch.ones((_COARSE,) * 3, dtype=torch.bool)
    grid = _carve_voxels(
        _VoxelGrid(center - half, 2.0 * half / _COARSE, everything), silhouettes, 0.87, seen_views, wrong_views
    )
    grid = _carve_voxels(_refine_voxels(grid, _COARSE), silhouettes, 0.87, seen_views, wrong_views)
    # a larger reach than 0.25 makes the hull too large, a smaller one makes holes
    grid = _carve_voxels(_refine_voxels(grid, resolution), silhouettes, 0.25, seen_views, wrong_views)
    core = F.pad(grid.full, (1,) * 6)  # whose 26 neighbours are full, too
    for axis, n in enumerate(grid.full.shape):
        core = core.narrow(axis, 0, n) & core.narrow(axis, 1, n) & core.narrow(axis, 2, n)
    return grid.centers((grid.full & ~core).nonzero()).float(), grid.voxel


def _read_silhouettes(views: ViewSet, threshold: float) -> list[_Silhouette]:
    """Return the alpha masks of at most 100 evenly spaced views; pixels with alpha above ``threshold`` show matter.

    Consecutive masks are from different sides of the scene. Large masks are reduced.
    """
    chosen = sorted(evenly_spaced(len(views), _VIEWS), key=lambda i: i * 0.6180339887 % 1.0)
    found = []
    for index in chosen:
        camera, pixels = views.view(index).camera, views.pixels(index)
        if pixels.alpha is None:
            continue
        matter = pixels.alpha > threshold
        if pixels.mask is not None:
            matter |= ~pixels.mask  # pixels that do not count rule nothing out
        n = -(-max(camera.width, camera.height) // _MASK_SIDE)
        small = F.max_pool2d(matter[None].float(), n, ceil_mode=True)[0]
        table = F.pad(small.to(torch.int32).cumsum(0).cumsum(1), (1, 0, 1, 0)).to(torch.int32)
        scaled = replace(camera.reduced(n), width=small.shape[1], height=small.shape[0])
        found.append(_Silhouette(scaled, table))
    return found


def _refine_voxels(grid: _VoxelGrid, resolution: int) -> _VoxelGrid:
    """Return a finer grid of the box around the remaining voxels, with ``resolution`` voxels along its longest side."""
    cells = grid.full.nonzero()
    low, high = cells.min(0).values, cells.max(0).values + 1
    voxel = grid.voxel * float((high - low).max()) / resolution
    counts = ((high - low).double() * grid.voxel / voxel).ceil().long().clamp(1, resolution)
    parents = [
        (((torch.arange(int(n)) + 0.5) * voxel / grid.voxel).long() + lo).clamp_max(hi - 1)
        for n, lo, hi in zip(counts, low, high, strict=True)
    ]
    full = grid.full[parents[0]][:, parents[1]][:, :, parents[2]]
    return _VoxelGrid(grid.corner + low.double() * grid.voxel, voxel, full)


def _carve_voxels(
    grid: _VoxelGrid, silhouettes: list[_Silhouette], reach: float, seen_views: float, wrong_views: float
) -> _VoxelGrid:
    """Remove the voxels that do not belong to the visual hull; raise EmptyHull if none remains.

    A mask is searched for matter in the projection of a cube around the voxel's centre, with half side ``reach`` in
    voxels.
    ``seen_views`` and ``wrong_views`` are as in :func:`hull_surface`.
    """
    cells = grid.full.nonzero()
    poses = torch.stack([s.camera.viewmat[:3].double() for s in silhouettes]).numpy()
    cameras = [s.camera for s in silhouettes]
    lenses = np.array([(c.fx, c.fy, c.cx, c.cy, c.width, c.height) for c in cameras], dtype=np.float64)
    sizes = np.array([s.table.numel() for s in silhouettes], dtype=np.int64)
    tables = torch.cat([s.table.reshape(-1) for s in silhouettes]).numpy()
    allowed, needed = int(wrong_views * len(silhouettes)), max(1.0, seen_views * len(silhouettes))
    points = grid.centers(cells).numpy()
    keep = _carve_hull_points(
        points, poses, lenses, np.cumsum(sizes) - sizes, tables, reach * grid.voxel, allowed, needed
    )
    cells = cells[torch.from_numpy(keep)]
    if len(cells) == 0:
        found = f"the visual hull of {len(silhouettes)} alpha masks is empty"
        expected = "masks of one scene and poses that agree with them"
        raise EmptyHull(f"{found}: no point in front of the cameras is opaque in all views; expected {expected}")
    full = torch.zeros_like(grid.full)
    full[tuple(cells.unbind(-1))] = True
    return _VoxelGrid(grid.corner, grid.voxel, full)


@exact_kernel
def _carve_hull_points(
    points: Any, poses: Any, lenses: Any, offsets: Any, tables: Any, reach: float, allowed: int, needed: float
) -> Any:
    """Return (M,) bool: which points lie in at least ``needed`` images, at most ``allowed`` of which show no matter.

    ``points`` are (M, 3). For V views, ``poses`` (V, 3, 4) are world to camera, and ``lenses`` (V, 6) have fx, fy, cx,
    cy, width and height. These arrays are float64. The summed-area table (height+1, width+1) of view j begins at
    ``tables[offsets[j]]``. Matter means pixels that the alpha mask marks as opaque. An image shows matter if such
    pixels lie in the projection of a cube around the point, with half side ``reach``.
    """
    keep = np.zeros(len(points), dtype=np.bool_)
    for i in range(len(points)):
        px, py, pz = points[i, 0], points[i, 1], points[i, 2]
        seen, wrong = 0, 0
        for j in range(len(poses)):
            pose = poses[j]
            z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
            if z <= 0.0:
                continue
            fx, fy, cx, cy, width, height = lenses[j]
            u = fx * (pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]) / z + cx
            v = fy * (pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]) / z + cy
            if not (0.0 <= u < width and 0.0 <= v < height):
                continue
            seen += 1
            du, dv = fx * reach / z, fy * reach / z
            left, right = int(max(u - du, 0.0)), int(min(u + du + 1.0, width))
            top, bottom = int(max(v - dv, 0.0)), int(min(v + dv + 1.0, height))
            low = offsets[j] + top * (int(width) + 1)
            high = offsets[j] + bottom * (int(width) + 1)
            if tables[high + right] - tables[low + right] - tables[high + left] + tables[low + left] == 0:
                wrong += 1
                if wrong > allowed:
                    break
        keep[i] = wrong <= allowed and seen >= needed
    return keep


GIVE_POINTS = "pass points with model.init.points=FILE.ply, or with ply_file_path in transforms.json"
"""Advice in messages if no starting point can be inferred."""

_PROBES = 2000  # pixels whose depth is searched
_OTHERS = 32  # views with which they are compared
_STEPS = 2.0 ** torch.arange(-2.0, 8.5, 0.5, dtype=torch.float64)  # depths that are tried, in camera extents
_INFINITY = 1e6  # in camera extents
_SEEN = 0.1  # a depth counts only if other views show more than this fraction of the pixels at that depth
_SAME = 1.02  # up to this ratio of differences, infinity agrees with the images as well as the best depth does
_TRIED = 8  # depths tried per ray; the one at which other views agree best is used
_PRIOR = 0.5  # weight of how well a depth fits all rays, relative to how well it fits one: some views agree by chance
_ROUNDS = 8


def count_seeing_views(views: ViewSet, means: Tensor) -> Tensor:
    """Return (N,) int64: in how many of at most 100 views each of the points (N, 3) lies in the image.

    Occlusion is ignored.
    """
    return torch.stack([views.view(i).camera.sees(means) for i in evenly_spaced(len(views), _VIEWS)]).sum(0)


def ray_starting_points(
    views: ViewSet, count: int, generator: torch.Generator, matter: float = 0.5
) -> tuple[PointCloud, Tensor]:
    """Place at most ``count`` points on rays through random pixels, uniform in 1/z, with the colours of the pixels.

    Returns the points, and the (N,) index of the view of each point's pixel. Depths z lie in the range where other
    views show the same colours. If no depth fits better than infinity, the function assumes that all cameras are at one
    position, and the unit of depth is arbitrary. Otherwise, at least two cameras must see each point. Only pixels with
    alpha above ``matter`` are used. Raises DataError if no two cameras see the same position, or if no pixel has enough
    alpha.
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
        what = f"no point in space is visible in {needed} training images"
        raise DataError(f"{what}, so no starting points can be found; {GIVE_POINTS}")
    return PointCloud(means, colors), owner


def evenly_spaced(count: int, most: int) -> list[int]:
    """Return at most ``most`` evenly spaced indices, from 0 to ``count`` - 1."""
    return sorted({round(i * (count - 1) / max(min(count, most) - 1, 1)) for i in range(min(count, most))})


def _draw_starting_pixels(
    views: ViewSet, count: int, generator: torch.Generator, matter: float
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Draw ``count`` random pixels of the views, and keep valid pixels with alpha above ``matter``.

    Returns ray origins and directions (N, 3) float64, colours (N, C) and view indices (N,). Directions have
    z = 1 in camera axes.
    """
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
    """Find the range of depths at which starting points may lie, from how well the views' colours agree.

    Returns (D,) depths from near to far, in scene units; the (D,) mean colour difference between views at each depth;
    and the number of cameras (1 or 2) that must see a point. ``matter`` is the least alpha of the compared pixels.
    """
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
    """Return the (N,) differences between ``colors`` and other views' pixels at (N, 3) points: the median over views.

    ``owner`` (N,) is the index of the view that a point comes from; this view is not compared. The result is NaN for
    points in no other view.
    """
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
