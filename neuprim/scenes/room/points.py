"""What a reconstruction from the photographs would know of the surfaces: points where there is something to recognise,
a few of them wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from neuprim.core.errors import ConfigError
from neuprim.scenes.room.lens import Lens
from neuprim.scenes.room.scene import Room
from neuprim.scenes.room.shading import radiance
from neuprim.scenes.solids.shading import encode_srgb

__all__ = ["NOISE", "OUTLIERS", "Found", "found_points"]

NOISE = 0.005
"""Root of the mean squared displacement of a point, over its distance to the camera that found it."""

OUTLIERS = 0.02
"""Share of points that lie anywhere between their camera and the surface."""

_PLAIN = 0.03
"""Chance of a pixel without detail to become a point, over that of one with the mean detail."""

_SEED = 20250313
_ROUNDS = 40


@dataclass(frozen=True)
class Found:
    """N points.

    Attributes:
        surface: (N, 3) float64 where they really are.
        position: (N, 3) float64 where they are said to be.
        rgb: (N, 3) uint8 sRGB of the surface as its camera sees it, without the photograph's own exposure.
        camera: (N,) index of the training camera that found them.
        outlier: (N,) bool, see :data:`OUTLIERS`.
    """

    surface: NDArray[np.float64]
    position: NDArray[np.float64]
    rgb: NDArray[np.uint8]
    camera: NDArray[np.intp]
    outlier: NDArray[np.bool_]


def found_points(
    room: Room, lens: Lens, poses: Sequence[NDArray[np.float64]], luma: Callable[[int], NDArray[np.float32]], count: int
) -> Found:
    """``count`` points, each seen by the camera that found it and at least one other.

    Args:
        poses: (4, 4) camera to world, OpenGL axes, of the training cameras.
        luma: camera -> (H, W) brightness of its photograph, in which detail is looked for.

    Raises:
        ConfigError: the cameras have too little in view together.
    """
    chances = [_chances(luma(i)) for i in range(len(poses))]
    batches: list[tuple[NDArray, NDArray]] = []
    have = 0
    for attempt in range(_ROUNDS):
        random = np.random.default_rng([_SEED, attempt])
        each = -(-count // len(poses))
        for camera, pose in enumerate(poses):
            pixels = _drawn(chances[camera], lens.width, random.random((each, 3)))
            directions = lens.rays(pose, pixels)
            kept = directions[_seen_by_another(room, lens, poses, camera, directions)]
            batches.append((kept, np.full(len(kept), camera)))
            have += len(kept)
        if have >= count:
            break
    else:
        raise ConfigError(
            f"scene.points={count}: only {have} points found that two of {len(poses)} training views see; expected more views"
        )
    directions = np.concatenate([found for found, _ in batches])
    finder = np.concatenate([by for _, by in batches])
    random = np.random.default_rng([_SEED, _ROUNDS])
    chosen = np.sort(random.permutation(have)[:count])
    return _measured(
        room, np.stack([p[:3, 3] for p in poses])[finder[chosen]], directions[chosen], finder[chosen], random
    )


def _chances(luma: NDArray[np.float32]) -> NDArray[np.float64]:
    """(H * W,) running sum, up to 1, of the chance of every pixel: as much as brightness changes there."""
    down, across = np.gradient(luma.astype(np.float64))
    detail = np.hypot(down, across)
    chance = (detail + _PLAIN * max(detail.mean(), 1e-6)).ravel()
    total = np.cumsum(chance)
    return total / total[-1]


def _drawn(chances: NDArray[np.float64], width: int, numbers: NDArray[np.float64]) -> NDArray[np.float64]:
    """(M, 2) positions in the photograph, anywhere in the pixels that ``numbers`` (M, 3) of 0..1 draw."""
    index = np.minimum(np.searchsorted(chances, numbers[:, 0], side="right"), len(chances) - 1)
    return np.stack([index % width + numbers[:, 1], index // width + numbers[:, 2]], axis=1)


def _seen_by_another(
    room: Room, lens: Lens, poses: Sequence[NDArray[np.float64]], camera: int, directions: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """(M,) whether what ``camera`` sees in these directions (M, 3) lies open to one of the other cameras, within its
    picture."""
    hits = room.intersect(poses[camera][:3, 3], directions)
    starts = hits.lifted()
    seen = np.zeros(len(starts), dtype=np.bool_)
    for other, pose in enumerate(poses):
        open_ = np.flatnonzero(~seen)  # those that nobody has seen yet
        if other == camera or not len(open_):
            continue
        local = (hits.position[open_] - pose[:3, 3]) @ pose[:3, :3]
        before = local[:, 2] < -1e-3
        open_, local = open_[before], local[before]
        x, y = lens.pixels(np.stack([local[:, 0], -local[:, 1]], axis=1) / -local[:, 2:]).T
        open_ = open_[(x >= 0) & (x <= lens.width) & (y >= 0) & (y <= lens.height)]
        to_eye = pose[:3, 3] - starts[open_]
        seen[open_] = ~room.occluded(starts[open_], to_eye, 1.0)
    visible = np.zeros(len(directions), dtype=np.bool_)
    visible[hits.hit] = seen
    return visible


def _measured(
    room: Room,
    origins: NDArray[np.float64],
    directions: NDArray[np.float64],
    camera: NDArray[np.intp],
    random: np.random.Generator,
) -> Found:
    """The points that these rays (N, 3) meet, with the errors of a measurement."""
    hits = room.intersect(origins, directions)
    colours = encode_srgb(radiance(room, origins, directions))
    surface, depth = hits.position.astype(np.float64), hits.distance.astype(np.float64)[:, None]
    position = surface + depth * NOISE / np.sqrt(3) * random.standard_normal(surface.shape)
    count = len(surface)
    outlier = np.zeros(count, dtype=np.bool_)
    outlier[random.permutation(count)[: round(OUTLIERS * count)]] = True
    nearer = random.uniform(0.25, 0.9, (count, 1))
    position = np.where(outlier[:, None], origins + nearer * depth * directions, position)
    return Found(surface, position, np.round(colours * 255).astype(np.uint8), camera, outlier)
