"""The scene ``room`` as a data set on disk, in the layout of nerfstudio that any loader of it reads.

    transforms.json                   intrinsics and distortion, camera-to-world matrices with OpenGL axes, which images
    are for testing images/train_0000.png ...         RGB, sRGB, as the lens bends them
    images/test_0000.png ...
    points.ply                        points with colours, as a reconstruction finds them
    exposures.json                    what the linear light of every image is multiplied by; 1 for test images

Room, cameras, light, exposures and points are fixed: equal settings give equal files whatever the seed.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from neuprim.core.data.distortion import Radial
from neuprim.core.io.files import write_json
from neuprim.core.io.ply import write_ply
from neuprim.core.validation import Range, validate_fields
from neuprim.scenes.cached import cached_folder
from neuprim.scenes.image_set import Progress
from neuprim.scenes.rays import pixel_means
from neuprim.scenes.room.layout import furnishings
from neuprim.scenes.room.lens import LENS, Lens, bands
from neuprim.scenes.room.path import camera_matrices
from neuprim.scenes.room.points import Found, found_points
from neuprim.scenes.room.scene import Room
from neuprim.scenes.room.shading import radiance
from neuprim.scenes.settings import ImageSize, Supersampling, settings_key
from neuprim.scenes.shapes import build
from neuprim.scenes.side_by_side import side_by_side
from neuprim.scenes.solids.shading import encode_srgb

__all__ = ["GENERATOR_VERSION", "RoomSettings", "gains", "generate", "lens", "picture", "room"]

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
        return settings_key(self, GENERATOR_VERSION)


def generate(settings: RoomSettings, cache_dir: Path, progress: Progress = lambda text, fraction: None) -> Path:
    """Write the data set unless a complete one is there; returns its folder ``cache_dir/room-KEY``.

    Raises:
        ConfigError: too few views for the points.
        DataError: the cache directory cannot be written.
    """
    shots = _shots(settings)
    files = ["transforms.json", "points.ply", "exposures.json", *(f"images/{name}" for name, _, _ in shots)]
    what = "scene room: cannot write the generated images"
    return cached_folder(
        Path(cache_dir) / f"room-{settings.key()}",
        files,
        lambda folder: _write(folder, settings, shots, progress),
        what,
    )


def lens(settings: RoomSettings) -> Lens:
    """The lens that the images are taken with."""
    return Lens(settings.size, LENS if settings.distortion else Radial())


def room(settings: RoomSettings) -> Room:
    """The room, for rays as close as those of the images."""
    return Room(build(), furnishings(), 1 / (lens(settings).focal * settings.supersampling))


def gains(count: int, stops: float) -> NDArray[np.float64]:
    """(count,) what training images are multiplied by, their logarithms even between minus and plus ``stops`` to the
    base of 2."""
    return 2.0 ** (stops * (2 * np.random.default_rng(_EXPOSURE_SEED).random(count) - 1))


def picture(
    scene: Room, seen: Lens, pose: NDArray[np.float64], supersampling: int, gain: float = 1.0
) -> NDArray[np.uint8]:
    """(H, W, 3) sRGB, of linear light that is averaged over the rays of each pixel and multiplied by ``gain``."""
    parts = [
        pixel_means(radiance(scene, pose[:3, 3], d), seen.width, supersampling)
        for d in bands(seen, pose, supersampling)
    ]
    return np.round(encode_srgb(np.concatenate(parts) * np.float32(gain)) * 255).astype(np.uint8)


def _shots(settings: RoomSettings) -> list[_Shot]:
    """All images, those to train on first."""
    poses = camera_matrices(settings.train_views, settings.test_views)
    factor = {"train": gains(settings.train_views, settings.exposure).tolist(), "test": [1.0] * settings.test_views}
    return [
        (f"{split}_{i:04d}.png", pose, factor[split][i])
        for split in ("train", "test")
        for i, pose in enumerate(poses[split])
    ]


def _write(folder: Path, settings: RoomSettings, shots: list[_Shot], progress: Progress) -> None:
    progress("room: building the scene", 0.0)
    scene, seen = room(settings), lens(settings)
    text = f"room: drawing {seen.width}x{seen.height} images"
    if scene.engine != "embree":
        text += " (without embreex, which would be faster)"
    images = folder / "images"
    images.mkdir()

    def draw(shot: _Shot) -> None:
        name, pose, gain = shot
        Image.fromarray(picture(scene, seen, pose, settings.supersampling, gain)).save(images / name)

    side_by_side(draw, shots, lambda fraction: progress(text, fraction))

    def luma(index: int) -> NDArray[np.float32]:
        with Image.open(images / shots[index][0]) as image:
            bright: NDArray[np.float32] = np.asarray(image, dtype=np.float32) @ _LUMA
        return bright / np.float32(255)

    poses = [pose for _, pose, _ in shots[: settings.train_views]]
    _write_points(folder / "points.ply", found_points(scene, seen, poses, luma, settings.points))
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


def _write_points(path: Path, points: Found) -> None:
    rows = np.empty(
        len(points.position), dtype=[(n, "<f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")]
    )
    for axis, name in enumerate("xyz"):
        rows[name] = points.position[:, axis]
    for channel, name in enumerate(("red", "green", "blue")):
        rows[name] = points.rgb[:, channel]
    write_ply(path, rows)
