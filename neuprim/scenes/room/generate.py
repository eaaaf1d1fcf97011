"""What a reconstruction from the photographs would know of the surfaces: points where there is something to recognise,
a few of them wrong."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from neuprim.core.data.distortion import Radial
from neuprim.core.errors import ConfigError
from neuprim.core.io.files import write_json
from neuprim.core.io.ply import write_ply
from neuprim.core.validation import Range, validate_fields
from neuprim.scenes.image_set import (
    ImageSize,
    Progress,
    Supersampling,
    average_rays,
    draw_in_parallel,
    hash_settings,
    write_cached_folder,
)
from neuprim.scenes.room.cameras import LENS, Lens, lens_ray_bands, room_camera_poses
from neuprim.scenes.room.interior import Room, furnish_room, lamplight_radiance
from neuprim.scenes.shading import encode_srgb
from neuprim.scenes.shapes import build_solids

__all__ = [
    "ReconstructedPoints",
    "GENERATOR_VERSION",
    "NOISE",
    "OUTLIERS",
    "RoomSettings",
    "reconstruct_points",
    "exposure_gains",
    "generate_room",
    "room_lens",
    "photograph_room",
    "build_room",
]

NOISE = 0.005
"""Root of the mean squared displacement of a point, over its distance to the camera that found it."""

OUTLIERS = 0.02
"""Share of points that lie anywhere between their camera and the surface."""

_PLAIN = 0.03
"""Chance of a pixel without detail to become a point, over that of one with the mean detail."""

_SEED = 20250313
_ROUNDS = 40


@dataclass(frozen=True)
class ReconstructedPoints:
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


def reconstruct_points(
    room: Room,
    lens: Lens,
    poses: Sequence[NDArray[np.float64]],
    luma: Callable[[int], NDArray[np.float32]],
    count: int,
) -> ReconstructedPoints:
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
            f"scene.points={count}: only {have} points found that two of {len(poses)} training views see; "
            "expected more views"
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
    room: Room,
    lens: Lens,
    poses: Sequence[NDArray[np.float64]],
    camera: int,
    directions: NDArray[np.float64],
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
) -> ReconstructedPoints:
    """The points that these rays (N, 3) meet, with the errors of a measurement."""
    hits = room.intersect(origins, directions)
    colours = encode_srgb(lamplight_radiance(room, origins, directions))
    surface, depth = hits.position.astype(np.float64), hits.distance.astype(np.float64)[:, None]
    position = surface + depth * NOISE / np.sqrt(3) * random.standard_normal(surface.shape)
    count = len(surface)
    outlier = np.zeros(count, dtype=np.bool_)
    outlier[random.permutation(count)[: round(OUTLIERS * count)]] = True
    nearer = random.uniform(0.25, 0.9, (count, 1))
    position = np.where(outlier[:, None], origins + nearer * depth * directions, position)
    return ReconstructedPoints(surface, position, np.round(colours * 255).astype(np.uint8), camera, outlier)


GENERATOR_VERSION = 1
"""Part of the cache's key: to be raised with every change to the room, its light, cameras or file layout."""

_EXPOSURE_SEED = 20250314
_LUMA = np.array([0.2126, 0.7152, 0.0722], dtype=np.float32)
_Shot = tuple[str, NDArray[np.float64], float]
"""Name of the image's file, pose, gain."""


@dataclass(frozen=True)
class RoomSettings:
    """What the user may set for ``scene=room``.

    Attributes:
        size: width of the images in pixels; the height is three quarters of it.
        train_views, test_views: images of each split.
        supersampling: rays per pixel along each axis.
        exposure: stops by which training images are brighter or darker at most.
        points: how many points a reconstruction has found.
        distortion: whether the lens bends the images.
    """

    size: ImageSize = 200
    train_views: Annotated[int, Range(2, 10000)] = 80
    test_views: Annotated[int, Range(1, 10000)] = 20
    supersampling: Supersampling = 2
    exposure: Annotated[float, Range(0, 2)] = 0.15
    points: Annotated[int, Range(1, 1000000)] = 3000
    distortion: bool = True

    def __post_init__(self) -> None:
        validate_fields(self, "scene")

    def key(self) -> str:
        """A short hash of every setting and the generator's version."""
        return hash_settings(self, GENERATOR_VERSION)


def generate_room(settings: RoomSettings, cache_dir: Path, progress: Progress = lambda text, fraction: None) -> Path:
    """Write the data set unless a complete one is there; returns its folder ``cache_dir/room-KEY``.

    Raises:
        ConfigError: too few views for the points.
        DataError: the cache directory cannot be written.
    """
    shots = _shots(settings)
    files = ["transforms.json", "points.ply", "exposures.json", *(f"images/{name}" for name, _, _ in shots)]
    what = "scene room: cannot write the generated images"
    return write_cached_folder(
        Path(cache_dir) / f"room-{settings.key()}",
        files,
        lambda folder: _write(folder, settings, shots, progress),
        what,
    )


def room_lens(settings: RoomSettings) -> Lens:
    """The lens that the images are taken with."""
    return Lens(settings.size, LENS if settings.distortion else Radial())


def build_room(settings: RoomSettings) -> Room:
    """The room, for rays as close as those of the images."""
    return Room(build_solids(), furnish_room(), 1 / (room_lens(settings).focal * settings.supersampling))


def exposure_gains(count: int, stops: float) -> NDArray[np.float64]:
    """(count,) what training images are multiplied by, their logarithms even between minus and plus ``stops`` to the
    base of 2."""
    return 2.0 ** (stops * (2 * np.random.default_rng(_EXPOSURE_SEED).random(count) - 1))


def photograph_room(
    scene: Room, seen: Lens, pose: NDArray[np.float64], supersampling: int, gain: float = 1.0
) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB, of linear light that is averaged over the rays of each pixel and multiplied by ``gain``."""
    parts = [
        average_rays(lamplight_radiance(scene, pose[:3, 3], d), seen.width, supersampling)
        for d in lens_ray_bands(seen, pose, supersampling)
    ]
    return np.round(encode_srgb(np.concatenate(parts) * np.float32(gain)) * 255).astype(np.uint8)


def _shots(settings: RoomSettings) -> list[_Shot]:
    """All images, those to train on first."""
    poses = room_camera_poses(settings.train_views, settings.test_views)
    factor = {
        "train": exposure_gains(settings.train_views, settings.exposure).tolist(),
        "test": [1.0] * settings.test_views,
    }
    return [
        (f"{split}_{i:04d}.png", pose, factor[split][i])
        for split in ("train", "test")
        for i, pose in enumerate(poses[split])
    ]


def _write(folder: Path, settings: RoomSettings, shots: list[_Shot], progress: Progress) -> None:
    progress("room: building the scene", 0.0)
    scene, seen = build_room(settings), room_lens(settings)
    text = f"room: drawing {seen.width}x{seen.height} images"
    if scene.engine != "embree":
        text += " (without embreex, which would be faster)"
    images = folder / "images"
    images.mkdir()

    def draw(shot: _Shot) -> None:
        name, pose, gain = shot
        Image.fromarray(photograph_room(scene, seen, pose, settings.supersampling, gain)).save(images / name)

    draw_in_parallel(draw, shots, lambda fraction: progress(text, fraction))

    def luma(index: int) -> NDArray[np.float32]:
        with Image.open(images / shots[index][0]) as image:
            bright: NDArray[np.float32] = np.asarray(image, dtype=np.float32) @ _LUMA
        return bright / np.float32(255)

    poses = [pose for _, pose, _ in shots[: settings.train_views]]
    _write_points(folder / "points.ply", reconstruct_points(scene, seen, poses, luma, settings.points))
    write_json(folder / "exposures.json", {f"images/{name}": gain for name, _, gain in shots})
    write_json(folder / "transforms.json", _layout(seen, shots))


def _layout(seen: Lens, shots: list[_Shot]) -> dict[str, Any]:
    camera = seen.camera
    names = [f"images/{name}" for name, _, _ in shots]
    return {
        "camera_model": "OPENCV",
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "w": camera.width,
        "h": camera.height,
        **{key: value for key, value in asdict(seen.distortion).items() if value},
        "ply_file_path": "points.ply",
        "train_filenames": [name for name in names if "/train_" in name],
        "test_filenames": [name for name in names if "/test_" in name],
        "frames": [
            {"file_path": name, "transform_matrix": pose.tolist()}
            for name, (_, pose, _) in zip(names, shots, strict=True)
        ],
    }


def _write_points(path: Path, points: ReconstructedPoints) -> None:
    rows = np.empty(
        len(points.position), dtype=[(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    )
    for axis, name in enumerate("xyz"):
        rows[name] = points.position[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = points.rgb[:, channel]
    write_ply(path, rows)
