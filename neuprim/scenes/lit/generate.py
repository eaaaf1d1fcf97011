"""The scene ``lit_solids`` as a data set on disk, in the layout of GS³ that any loader of it reads.

    transforms_train.json, transforms_test.json, transforms_circle.json      camera_angle_x, poses with OpenGL axes,
    pl_pos, pl_intensity train/r_0000.exr                 RGBA, linear radiance over the exposure, premultiplied, half
    floats train/r_0000_unshadowed.exr      the same as if nothing cast a shadow (attached shadows stay)
    train/r_0000_classes.png         8-bit grey, index into CLASSES of :mod:`neuprim.scenes.lit`
    test/new_light_03_nearest.exr    test views only: the camera's view under the nearest of 25 training lights

A pixel is background where fewer than half of its rays hit anything; else it has the class of more than half of those
that hit, and is "lit" where there is none such. The light's intensity is :data:`INTENSITY` in every image, so images
fade with the square of its distance.

Scene, cameras and lights are fixed: equal settings give equal files whatever the seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from neuprim.core.io.exr import write_exr
from neuprim.core.validation import Range, validate_fields
from neuprim.scenes.image_set import ImageSet, Progress
from neuprim.scenes.lit import CLASSES
from neuprim.scenes.lit.rig import DISTANCE, LitView, splits
from neuprim.scenes.lit.scene import RADIUS, solids
from neuprim.scenes.lit.shading import shade
from neuprim.scenes.poses import camera_to_world
from neuprim.scenes.raycast import Scene
from neuprim.scenes.rays import bands, pixel_means
from neuprim.scenes.settings import ImageSize, Supersampling, settings_key

__all__ = ["GENERATOR_VERSION", "INTENSITY", "LitSettings", "Picture", "camera_to_world", "generate", "picture"]

GENERATOR_VERSION = 1
"""Part of the cache's key: to be raised with every change to solids, rig, shading or file layout."""

INTENSITY = 69.2
"""Radiant intensity of the lights over the exposure: it makes 1 the 99.5th percentile of the training images at the
default settings."""

FIELD_OF_VIEW = 2 * float(np.arcsin(RADIUS / DISTANCE[0]))
"""Radians; holds the whole scene from the nearest camera."""


@dataclass(frozen=True)
class LitSettings:
    """What changes the images of ``scene=lit_solids``.

    Attributes:
        size: width and height of the images in pixels.
        train_views, test_views: images of each split.
        supersampling: rays per pixel along each axis.
    """

    size: ImageSize = 160
    train_views: Annotated[int, Range(1, 100000)] = 500
    test_views: Annotated[int, Range(1, 10000)] = 100
    supersampling: Supersampling = 2

    def __post_init__(self) -> None:
        validate_fields(self, "scene")

    def key(self) -> str:
        """A short hash of every setting and the generator's version."""
        return settings_key(self, GENERATOR_VERSION)


@dataclass(frozen=True)
class Picture:
    """One image.

    Attributes:
        rgba: (size, size, 4) float32 linear radiance and coverage, premultiplied.
        unshadowed: (size, size, 4) the same as if nothing cast a shadow.
        classes: (size, size) uint8, index into :data:`neuprim.scenes.lit.CLASSES`.
    """

    rgba: NDArray[np.float32]
    unshadowed: NDArray[np.float32]
    classes: NDArray[np.uint8]


def generate(settings: LitSettings, cache_dir: Path, progress: Progress = lambda text, fraction: None) -> Path:
    """Write the data set unless a complete one is there; returns its folder ``cache_dir/lit_solids-KEY``.

    Raises:
        DataError: the cache directory cannot be written.
    """
    lens = {"camera_angle_x": FIELD_OF_VIEW, "camera_near": DISTANCE[0] - 1.5, "camera_far": DISTANCE[1] + 1.5}

    def draw(scene: Scene, view: LitView, paths: Sequence[Path]) -> None:
        pose = camera_to_world(view.camera)
        taken = picture(scene, pose, view.light, settings.size, settings.supersampling)
        file, unshadowed, classes, *nearest_light = paths
        write_exr(file, torch.from_numpy(taken.rgba), half=True)
        write_exr(unshadowed, torch.from_numpy(taken.unshadowed), half=True)
        Image.fromarray(taken.classes).save(classes)
        for path in nearest_light:
            assert view.near_light is not None
            write_exr(
                path,
                torch.from_numpy(picture(scene, pose, view.near_light, settings.size, settings.supersampling).rgba),
                half=True,
            )

    return ImageSet(
        name="lit_solids",
        key=settings.key(),
        size=settings.size,
        splits=splits(settings.train_views, settings.test_views),
        lens=lens,
        build=lambda: Scene(solids()),
        frame=_frame,
        files=_files,
        draw=draw,
    ).generate(cache_dir, progress)


def picture(
    scene: Scene, pose: NDArray[np.float64], light: NDArray[np.float64], size: int, supersampling: int
) -> Picture:
    """The view of a camera at ``pose`` (camera to world, OpenGL axes) under a light at ``light`` (3,) of
    :data:`INTENSITY`."""
    parts = []
    for directions in bands(pose, FIELD_OF_VIEW, size, supersampling):
        seen = shade(scene, pose[:3, 3], directions, light, INTENSITY)
        kinds = seen.classes[:, None] == np.arange(len(CLASSES), dtype=np.uint8)
        parts.append(
            pixel_means(
                np.concatenate([seen.rgb, seen.unshadowed, kinds], axis=1, dtype=np.float32), size, supersampling
            )
        )
    mean = np.concatenate(parts)
    shares = mean[..., 6:]
    alpha = shares[..., 1:].sum(axis=-1, keepdims=True)
    classes = np.where(alpha[..., 0] < 0.5, 0, CLASSES.index("lit")).astype(np.uint8)
    for value in range(2, len(CLASSES)):
        classes[(classes > 0) & (shares[..., value] > alpha[..., 0] / 2)] = value
    rgba, unshadowed = (np.concatenate([colour, alpha], axis=-1) for colour in (mean[..., :3], mean[..., 3:6]))
    return Picture(rgba, unshadowed, classes)


def _files(view: LitView) -> list[str]:
    nearest = [] if view.near_light is None else [f"{view.name}_nearest.exr"]
    return [f"{view.name}.exr", f"{view.name}_unshadowed.exr", f"{view.name}_classes.png", *nearest]


def _frame(split: str, view: LitView) -> dict[str, Any]:
    return {
        "file_path": f"./{split}/{view.name}",
        "file_ext": ".exr",
        "transform_matrix": camera_to_world(view.camera).tolist(),
        "pl_pos": view.light.tolist(),
        "pl_intensity": [INTENSITY] * 3,
    }
