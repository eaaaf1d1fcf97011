"""Helpers for generated scenes: camera poses, pixel rays, and writing an image set once into the cache."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from neuprim.core.cameras import look_at
from neuprim.core.errors import DataError
from neuprim.core.io.files import publish_folder
from neuprim.core.validation import Range
from neuprim.scenes.raycast import Scene

ImageSize = Annotated[int, Range(8, 4096)]
Supersampling = Annotated[int, Range(1, 16)]
Progress = Callable[[str, float], None]

RAYS_AT_ONCE = 1 << 15  # small enough for the arrays to stay in the CPU's cache
_MAX_THREADS = 4  # each image in work needs memory

T = TypeVar("T")
V = TypeVar("V")


def hash_scene_settings(settings: Any, version: int) -> str:
    """Return a short hash of all fields of a settings dataclass and of the generator's ``version``."""
    text = json.dumps({"version": version, **asdict(settings)}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def scene_direction(cosine: float, azimuth: float) -> NDArray[np.float64]:
    """Return a (3,) unit vector; the angle between the vector and the z axis has this ``cosine``.

    ``azimuth`` is the angle of the vector about the z axis, in radians from x towards y.
    """
    across = math.sqrt(max(1.0 - cosine * cosine, 0.0))
    return np.array([across * math.cos(azimuth), across * math.sin(azimuth), cosine])


def scene_camera_pose(eye: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the (4, 4) camera-to-world matrix, OpenGL axes, of a camera at ``eye`` (3,) facing the origin, z up."""
    view = look_at(torch.from_numpy(np.asarray(eye, dtype=np.float64)), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return torch.linalg.inv(view).numpy() @ np.diag([1.0, -1.0, -1.0, 1.0])


def scene_ray_bands(
    pose: NDArray[np.float64], field_of_view: float, size: int, samples: int
) -> Iterator[NDArray[np.float64]]:
    """Yield (N, 3) unit ray directions of a square image, a band of whole pixel rows at a time, from the top.

    The image has ``size`` x ``size`` pixels, and a pixel has ``samples`` x ``samples`` rays. ``pose`` is the (4, 4)
    camera-to-world matrix, OpenGL axes. ``field_of_view``, radians, is the same along both axes.
    """
    fine = size * samples
    plane = ((np.arange(fine) + 0.5) / fine * 2 - 1) * math.tan(field_of_view / 2)  # at distance 1
    rows = max(1, RAYS_AT_ONCE // (fine * samples)) * samples
    for top in range(0, fine, rows):
        x, y = np.meshgrid(plane, -plane[top : top + rows])
        local = np.stack([x, y, -np.ones_like(x)], axis=-1).reshape(-1, 3)
        local /= np.sqrt(np.einsum("nc,nc->n", local, local))[:, None]
        yield local @ pose[:3, :3].T


def average_scene_rays(values: NDArray[np.float32], size: int, samples: int) -> NDArray[np.float32]:
    """Average the (N, C) values of the rays of one band (:func:`scene_ray_bands`) per pixel; return (rows, size, C)."""
    channels = values.shape[1]
    rows = len(values) // (size * samples * samples)
    across = values.reshape(rows, samples, size, samples * channels).mean(axis=1)
    return across.reshape(rows, size, samples, channels).mean(axis=2)


def draw_in_parallel(work: Callable[[T], object], jobs: Sequence[T], progress: Callable[[float], None]) -> None:
    """Call ``work`` with each job, in threads. ``progress`` gets the fraction done.

    After an error, jobs that have not started are cancelled.
    """
    pool = ThreadPoolExecutor(min(_MAX_THREADS, os.cpu_count() or 1))
    try:
        for done, _ in enumerate(pool.map(work, jobs), start=1):
            progress(done / len(jobs))
    finally:
        pool.shutdown(cancel_futures=True)  # on an interrupt, wait for the running ones only


def scene_drawing_text(name: str, scene: Scene, width: int, height: int) -> str:
    """Return the progress text for drawing a scene's images."""
    slow = "" if scene.engine == "embree" else " (without embreex, which would be faster)"
    return f"{name}: drawing {width}x{height} images{slow}"


def write_scene_folder(final: Path, files: Iterable[str], write: Callable[[Path], None], what: str) -> Path:
    """Create the folder ``final``, unless it already contains all ``files``; return the folder.

    ``write`` fills a temporary folder, which is then renamed to ``final``. ``what`` begins the message of a DataError.
    """
    names = tuple(files)
    try:
        publish_folder(final, write, lambda folder: all((folder / name).is_file() for name in names))
    except OSError as error:
        raise DataError(f"{what} to {final}: {error}") from error
    return final


@dataclass(frozen=True)
class SceneImageSet(Generic[V]):
    """Image set of a generated scene: files ``transforms_SPLIT.json`` and folders ``SPLIT``. ``V``: type of a view."""

    name: str
    key: str  # hash of everything the files depend on
    size: int  # width and height of the images in pixels, for messages
    splits: Mapping[str, Sequence[V]]  # views of each split, in order
    lens: Mapping[str, float]  # camera fields at the start of each transforms file
    build: Callable[[], Scene]
    frame: Callable[[str, V], Mapping[str, Any]]  # (split, view) -> entry in the transforms file
    files: Callable[[V], Sequence[str]]  # view -> names of its files in the folder of its split
    # (scene, view, paths) writes these files; called from several threads
    draw: Callable[[Any, V, Sequence[Path]], None]
    facts: Callable[[Any], Mapping[str, Any]] = lambda scene: {}  # scene -> further fields of a transforms file

    def generate(self, cache_dir: Path, progress: Progress) -> Path:
        """Write the image set unless all its files exist; return the folder ``cache_dir/NAME-KEY``."""
        names = [f"transforms_{split}.json" for split in self.splits]
        names += [f"{split}/{file}" for split, views in self.splits.items() for v in views for file in self.files(v)]
        folder = Path(cache_dir) / f"{self.name}-{self.key}"
        what = f"scene {self.name}: cannot write the generated images"
        return write_scene_folder(folder, names, lambda folder: self._write_images(folder, progress), what)

    def _write_images(self, folder: Path, progress: Progress) -> None:
        progress(f"{self.name}: building the scene", 0.0)
        scene = self.build()
        for split, views in self.splits.items():
            (folder / split).mkdir()
            layout = {**self.lens, **self.facts(scene), "frames": [self.frame(split, view) for view in views]}
            (folder / f"transforms_{split}.json").write_text(json.dumps(layout, indent=1), encoding="utf-8")

        def draw(job: tuple[Path, V]) -> None:
            place, view = job
            self.draw(scene, view, [place / file for file in self.files(view)])

        jobs = [(folder / split, view) for split, views in self.splits.items() for view in views]
        text = scene_drawing_text(self.name, scene, self.size, self.size)
        draw_in_parallel(draw, jobs, lambda fraction: progress(text, fraction))
