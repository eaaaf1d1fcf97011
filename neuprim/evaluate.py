"""Measure and draw fitted models: on held-out views, from a run directory, along an orbit or given cameras."""

from __future__ import annotations

import json
import math
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

import neuprim
from neuprim.config import RunConfig
from neuprim.core import images
from neuprim.core.camera_file import read_cameras
from neuprim.core.checkpoint import load_model
from neuprim.core.data import Dataset, View, ViewSet
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.files import cache_directory
from neuprim.core.metrics import psnr, ssim, to_json
from neuprim.core.primitives import Primitives
from neuprim.core.render import RenderSettings, choose_backend, render
from neuprim.core.task import SceneContext, TaskSpec
from neuprim.plugins.registry import load_task

__all__ = ["ViewMetrics", "display", "draw", "evaluate_run", "load_dataset", "load_run", "measure", "render_run", "summary"]


@dataclass(frozen=True)
class ViewMetrics:
    """One view's numbers; ``seconds`` is the forward pass alone."""

    name: str
    psnr: float
    ssim: float
    seconds: float


def draw(model: Primitives, view: View, settings: RenderSettings, background: Tensor) -> Tensor:
    """(H, W, C) image of one view, without gradients."""
    with torch.no_grad():
        return render(model, view.camera, view.conditions, settings, background).rgb


def measure(
    model: Primitives,
    views: ViewSet,
    settings: RenderSettings,
    background: Tensor,
    seen: Callable[[int, View, Tensor, Tensor], None] | None = None,
) -> list[ViewMetrics]:
    """PSNR and SSIM of every view of a split, float images against ``pixels.over(background)``, unclamped and unquantised.

    ``seen(index, view, rendered, truth)`` is called for each, e.g. to keep pictures.
    """
    result = []
    for i in range(len(views)):
        view, pixels = views.view(i), views.pixels(i)
        truth = pixels.over(background)
        start = time.perf_counter()
        rendered = draw(model, view, settings, background)
        seconds = time.perf_counter() - start
        if pixels.mask is not None:
            rendered = torch.where(pixels.mask[..., None], rendered, truth)
        result.append(ViewMetrics(view.name, psnr(rendered, truth, pixels.mask), ssim(rendered, truth), seconds))
        if seen is not None:
            seen(i, view, rendered, truth)
    return result


def load_dataset(config: RunConfig, task: TaskSpec, progress: Callable[[str, float], None] = lambda text, fraction: None) -> Dataset:
    """The data set of a run's configuration."""
    context = SceneContext(config.seed, cache_directory() / "scenes", progress)
    return task.scene(config.scene_name).load(config.scene, context)


def summary(
    config: RunConfig, model: Primitives, dataset: Dataset, views: Sequence[ViewMetrics], model_bytes: int, training: Mapping[str, Any]
) -> dict[str, Any]:
    """The content of ``metrics.json``. ``training`` holds iterations and train_seconds as the run recorded them."""
    worst = min(views, key=lambda v: v.psnr)
    lowered = model.lower(dataset.test.view(0).camera, dataset.test.view(0).conditions)
    seconds = sorted(v.seconds for v in views)
    return {
        "task": config.task,
        "scene": config.scene_name,
        "dataset": dataset.name,
        "preset": config.preset,
        "split": "test",
        **to_json("psnr", float(np.mean([v.psnr for v in views]))),
        "ssim": float(np.mean([v.ssim for v in views])),
        **to_json("psnr_worst", worst.psnr),
        "view_worst": worst.name,
        "per_view": [{"name": v.name, **to_json("psnr", v.psnr), "ssim": v.ssim, "seconds": v.seconds} for v in views],
        "primitives": model.count,
        "parameters": model.count * model.parameters_per_primitive,
        "parameters_per_primitive": model.parameters_per_primitive,
        "model_bytes": model_bytes,
        **training,
        "render_fps": 1.0 / max(seconds[len(seconds) // 2], 1e-9),
        "backend": choose_backend(lowered, config.renderer),
        "device": f"cpu ({platform.processor() or platform.machine()})",
        "checkpoint": "last",
        "downsampling": dataset.downsampling,
        "background": [round(float(x), 6) for x in dataset.background],
        "color_space": dataset.color_space,
        "data_source": dataset.data_source,
        "train_views": len(dataset.train),
        "seed": config.seed,
        "non_default": {key: list(pair) for key, pair in config.non_default.items()},
        "versions": {
            "neuprim": neuprim.__version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
    }


# ---------------------------------------------------------------- a run directory


def load_run(run_dir: Path) -> tuple[RunConfig, TaskSpec, Primitives, dict[str, Any]]:
    """Configuration, task, model and model header of a run directory.

    Raises:
        CheckpointError, ConfigError: naming the file that is missing or damaged.
    """
    config = RunConfig.from_yaml(run_dir / "config.yaml")
    task = load_task(config.task)
    model, header = load_model(run_dir / "model.safetensors", task)
    return config, task, model, header


def evaluate_run(run_dir: Path) -> dict[str, Any]:
    """The metrics of a run's last checkpoint, measured again from disk alone; the same numbers as the run's own."""
    config, task, model, header = load_run(run_dir)
    dataset = load_dataset(config, task)
    path = run_dir / "model.safetensors"
    training = {"iterations": header.get("iterations"), "train_seconds": header.get("train_seconds")}
    views = measure(model, dataset.test, config.renderer, dataset.background)
    return summary(config, model, dataset, views, path.stat().st_size, training)


def display(image: Tensor, color_space: str) -> Tensor:
    """(H, W, 3) display-referred copy of a rendered image: linear values get the sRGB curve, one channel becomes grey."""
    if image.shape[-1] == 1:
        image = image.expand(-1, -1, 3)
    elif image.shape[-1] != 3:
        image = torch.nn.functional.pad(image[..., :3], (0, 3 - min(image.shape[-1], 3)))
    return images.linear_to_srgb(image.clamp_min(0.0)) if color_space == "linear" else image


def render_run(
    run_dir: Path, camera: str, size: tuple[int, int] | None, format: str, out: Path | None, frames: int, conditions: Mapping[str, str]
) -> list[Path]:
    """Draw a run's model: ``camera`` is "orbit", "test" or a JSON file of cameras (see :mod:`neuprim.core.camera_file`).

    Writes one file per frame, or one animation for ``webp`` with more than one frame; returns the files.

    Raises:
        DataError, ConfigError, CheckpointError: bad cameras, conditions, or run directory.
    """
    config, task, model, header = load_run(run_dir)
    background = torch.tensor([float(x) for x in header.get("background", [0.0] * model.colour.channels)])
    color_space = str(header.get("color_space", "srgb"))
    if camera.endswith(".json"):
        views = [View(name, c) for name, c in read_cameras(Path(camera), size)]
    else:
        dataset = load_dataset(config, task)
        views = dataset.orbit(frames) if camera == "orbit" else [dataset.test.view(i) for i in range(len(dataset.test))]
    if size is not None:
        views = [replace(v, camera=v.camera.resized(*size)) for v in views]
    views = _with_conditions(views, task, conditions)

    single = out is not None and out.suffix.lower() == f".{format}"
    folder = out if out is not None and not single else run_dir / "renders" / camera.removesuffix(".json").split("/")[-1]
    animate = format == "webp" and len(views) > 1
    if single and len(views) > 1 and not animate:
        raise ConfigError(
            f"--out {out}: {len(views)} views do not fit one .{format} file; give a folder, or --format webp for an animation"
        )
    if animate:
        target = out if single and out is not None else folder.with_suffix(".webp")
        target.parent.mkdir(parents=True, exist_ok=True)
        stack = [display(draw(model, v, config.renderer, background), color_space) for v in views]
        images.write_animation(target, stack, fps=min(30.0, max(len(views) / 4.0, 5.0)))
        return [target]
    paths = []
    for v in views:
        path = out if single and out is not None else folder / f"{_file_name(v.name)}.{format}"
        path.parent.mkdir(parents=True, exist_ok=True)
        image = draw(model, v, config.renderer, background)
        if format == "exr":
            images.write_exr(path, image if color_space == "linear" else images.srgb_to_linear(image.clamp_min(0.0)), half=False)
        elif format == "webp":
            images.write_webp(path, display(image, color_space))
        else:
            images.write_png(path, display(image, color_space))
        paths.append(path)
    return paths


def _with_conditions(views: list[View], task: TaskSpec, texts: Mapping[str, str]) -> list[View]:
    """Views with the conditions the user gave; an animated condition repeats or stretches the cameras to its length."""
    for spec in task.conditions:
        if spec.name not in texts:
            continue
        values = spec.parse(texts[spec.name])
        if len(values) == 1:
            views = [replace(v, conditions={**v.conditions, spec.name: values[0]}) for v in views]
        else:
            count = max(len(values), len(views))
            pick = [(views[i * len(views) // count], values[i * len(values) // count]) for i in range(count)]
            views = [replace(v, name=f"{v.name}_{i:03d}", conditions={**v.conditions, spec.name: x}) for i, (v, x) in enumerate(pick)]
    return views


def _file_name(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name)


def read_metrics(run_dir: Path) -> dict[str, Any]:
    """``metrics.json`` of a run.

    Raises:
        DataError: missing or damaged.
    """
    path = run_dir / "metrics.json"
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise DataError(f"{path}: {error}") from error
    if not isinstance(data, dict) or not math.isfinite(float(data.get("ssim") or 0.0)):
        raise DataError(f"{path}: expected an object with metrics")
    return data
