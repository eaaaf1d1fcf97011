"""The scene ``solids`` as a data set on disk, in the NeRF-synthetic (Blender) layout that any loader of it reads.

    transforms_train.json, transforms_test.json    camera_angle_x in radians, camera-to-world matrices with OpenGL axes
    train/r_0.png ..., test/r_0.png ...            RGBA, sRGB, straight alpha, transparent where nothing is hit

The scene, its cameras and its light are fixed: equal settings give equal files whatever the seed.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from neuprim.core.validation import Range, validate_fields
from neuprim.scenes.image_set import ImageSet, Progress
from neuprim.scenes.poses import camera_to_world, direction
from neuprim.scenes.raycast import Scene
from neuprim.scenes.rays import bands, pixel_means
from neuprim.scenes.settings import ImageSize, Supersampling, settings_key
from neuprim.scenes.shapes import build
from neuprim.scenes.solids.shading import encode_srgb, radiance

__all__ = [
    "FIELD_OF_VIEW",
    "GENERATOR_VERSION",
    "Seen",
    "SolidsSettings",
    "camera_matrices",
    "generate",
    "image_set",
    "picture",
]

Seen = Callable[[Any, NDArray[np.float64], NDArray[np.float64]], tuple[NDArray[np.float32], NDArray[np.bool_]]]
"""(scene, origins, directions) -> what :func:`~neuprim.scenes.solids.shading.radiance` returns."""

GENERATOR_VERSION = 1
"""Part of the cache's key: to be raised with every change to shapes, light, cameras or file layout."""

DISTANCE = 4.0
FIELD_OF_VIEW = math.radians(40.0)
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class SolidsSettings:
    """What the user may set for ``scene=solids``.

    Attributes:
        size: width and height of the images in pixels.
        train_views, test_views: images of each split.
        supersampling: rays per pixel along each axis.
    """

    size: ImageSize = 200
    train_views: Annotated[int, Range(1, 10000)] = 80
    test_views: Annotated[int, Range(1, 10000)] = 20
    supersampling: Supersampling = 3

    def __post_init__(self) -> None:
        validate_fields(self, "scene")

    def key(self) -> str:
        """A short hash of every setting and the generator's version."""
        return settings_key(self, GENERATOR_VERSION)


class _View(NamedTuple):
    name: str
    eye: NDArray[np.float64]


def generate(settings: SolidsSettings, cache_dir: Path, progress: Progress = lambda text, fraction: None) -> Path:
    """Write the data set unless a complete one is there; returns its folder ``cache_dir/solids-KEY``.

    Raises:
        DataError: the cache directory cannot be written.
    """
    return image_set("solids", settings.key(), settings, lambda: Scene(build())).generate(cache_dir, progress)


def image_set(
    name: str,
    key: str,
    settings: SolidsSettings,
    build: Callable[[], Scene],
    seen: Seen = radiance,
    facts: Callable[[Any], Mapping[str, Any]] = lambda scene: {},
) -> ImageSet[_View]:
    """Whatever ``build`` makes, seen by the cameras of the solids; arguments as of
    :class:`~neuprim.scenes.image_set.ImageSet`."""
    counts = {"train": settings.train_views, "test": settings.test_views}

    def draw(scene: Scene, view: _View, paths: Sequence[Path]) -> None:
        image = picture(scene, camera_to_world(view.eye), settings.size, settings.supersampling, seen)
        Image.fromarray(image).save(paths[0])

    return ImageSet(
        name=name,
        key=key,
        size=settings.size,
        splits={
            split: [_View(f"r_{i}", eye) for i, eye in enumerate(_eyes(split, count))]
            for split, count in counts.items()
        },
        lens={"camera_angle_x": FIELD_OF_VIEW},
        build=build,
        frame=lambda split, view: {
            "file_path": f"./{split}/{view.name}",
            "transform_matrix": camera_to_world(view.eye).tolist(),
        },
        files=lambda view: [f"{view.name}.png"],
        draw=draw,
        facts=facts,
    )


def camera_matrices(split: str, count: int) -> list[NDArray[np.float64]]:
    """``count`` camera-to-world matrices (4, 4), OpenGL axes, looking at the origin from distance 4.

    "train" is a Fibonacci lattice of equal area from 9 degrees below the horizon to 78 above; "test" is another,
    turning the other way from 3 to 64 degrees, so that its views fall between the first's.
    """
    return [camera_to_world(eye) for eye in _eyes(split, count)]


def _eyes(split: str, count: int) -> list[NDArray[np.float64]]:
    """(3,) positions of the cameras of :func:`camera_matrices`."""
    low, high, phase, turn = {"train": (-0.16, 0.98, 0.0, GOLDEN_ANGLE), "test": (0.05, 0.9, 1.0, -GOLDEN_ANGLE)}[split]
    return [DISTANCE * direction(low + (high - low) * (i + 0.5) / count, phase + i * turn) for i in range(count)]


def picture(
    scene: Scene, pose: NDArray[np.float64], size: int, supersampling: int, seen: Seen = radiance
) -> NDArray[np.uint8]:
    """(size, size, 4) RGBA in sRGB with straight alpha, as Blender stores it: rays are averaged premultiplied and
    linear, then encoded."""
    bands_of_rays = bands(pose, FIELD_OF_VIEW, size, supersampling)
    mean = np.concatenate([pixel_means(_rgba(scene, pose, d, seen), size, supersampling) for d in bands_of_rays])
    alpha = mean[..., 3:]
    straight = (mean[..., :3] / np.maximum(alpha, np.float32(1e-6))).astype(np.float32, copy=False)
    colour = encode_srgb(straight)
    return np.round(np.concatenate([colour, alpha], axis=-1) * 255).astype(np.uint8)


def _rgba(scene: Scene, pose: NDArray[np.float64], directions: NDArray[np.float64], seen: Seen) -> NDArray[np.float32]:
    """(N, 4) premultiplied linear RGBA of N rays."""
    rgb, hit = seen(scene, pose[:3, 3], directions)
    return np.concatenate([rgb, hit[:, None].astype(np.float32)], axis=1)
