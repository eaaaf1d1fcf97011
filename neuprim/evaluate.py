"""Measure and draw the model of a run directory: on its held-out views, along an orbit or given cameras."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from neuprim.config import RunConfig
from neuprim.core import images
from neuprim.core.camera_file import read_cameras
from neuprim.core.checkpoint import load_model
from neuprim.core.data import Dataset, View
from neuprim.core.datasets.records import Record
from neuprim.core.environment import EnvironmentFile, Illumination, read_environment
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.fields import Conditions
from neuprim.core.files import cache_directory
from neuprim.core.film import write_film
from neuprim.core.primitives import Primitives
from neuprim.core.task import SceneContext, TaskSpec
from neuprim.measure import display, draw, draw_sum, measure, summary
from neuprim.plugins.registry import find_scene, load_task

__all__ = ["FORMATS", "evaluate_run", "load_dataset", "load_run", "read_metrics", "render_run"]

ANIMATIONS = ("webp", "gif", "mp4")
FORMATS = ("png", "exr", *ANIMATIONS)
"""What ``neuprim render`` writes."""


def load_dataset(config: RunConfig, task: TaskSpec, progress: Callable[[str, float], None] = lambda text, fraction: None) -> Dataset:
    """The data set of a run's configuration."""
    context = SceneContext(config.seed, cache_directory() / "scenes", progress)
    return find_scene(task, config.scene_name).spec.load(config.scene, context)


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
    views = measure(model, dataset, config.renderer)
    return summary(config, model, dataset, views, path.stat().st_size, training)


def render_run(
    run_dir: Path,
    camera: str,
    size: tuple[int, int] | None,
    format: str | None,
    out: Path | None,
    frames: int,
    conditions: Mapping[str, str],
    fps: float | None = None,
    environment: EnvironmentFile | None = None,
    tell: Callable[[str], None] = lambda text: None,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
) -> list[Path]:
    """Draw a run's model: ``camera`` is "orbit", "test" or a JSON file of cameras (see :mod:`neuprim.core.camera_file`).

    Writes one file per view, or one animation for the formats of :data:`ANIMATIONS` with more than one view; returns the files.
    Without a format, the suffix of ``out`` decides, else views that differ in a condition become a WebP animation and others PNGs.

    Args:
        conditions: name -> text, e.g. ``{"time": "0:1"}``.
        fps: of an animation; None lets it last four seconds, at 5 to 30 frames per second.
        environment: light from all around instead of the task's light.
        tell: called with lines for the user, e.g. what the model never saw.
        progress: called with (text, fraction 0..1) while images are drawn.

    Raises:
        DataError, ConfigError, CheckpointError: bad cameras, conditions, or run directory.
        BackendUnavailable: a format whose package is missing.
    """
    config, task, model, header = load_run(run_dir)
    background = torch.tensor([float(x) for x in header.get("background", [0.0] * model.colour.channels)])
    color_space = str(header.get("color_space", "srgb"))
    lights: Sequence[Conditions] = ()
    if environment is not None:
        around = _illumination(environment, config, task, header, conditions)
        lights = around.frames(environment.guesses)
        if not lights:
            raise ConfigError(f"--environment-unseen drop: all light of {environment.path} comes from where the model never saw any")
        hint = " (--environment-unseen drop leaves it out)" if environment.guesses and any(around.guessed) else ""
        for note in around.notes:
            tell(f"{environment.path}: {note}{hint}")
    if camera.endswith(".json"):
        views = [View(name, c) for name, c in read_cameras(Path(camera), size)]
    else:
        dataset = load_dataset(config, task)
        views = dataset.orbit(frames) if camera == "orbit" else [dataset.test.view(i) for i in range(len(dataset.test))]
    if size is not None:
        views = [replace(v, camera=v.camera.resized(*size)) for v in views]
    if lights:  # these replace the views' own; the first stands for all where only their presence counts
        views = [replace(v, conditions={**v.conditions, **lights[0]}) for v in views]
    views, animated = with_conditions(views, task, conditions)
    format = format or _format_of(out, animated)

    single = out is not None and out.suffix.lower() == f".{format}"
    folder = out if out is not None and not single else run_dir / "renders" / camera.removesuffix(".json").split("/")[-1]
    animate = format in ANIMATIONS and len(views) > 1
    if single and len(views) > 1 and not animate:
        raise ConfigError(
            f"--out {out}: {len(views)} views do not fit one .{format} file; give a folder, or --format webp for an animation"
        )
    done = 0

    def image(view: View) -> torch.Tensor:
        def drawn() -> None:
            nonlocal done
            done += 1
            progress(f"view {done // each + (done % each > 0)} of {len(views)}", done / (each * len(views)))

        each = max(len(lights), 1)
        if lights:
            return draw_sum(model, view, lights, config.renderer, background, drawn)
        result = draw(model, view, config.renderer, background)
        drawn()
        return result

    if animate:
        target = out if single and out is not None else folder.with_suffix(f".{format}")
        target.parent.mkdir(parents=True, exist_ok=True)
        stack = [display(image(v), color_space) for v in views]
        write_film(target, stack, fps or min(30.0, max(len(views) / 4.0, 5.0)))
        return [target]
    paths = []
    for v in views:
        path = out if single and out is not None else folder / f"{_file_name(v.name)}.{format}"
        path.parent.mkdir(parents=True, exist_ok=True)
        pixels = image(v)
        if format == "exr":
            images.write_exr(path, pixels if color_space == "linear" else images.srgb_to_linear(pixels.clamp_min(0.0)), half=False)
        elif format == "png":
            images.write_png(path, display(pixels, color_space))
        elif format == "webp":
            images.write_webp(path, display(pixels, color_space))
        else:
            write_film(path, [display(pixels, color_space)], fps or 12.0)
        paths.append(path)
    return paths


def _illumination(
    choice: EnvironmentFile, config: RunConfig, task: TaskSpec, header: Mapping[str, Any], conditions: Mapping[str, str]
) -> Illumination:
    """The frames that stand for an environment."""
    if task.environment is None:
        raise ConfigError(f"--environment {choice.path}: task {task.name!r} has no light that it could replace")
    facts = header.get("data")
    if facts is None:  # written before models kept them
        facts = load_dataset(config, task).facts()
    if not isinstance(facts, dict):
        raise DataError(f"the model's header: data is {type(facts).__name__}; expected an object")
    up = Record(facts, "the model's header: data").array("up", (3,), "3 numbers")
    found = task.environment(read_environment(choice.path, up, choice.rotation, choice.scale), choice.samples, facts)
    clash = sorted(conditions.keys() & found.conditions[0].keys())
    if clash:
        raise ConfigError(f"--{clash[0].replace('_', '-')} and --environment: give one of them")
    return found


def _format_of(out: Path | None, animated: bool) -> str:
    suffix = "" if out is None else out.suffix.lower().removeprefix(".")
    return suffix if suffix in FORMATS else "webp" if animated else "png"


def with_conditions(views: list[View], task: TaskSpec, texts: Mapping[str, str]) -> tuple[list[View], bool]:
    """Views with the conditions the user gave, and whether one of these is animated; an animated condition repeats or stretches the
    cameras to its length.

    Raises:
        ConfigError: a view lacks a condition that the task needs.
    """
    animated = False
    for spec in task.conditions:
        if spec.name in texts:
            values = spec.parse(texts[spec.name])
            if len(values) == 1:
                views = [replace(v, conditions={**v.conditions, spec.name: values[0]}) for v in views]
            else:
                animated = True
                count = max(len(values), len(views))
                pick = [(views[i * len(views) // count], values[i * len(values) // count]) for i in range(count)]
                views = [replace(v, name=f"{v.name}_{i:03d}", conditions={**v.conditions, spec.name: x}) for i, (v, x) in enumerate(pick)]
        for v in views:
            if spec.name not in v.conditions:
                raise ConfigError(f"view {v.name} has no {spec.name}, which task {task.name!r} needs; give {spec.flag}")
    return views, animated


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
