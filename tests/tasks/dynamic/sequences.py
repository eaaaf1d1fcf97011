"""Files of a ball that moves along x, and the data set of a folder of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from neuprim.core.data import Dataset
from neuprim.core.io.vdb import Grid, scale_transform
from neuprim.core.task import SceneContext
from neuprim.tasks.dynamic.evaluation import recording_of
from neuprim.tasks.dynamic.volume.dataset import Recording
from neuprim.tasks.dynamic.volume.scene import load_dataset

VOXEL = 0.5


def blob(center: float, names: tuple[str, ...] = ("density", "flames")) -> list[Grid]:
    """A ball of radius 5 voxels at x = ``center``, denser in the middle."""
    index = np.stack(np.meshgrid(*(np.arange(24, dtype=np.float32),) * 3, indexing="ij"), -1)
    radius = np.linalg.norm(index - np.array([center, 12, 12], np.float32), axis=-1)
    value = np.clip(1 - radius / 5, 0, None)
    transform = scale_transform(VOXEL, (10.0, 0.0, -3.0))
    return [Grid.from_dense(name, value * (0.2 if name == "flames" else 1.0), transform=transform) for name in names]


def dataset(folder: Path, tmp_path: Path, **changes: Any) -> Dataset:
    settings = {"vdb": str(folder), "size": 24, "cameras": 6, "samples": 1, "look": "smoke_fire", **changes}
    return load_dataset(settings, SceneContext(0, tmp_path / "cache"))


def recorded(data: Dataset) -> Recording:
    """What its images were rendered from."""
    found = recording_of(data)
    assert found is not None
    return found
