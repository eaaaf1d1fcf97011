"""Generator of the scene ``solids``: images of solid bodies, in the NeRF-synthetic (Blender) file layout.

    transforms_train.json, transforms_test.json    camera_angle_x in radians, camera-to-world matrices with OpenGL axes
    train/r_0.png ..., test/r_0.png ...            RGBA, sRGB, straight alpha, transparent where nothing is hit

Scene, cameras and light do not depend on a seed: equal settings give equal files.
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
from neuprim.scenes.image_set import (
    ImageSize,
    Progress,
    SceneImageSet,
    Supersampling,
    average_scene_rays,
    hash_scene_settings,
    scene_camera_pose,
    scene_direction,
    scene_ray_bands,
)
from neuprim.scenes.raycast import Scene
from neuprim.scenes.shading import encode_scene_srgb, scene_daylight_radiance
from neuprim.scenes.shapes import build_solids

Radiance = Callable[[Any, NDArray[np.float64], NDArray[np.float64]], tuple[NDArray[np.float32], NDArray[np.bool_]]]
"""Function (scene, origins, directions) -> (radiance, hit mask), like
:func:`~neuprim.scenes.shading.scene_daylight_radiance`."""

GENERATOR_VERSION = 1  # part of the cache's key: raise it with every change to shapes, light, cameras or file layout

FIELD_OF_VIEW = math.radians(40.0)
_DISTANCE = 4.0
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


@dataclass(frozen=True)
class SolidsSettings:
    """Settings of ``scene=solids``: image width and height in pixels, images per split, rays per pixel per axis."""

    size: ImageSize = 512
    train_views: Annotated[int, Range(1, 10000)] = 80
    test_views: Annotated[int, Range(1, 10000)] = 20
    supersampling: Supersampling = 3

    def __post_init__(self) -> None:
        validate_fields(self, "scene")

    def key(self) -> str:
        return hash_scene_settings(self, GENERATOR_VERSION)


class _SolidsView(NamedTuple):
    name: str
    pose: NDArray[np.float64]


def generate_solids(
    settings: SolidsSettings, cache_dir: Path, progress: Progress = lambda text, fraction: None
) -> Path:
    """Write the images of ``scene=solids`` unless they exist; return the folder ``cache_dir/solids-KEY``."""
    images = describe_solids_images("solids", settings.key(), settings, lambda: Scene(build_solids()))
    return images.generate(cache_dir, progress)


def describe_solids_images(
    name: str,
    key: str,
    settings: SolidsSettings,
    build: Callable[[], Scene],
    seen: Radiance = scene_daylight_radiance,
    facts: Callable[[Any], Mapping[str, Any]] = lambda scene: {},
) -> SceneImageSet[_SolidsView]:
    """Return the image set of the scene that ``build`` makes, with the cameras of ``scene=solids``.

    ``seen`` is the function that shades rays. ``facts`` maps the scene to further fields of the transforms files.
    """

    def views(split: str, count: int) -> list[_SolidsView]:
        return [_SolidsView(f"r_{i}", pose) for i, pose in enumerate(solids_camera_poses(split, count))]

    def draw(scene: Scene, view: _SolidsView, paths: Sequence[Path]) -> None:
        Image.fromarray(draw_solids(scene, view.pose, settings.size, settings.supersampling, seen)).save(paths[0])

    return SceneImageSet(
        name=name,
        key=key,
        size=settings.size,
        splits={"train": views("train", settings.train_views), "test": views("test", settings.test_views)},
        lens={"camera_angle_x": FIELD_OF_VIEW},
        build=build,
        frame=lambda split, view: {"file_path": f"./{split}/{view.name}", "transform_matrix": view.pose.tolist()},
        files=lambda view: [f"{view.name}.png"],
        draw=draw,
        facts=facts,
    )


def solids_camera_poses(split: str, count: int) -> list[NDArray[np.float64]]:
    """Return ``count`` camera-to-world matrices (4, 4), OpenGL axes, of cameras that face the origin from distance 4.

    The cameras of "train" are on an equal-area Fibonacci lattice, from 9 degrees below the horizon to 78 above. The
    lattice of "test", from 3 to 64 degrees above, turns in the opposite direction, so that test cameras lie between
    training cameras.
    """
    low, high, phase, turn = (-0.16, 0.98, 0.0, _GOLDEN_ANGLE) if split == "train" else (0.05, 0.9, 1.0, -_GOLDEN_ANGLE)
    cosines = [low + (high - low) * (i + 0.5) / count for i in range(count)]
    return [
        scene_camera_pose(_DISTANCE * scene_direction(cosine, phase + i * turn)) for i, cosine in enumerate(cosines)
    ]


def draw_solids(
    scene: Scene, pose: NDArray[np.float64], size: int, supersampling: int, seen: Radiance = scene_daylight_radiance
) -> NDArray[np.uint8]:
    """Render an image, (size, size, 4) uint8 sRGB with straight alpha. ``pose`` (4, 4) is camera to world, OpenGL axes.

    The function ``seen`` shades the rays. The rays of a pixel are averaged in premultiplied linear light.
    """
    bands = []
    for directions in scene_ray_bands(pose, FIELD_OF_VIEW, size, supersampling):
        rgb, hit = seen(scene, pose[:3, 3], directions)
        rgba = np.concatenate([rgb, hit[:, None].astype(np.float32)], axis=1)
        bands.append(average_scene_rays(rgba, size, supersampling))
    mean = np.concatenate(bands)
    alpha = mean[..., 3:]
    straight = (mean[..., :3] / np.maximum(alpha, np.float32(1e-6))).astype(np.float32, copy=False)
    return np.round(np.concatenate([encode_scene_srgb(straight), alpha], axis=-1) * 255).astype(np.uint8)
