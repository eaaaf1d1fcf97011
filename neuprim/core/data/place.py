"""Which data sets are moved to the origin: those whose coordinates float32 cannot hold."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch

from neuprim.core.cameras import Camera
from neuprim.core.cameras.world import World
from neuprim.core.data.dataset import camera_extent, outlying
from neuprim.core.notices import warn_once

__all__ = ["FAR", "world_around"]

FAR = 100.0
"""Distance of the cameras from the origin, in extents of theirs, from which a scene is moved: float32 holds five digits
of it there."""


def world_around(cameras: Sequence[Camera], where: str = "cameras") -> World:
    """Where the scene that cameras see lies in the world of their file.

    Rule: where the mean of the camera centres is farther than :data:`FAR` extents from the origin, that mean, rounded
    to the power of ten from one to ten extents, becomes the scene's origin; all other scenes keep the coordinates of
    their files, bit for bit. ``where`` names the file in warnings.
    """
    views = [c.viewmat.detach().double() for c in cameras]
    # solved, not transposed: far from the origin a transpose turns the rounding of a file's rotations into metres
    centers = torch.stack([-torch.linalg.solve(v[:3, :3], v[:3, 3]) for v in views])
    far = outlying(centers)
    if far.any():
        row = int(far.nonzero()[0])
        place = ", ".join(f"{x + 0.0:.6g}" for x in centers[row].tolist())
        warn_once(
            f"{where}: {int(far.sum())} of {len(views)} cameras lie far from all others, the first at {place}; they do not count for the scene's size"
        )
    center = centers[~far].mean(0)
    there = World.at(center.tolist())
    extent = camera_extent([there.scene_camera(c) for c in cameras])
    if float(center.norm()) <= FAR * extent:
        return World()
    digits = -math.ceil(math.log10(extent))
    return World.at([round(x, digits) + 0.0 for x in center.tolist()])
