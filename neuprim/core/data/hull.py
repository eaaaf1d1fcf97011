"""The visual hull: voxels that no alpha mask rules out (Laurentini, 1994), refined coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.data import ViewSet
from neuprim.core.data.ray_points import evenly_spaced
from neuprim.core.data.scene_frame import dataset_focus_point
from neuprim.core.errors import DataError

_VIEWS = 100
_MASK_SIDE = 400
_COARSE = 64


class EmptyHull(DataError):
    """No voxel is left: masks and cameras disagree, or nothing is opaque."""


@dataclass(frozen=True)
class _Silhouette:
    """Camera of a mask and the (H+1, W+1) int32 summed-area table of pixels that may show matter."""

    camera: Camera
    table: Tensor


@dataclass(frozen=True)
class _VoxelGrid:
    """Cubic voxels: lower corner (3,), side, and (X, Y, Z) bool of the voxels that remain."""

    corner: Tensor
    voxel: float
    full: Tensor

    def centers(self, cells: Tensor) -> Tensor:
        return self.corner + (cells.double() + 0.5) * self.voxel


def hull_surface(
    views: ViewSet, resolution: int, seen_views: float = 0.5, wrong_views: float = 0.02, matter: float = 0.5
) -> tuple[Tensor, float]:
    """Return centres (M, 3) float32 of the hull's surface voxels, and the voxel side, scene units.

    ``resolution`` is in voxels along the hull's longest side. At least the share ``seen_views`` of the views looks at a
    voxel, and at most ``wrong_views`` show no ``matter`` (alpha) there. Raises EmptyHull if no voxel is left.
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
    # wider than 0.25 and the hull swells, narrower and it tears
    grid = _carve_voxels(_refine_voxels(grid, resolution), silhouettes, 0.25, seen_views, wrong_views)
    core = -F.max_pool3d(-F.pad(grid.full[None].float(), (1,) * 6), 3, stride=1)[0] > 0.5
    return grid.centers((grid.full & ~core).nonzero()).float(), grid.voxel


def _read_silhouettes(views: ViewSet, threshold: float) -> list[_Silhouette]:
    """Masks of evenly chosen views, ordered so that neighbours look from different sides."""
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
    """Refine to ``resolution`` voxels along the longest side of the box of full cells."""
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
    """Remove voxels that the masks rule out; ``reach`` is half the side of the tested box, in voxels."""
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
    """(M,) bool of the points that ``needed`` views look at and at most ``allowed`` of those rule out.

    ``points`` (M, 3), ``poses`` (V, 3, 4) world to camera, ``lenses`` (V, 6) fx fy cx cy width height, all float64. A
    view's summed-area table (height+1, width+1) begins in ``tables`` at its of the (V,) ``offsets``. ``reach`` is half
    the side of the cube around a point whose projection is searched for matter.
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
