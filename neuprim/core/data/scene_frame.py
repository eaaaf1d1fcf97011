"""Place and size of the scene that cameras see: extent, focus, and an origin near the cameras."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.world import World
from neuprim.core.errors import warn_once


def camera_extent(cameras: Sequence[Camera]) -> float:
    """Radius of the cameras' bounding sphere about their mean without outliers, times 1.1; 1.0 if zero."""
    positions = torch.stack([c.position.detach().double() for c in cameras])
    positions = positions[~find_outliers(positions)]
    radius = (positions - positions.mean(0)).norm(dim=-1).max().item() * 1.1
    return radius if radius > 0 else 1.0


_OUTLYING = 100.0  # of the median distance
_OUTLYING_SHARE = 0.05


def find_outliers(positions: Tensor) -> Tensor:
    """Mark at most one or 5 % of (N, 3) camera centres that lie beyond 100 median distances from the median."""
    distance = (positions - positions.median(0).values).norm(dim=-1)
    far = (distance > _OUTLYING * distance.median()) & (distance.median() > 0)
    return far if int(far.sum()) <= max(1, _OUTLYING_SHARE * len(far)) else torch.zeros_like(far)


def dataset_focus_point(cameras: Sequence[Camera]) -> Tensor:
    """(3,) float64 point nearest to all optical axes (least squares), pulled weakly to one extent in front."""
    positions, forward = _dataset_optical_axes(cameras)
    eye = torch.eye(3, dtype=torch.float64)
    planes = eye - forward[:, :, None] * forward[:, None, :]
    pull = 1e-4 * len(positions)
    target = positions.mean(0) + forward.mean(0) * camera_extent(cameras)
    right = (planes @ positions[:, :, None]).sum(0)[:, 0] + pull * target
    return torch.linalg.solve(planes.sum(0) + pull * eye, right)


def dataset_axes_meet(cameras: Sequence[Camera]) -> bool:
    """Whether the optical axes determine a point in front of the cameras.

    They pass it closer than half the spread of the centres, and 9 of 10 cameras look towards it. Parallel axes, outward
    rings and tripods do not.
    """
    positions, forward = _dataset_optical_axes(cameras)
    offsets = dataset_focus_point(cameras) - positions
    depths = (offsets * forward).sum(-1)
    miss = (offsets - depths[:, None] * forward).square().sum(-1).mean()
    spread = (positions - positions.mean(0)).square().sum(-1).mean()
    turned = 1.0 - torch.linalg.eigvalsh(forward.T @ forward / len(forward))[-1]  # 0 where all axes are parallel
    return bool((miss < 0.25 * spread) & (turned > 1e-3) & ((depths > 0).double().mean() >= 0.9))


def _dataset_optical_axes(cameras: Sequence[Camera]) -> tuple[Tensor, Tensor]:
    """(N, 3) centres and (N, 3) viewing directions, float64, of all cameras but outliers."""
    positions = torch.stack([c.position.detach().double() for c in cameras])
    forward = torch.stack([c.viewmat[2, :3].detach().double() for c in cameras])
    usual = ~find_outliers(positions)
    return positions[usual], forward[usual]


FAR = 100.0  # camera extents from the origin, beyond which a scene is moved: float32 holds five digits of it there


def choose_dataset_world(cameras: Sequence[Camera], where: str = "cameras") -> World:
    """Choose the scene's place in the world of its file.

    If the mean camera centre is farther than :data:`FAR` extents from the origin, it becomes the scene's origin,
    rounded to a power of ten between one and ten extents. Other scenes keep their coordinates bit for bit.
    ``where`` names the file in warnings.
    """
    views = [c.viewmat.detach().double() for c in cameras]
    # solved, not transposed: far from the origin a transpose turns the rounding of a file's rotations into metres
    centers = torch.stack([-torch.linalg.solve(v[:3, :3], v[:3, 3]) for v in views])
    far = find_outliers(centers)
    if far.any():
        row = int(far.nonzero()[0])
        place = ", ".join(f"{x + 0.0:.6g}" for x in centers[row].tolist())
        found = f"{int(far.sum())} of {len(views)} cameras lie far from all others, the first at {place}"
        warn_once(f"{where}: {found}; they do not count for the scene's size")
    center = centers[~far].mean(0)
    there = World.at(center.tolist())
    extent = camera_extent([there.scene_camera(c) for c in cameras])
    if float(center.norm()) <= FAR * extent:
        return World()
    digits = -math.ceil(math.log10(extent))
    return World.at([round(x, digits) + 0.0 for x in center.tolist()])
