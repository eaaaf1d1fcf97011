"""Little scenes on disk: images of known marks, and poses made independently of the loaders."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from neuprim.config import compose
from neuprim.core.data import ViewSet
from neuprim.core.errors import NeuprimError
from neuprim.core.task import SceneContext
from neuprim.runs.open import read_metrics
from neuprim.runs.run import run


class Scenes:
    """Helpers that write image files and pose files; everything in numpy, nothing from the package."""

    mark = np.array([0.21, -0.13, 0.34])

    @staticmethod
    def opengl_pose(
        eye: tuple[float, float, float], target: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> np.ndarray:
        """(4, 4) camera-to-world: columns right, up, backward, position."""
        position = np.array(eye, float)
        back = position - np.array(target, float)
        back /= np.linalg.norm(back)
        right = np.cross([0.0, 0.0, 1.0], back)
        right /= np.linalg.norm(right)
        pose = np.eye(4)
        pose[:3] = np.stack([right, np.cross(back, right), back, position], axis=1)
        return pose

    @staticmethod
    def ring(count: int, radius: float = 3.0) -> list[np.ndarray]:
        angles = 2 * np.pi * np.arange(count) / count + 0.3
        return [
            Scenes.opengl_pose((radius * np.cos(a), radius * np.sin(a), 0.4 * radius * np.sin(3 * a))) for a in angles
        ]

    @staticmethod
    def direction(pose: np.ndarray, point: np.ndarray) -> tuple[float, float]:
        """(x/z, y/z) of a point, x right, y down, as the camera at an OpenGL pose sees it."""
        x, y, z, _ = np.linalg.inv(pose) @ np.append(point, 1.0)
        return x / -z, y / z

    @staticmethod
    def blob(width: int, height: int, u: float, v: float, sigma: float = 2.0) -> np.ndarray:
        """(H, W) 0..1: a round spot whose middle is at (u, v), with pixel centres at +0.5."""
        x, y = np.arange(width) + 0.5, np.arange(height) + 0.5
        return np.exp(-((x[None] - u) ** 2 + (y[:, None] - v) ** 2) / (2 * sigma**2))

    @staticmethod
    def centroid(image: np.ndarray) -> tuple[float, float]:
        """The middle (u, v) of the bright spot in an (H, W) image."""
        y, x = np.indices(image.shape) + 0.5
        return float((image * x).sum() / image.sum()), float((image * y).sum() / image.sum())

    @staticmethod
    def save(path: Path, values: np.ndarray) -> None:
        """Write 0..1 values, (H, W), (H, W, 3) or (H, W, 4), as 8-bit PNG; (H, W) as equal RGB."""
        path.parent.mkdir(parents=True, exist_ok=True)
        values = np.repeat(values[..., None], 3, axis=-1) if values.ndim == 2 else values
        Image.fromarray((values * 255).round().astype(np.uint8)).save(path)

    @staticmethod
    def write_json(path: Path, value: Any) -> None:
        path.write_text(json.dumps(value))

    @staticmethod
    def off_by(views: ViewSet, index: int, point: np.ndarray | None = None) -> float:
        """Pixels between where a view's camera puts the mark and where its image shows it."""
        camera, pixels = views.view(index).camera, views.pixels(index)
        p = camera.viewmat.numpy() @ np.append(Scenes.mark if point is None else point, 1.0)
        u, v = camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy
        seen = pixels.rgb[..., 0] if pixels.mask is None else pixels.rgb[..., 0] * pixels.mask
        found = Scenes.centroid(seen.numpy())
        return float(np.hypot(found[0] - u, found[1] - v))

    @staticmethod
    def refused(load: Callable[..., Any], settings: Mapping[str, Any], context: SceneContext, *words: str) -> str:
        """The message of the package's own error; it must contain ``words``."""
        with pytest.raises(NeuprimError) as caught:
            load(settings, context)
        text = str(caught.value)
        for word in words:
            assert word in text, text
        return text

    @staticmethod
    def fitted(scene: str, path: Path, out: Path) -> dict[str, Any]:
        """Metrics of a short run, from data to report, that has learned something: its loss has fallen by half."""
        words = [
            "task=static",
            f"scene={scene}",
            f"scene.path={path}",
            f"output_dir={out}",
            "model.primitives=60",
            "model.neurons=4",
        ]
        run(compose([*words, "train.iterations=150", "train.max_seconds=null", "train.population.every=20"]))
        assert (out / "report.html").exists()
        losses = [json.loads(line)["loss"] for line in (out / "metrics.jsonl").read_text().splitlines()]
        assert losses[-1] < 0.5 * losses[0], losses
        return read_metrics(out)


@pytest.fixture
def scenes() -> type[Scenes]:
    return Scenes


@pytest.fixture
def context(tmp_path: Path) -> SceneContext:
    return SceneContext(seed=0, cache_dir=tmp_path / "cache")


@pytest.fixture
def chair() -> Path:
    """The NeRF-synthetic chair at 200x200, where the developer has it."""
    root = Path(os.environ.get("NEUPRIM_TEST_DATA") or Path(__file__).parents[3] / "shared" / "data")
    path = root / "nerf_synthetic" / "chair_200"
    if not path.is_dir():
        pytest.skip(f"needs real data: no {path} (set NEUPRIM_TEST_DATA to a folder with nerf_synthetic/chair_200)")
    return path
