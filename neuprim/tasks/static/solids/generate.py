"""The scene ``solids`` as a data set on disk, in the NeRF-synthetic (Blender) layout that any loader of it reads.

    transforms_train.json, transforms_test.json    camera_angle_x in radians, camera-to-world matrices with OpenGL axes
    train/r_0.png ..., test/r_0.png ...            RGBA, sRGB, straight alpha, transparent where nothing is hit

The scene, its cameras and its light are fixed: equal settings give equal files whatever the seed.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from neuprim.core.cameras import look_at
from neuprim.core.data import Dataset
from neuprim.core.errors import DataError
from neuprim.core.io.files import publish_folder
from neuprim.core.task import SceneContext
from neuprim.scenes.raycast import Scene
from neuprim.scenes.rays import bands, pixel_means
from neuprim.scenes.settings import check_names, check_whole, settings_key
from neuprim.scenes.shapes import build
from neuprim.tasks.static.solids.shading import encode_srgb, radiance

__all__ = ["GENERATOR_VERSION", "SolidsSettings", "camera_matrices", "generate", "load", "picture"]

GENERATOR_VERSION = 1
"""Part of the cache's key: to be raised with every change to shapes, light, cameras or file layout."""

DISTANCE = 4.0
FIELD_OF_VIEW = math.radians(40.0)
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))

Progress = Callable[[str, float], None]


@dataclass(frozen=True)
class SolidsSettings:
    """What the user may set for ``scene=solids``.

    Attributes:
        size: width and height of the images in pixels.
        train_views, test_views: images of each split.
        supersampling: rays per pixel along each axis.
    """

    size: int = 200
    train_views: int = 80
    test_views: int = 20
    supersampling: int = 3

    def __post_init__(self) -> None:
        check_whole(self, {"size": (8, 4096), "train_views": (1, 10000), "test_views": (1, 10000), "supersampling": (1, 16)})

    @staticmethod
    def parse(settings: Mapping[str, Any]) -> SolidsSettings:
        """Settings from a mapping; :class:`ConfigError` for an unknown name or impossible value."""
        check_names(settings, [f.name for f in fields(SolidsSettings)])
        return SolidsSettings(**settings)

    def key(self) -> str:
        """A short hash of every setting and the generator's version."""
        return settings_key(self, GENERATOR_VERSION)


def load(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """The data set of ``scene=solids``, drawn on first use and read from ``context.cache_dir`` afterwards.

    Raises:
        ConfigError: unknown setting or impossible value.
        DataError: the cache directory cannot be written.
    """
    folder = generate(SolidsSettings.parse(settings), context.cache_dir, context.progress)
    from neuprim.tasks.static.datasets import blender

    return replace(blender.load({"path": str(folder)}, context), name="solids", data_source="generated")


def generate(settings: SolidsSettings, cache_dir: Path, progress: Progress = lambda text, fraction: None) -> Path:
    """Write the data set unless a complete one is there; returns its folder ``cache_dir/solids-KEY``.

    The folder appears under its name only when complete, so an interrupted run leaves nothing that could be taken for a data set.

    Raises:
        DataError: the cache directory cannot be written.
    """
    final = Path(cache_dir) / f"solids-{settings.key()}"
    try:
        publish_folder(final, lambda draft: _write(settings, draft, progress), lambda folder: _complete(folder, settings))
    except OSError as error:
        raise DataError(f"scene solids: cannot write the generated images to {final}: {error}") from error
    return final


def camera_matrices(split: str, count: int) -> list[NDArray[np.float64]]:
    """``count`` camera-to-world matrices (4, 4), OpenGL axes, looking at the origin from distance 4.

    "train" is a Fibonacci lattice of equal area from 9 degrees below the horizon to 78 above; "test" is another, turning the other way
    from 3 to 64 degrees, so that its views fall between the first's.
    """
    low, high, phase, turn = {"train": (-0.16, 0.98, 0.0, GOLDEN_ANGLE), "test": (0.05, 0.9, 1.0, -GOLDEN_ANGLE)}[split]
    matrices = []
    for i in range(count):
        z = low + (high - low) * (i + 0.5) / count
        across, angle = math.sqrt(1 - z * z), phase + i * turn
        eye = DISTANCE * torch.tensor([across * math.cos(angle), across * math.sin(angle), z], dtype=torch.float64)
        view = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
        matrices.append(torch.linalg.inv(view).numpy() @ np.diag([1.0, -1.0, -1.0, 1.0]))
    return matrices


def picture(scene: Scene, camera_to_world: NDArray[np.float64], size: int, supersampling: int) -> NDArray[np.uint8]:
    """(size, size, 4) RGBA in sRGB with straight alpha, as Blender stores it: rays are averaged premultiplied and linear, then encoded."""
    bands_of_rays = bands(camera_to_world, FIELD_OF_VIEW, size, supersampling)
    mean = np.concatenate([pixel_means(_seen(scene, camera_to_world, d), size, supersampling) for d in bands_of_rays])
    alpha = mean[..., 3:]
    straight = (mean[..., :3] / np.maximum(alpha, np.float32(1e-6))).astype(np.float32, copy=False)
    colour = encode_srgb(straight)
    return np.round(np.concatenate([colour, alpha], axis=-1) * 255).astype(np.uint8)


def _seen(scene: Scene, pose: NDArray[np.float64], directions: NDArray[np.float64]) -> NDArray[np.float32]:
    """(N, 4) premultiplied linear RGBA of N rays."""
    rgb, hit = radiance(scene, pose[:3, 3], directions)
    return np.concatenate([rgb, hit[:, None].astype(np.float32)], axis=1)


def _splits(settings: SolidsSettings) -> Iterator[tuple[str, int]]:
    yield "train", settings.train_views
    yield "test", settings.test_views


def _write(settings: SolidsSettings, folder: Path, progress: Progress) -> None:
    progress("solids: building the scene", 0.0)
    scene = Scene(build())
    text = f"solids: drawing {settings.size}x{settings.size} images"
    if scene.engine != "embree":
        text += " (without embreex, which would be faster)"
    jobs: list[tuple[NDArray[np.float64], Path]] = []
    for split, count in _splits(settings):
        (folder / split).mkdir()
        matrices = camera_matrices(split, count)
        frames = [{"file_path": f"./{split}/r_{i}", "transform_matrix": matrix.tolist()} for i, matrix in enumerate(matrices)]
        layout = {"camera_angle_x": FIELD_OF_VIEW, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(layout, indent=1), encoding="utf-8")
        jobs += [(matrix, folder / split / f"r_{i}.png") for i, matrix in enumerate(matrices)]

    def draw(job: tuple[NDArray[np.float64], Path]) -> None:
        Image.fromarray(picture(scene, job[0], settings.size, settings.supersampling)).save(job[1])

    pool = ThreadPoolExecutor(min(4, os.cpu_count() or 1))
    try:
        for done, _ in enumerate(pool.map(draw, jobs), start=1):
            progress(text, done / len(jobs))
    finally:
        pool.shutdown(cancel_futures=True)  # on an interrupt, wait for the running images only


def _complete(folder: Path, settings: SolidsSettings) -> bool:
    files = [folder / f"transforms_{split}.json" for split, _ in _splits(settings)]
    files += [folder / split / f"r_{i}.png" for split, count in _splits(settings) for i in range(count)]
    return all(file.is_file() for file in files)
