"""Files of an ellipsoid that moves along x, and the data set of a folder of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neuprim.core.data import Dataset
from neuprim.core.io.vdb import VdbGrid, vdb_scale_transform, write_vdb
from neuprim.core.task import SceneContext
from neuprim.tasks.dynamic import vdb_recording_of
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.capture_dataset import VolumeRecording
from neuprim.tasks.dynamic.volume.volume_scene import load_volume_scene

VOXEL = 0.5
MIDDLE = (8, 15)  # along y and z, in voxels
ORIGIN = (10.0, 0.0, -3.0)


def blob(center: float, names: tuple[str, ...] = ("density", "flames"), fine: int = 1) -> list[VdbGrid]:
    """An ellipsoid of semi-axes 5, 3.5 and 6.5 voxels at x = ``center``, denser in the middle; no two axes are alike.

    With ``fine`` as many voxels share each edge.
    """
    index = np.stack(np.meshgrid(*(np.arange(n * fine) / fine for n in (24, 18, 28)), indexing="ij"), -1)
    radius = np.linalg.norm((index - [center, *MIDDLE]) / [5.0, 3.5, 6.5], axis=-1)
    value = np.clip(1 - radius, 0, None).astype(np.float32)
    transform = vdb_scale_transform(VOXEL / fine, ORIGIN)
    return [VdbGrid.from_dense(name, value * (0.2 if name == "flames" else 1.0), transform=transform) for name in names]


def empty_frame() -> list[VdbGrid]:
    return [VdbGrid.from_dense("density", np.zeros((8, 8, 8), np.float32), transform=vdb_scale_transform(VOXEL))]


def write_blobs(folder: Path, centers: dict[int, float], names: tuple[str, ...] = ("density", "flames")) -> Path:
    """A folder of frames by number."""
    folder.mkdir(exist_ok=True)
    for number, center in centers.items():
        write_vdb(folder / f"ball_{number}.vdb", blob(center, names))
    return folder


def to_world(capture: Capture, points: np.ndarray) -> np.ndarray:
    """World positions of (N, 3) scene points."""
    return points / capture.normalisation.scale + capture.normalisation.center


def dataset(folder: Path, tmp_path: Path, **changes: Any) -> Dataset:
    settings = {"vdb": str(folder), "size": 24, "cameras": 6, "samples": 1, "look": "smoke_fire", **changes}
    return load_volume_scene(settings, SceneContext(0, tmp_path / "cache"))


def recorded(data: Dataset) -> VolumeRecording:
    """What its images were rendered from."""
    found = vdb_recording_of(data)
    assert found is not None
    return found
