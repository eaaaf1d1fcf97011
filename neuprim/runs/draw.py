"""Images of a finished run: of its held-out views, along an orbit or from given cameras."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from neuprim.config import RunConfig, suspects_of, task_of
from neuprim.core.cameras.camera_files import read_camera_file
from neuprim.core.cameras.pinhole import CameraViews
from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels, stored_channels
from neuprim.core.conditions import flag, in_step, read_conditions
from neuprim.core.data import View
from neuprim.core.environment import EnvironmentFile, Illumination, read_environment
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io import images
from neuprim.core.io.animation import write_animation
from neuprim.core.io.files import write_npy
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import TaskSpec
from neuprim.plugins.judging import facts_of, orbit_of
from neuprim.runs.layers import Layers
from neuprim.runs.measure import draw_sum
from neuprim.runs.open import LOGS, load_dataset, load_run, placed
from neuprim.runs.render_config import parse_render_config
from neuprim.runs.results import refuse_results

__all__ = ["FORMATS", "SETS", "render_run", "with_conditions"]

SPACES = WORLD, SCENE = ("world", "scene")
"""Whose coordinates a file of cameras has, after ``--space``."""

SETS = ("orbit", "test")
"""Cameras of the run's own."""

_TIME = "time"

ANIMATIONS = ("webp", "gif", "mp4")
_RAW = ("exr", "npy")
FORMATS = ("png", "exr", "npy", *ANIMATIONS)
"""What ``neuprim render`` writes: pictures of what the task's channels look like, but all channels as they are in EXR
and npy."""


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
    words: Sequence[str] = (),
    layers: str | None = None,
    datatype: str | None = None,
    space: str = WORLD,
    overwrite: bool = False,
) -> list[Path]:
    """Draw a run's model: ``camera`` is "orbit", "test" or a file of cameras (see :mod:`neuprim.core.cameras.camera_files`).

    Writes one file per view, or one animation for the formats of :data:`ANIMATIONS` with more than one view; returns
    the files.
    Without a format, the suffix of ``out`` decides, else views that differ in a condition become a WebP animation and
    others PNGs.

    Args:
        conditions: name -> text, e.g. ``{"time": "0:1"}``.
        fps: of an animation; None for what the file of cameras says, or lets it last four seconds, at 5 to 30 frames
        per second. environment: light from all around instead of the task's light.
        tell: called with lines for the user, e.g. what the model never saw.
        progress: called with (text, fraction 0..1) while images are drawn.
        words: of an operating point (:mod:`neuprim.runs.render_config`), over how the run draws.
        layers: of an OpenEXR file, names separated by commas (:mod:`neuprim.core.layers`); None for all but a layer per
        light. space: "world": a file's cameras, lights, and what is written of cameras and depths are in the
        coordinates of the data's files; "scene":
            in those of the model, for volumes their unit box.
        datatype: of light and alpha in an OpenEXR file, "half" or "float" (16 or 32 bits, the default).
        overwrite: replace pictures of the run's report.

    Raises:
        DataError, ConfigError, CheckpointError: bad cameras, conditions, or run directory; no image shows anything of
        the model.
        BackendUnavailable: a format whose package is missing.
    """
    config, task, model, header = load_run(run_dir)
    world = World.of(header, str(run_dir)) if space == WORLD else World()
    task = task if space == WORLD else task_of(config, run_dir / "config.yaml")
    point = parse_render_config(words, config.renderer, model)
    suspects = suspects_of(config)
    watch = suspects.watch(run_dir / LOGS)
    background = torch.tensor([float(x) for x in header.get("background", [0.0] * model.colour.channels)])
    channels = stored_channels(run_dir, header, task, model.colour.channels)
    lights: Sequence[Conditions] = ()
    if environment is not None:
        with watch:
            around = _illumination(environment, config, task, header, conditions)
        lights = around.frames(environment.guesses)
        if not lights:
            raise ConfigError(
                f"--environment-unseen drop: all light of {environment.path} comes from where the model never saw any"
            )
        hint = " (--environment-unseen drop leaves it out)" if environment.guesses and any(around.guessed) else ""
        for note in around.notes:
            tell(f"{environment.path}: {note}{hint}")
    if camera not in SETS:
        file = read_camera_file(Path(camera), size)
        for note in file.notes:
            tell(f"{camera}: {note}")
        views, fps = _views_of(file, task, conditions), fps or file.fps
        views = [replace(v, camera=world.scene_camera(v.camera)) for v in views]
    else:
        dataset = load_dataset(config, task, run_dir=run_dir)
        suspects.know(dataset)
        with watch:
            views = (
                orbit_of(task, dataset, frames)
                if camera == "orbit"
                else [dataset.test.view(i) for i in range(len(dataset.test))]
            )
    if size is not None:
        views = [replace(v, camera=v.camera.resized(*size)) for v in views]
    if lights:  # these replace the views' own; the first stands for all where only their presence counts
        views = [replace(v, conditions={**v.conditions, **lights[0]}) for v in views]
    with watch:
        views, animated = with_conditions(views, task, conditions, tell)
        model = point.prepare_model(model)
    model = placed(model, point.settings, views[0])
    format = format or _format_of(out, animated)
    for flag_given, value in (("--layers", layers), ("--datatype", datatype)):
        if value is not None and format != "exr":
            raise ConfigError(f"{flag_given} {value}: of OpenEXR files; expected --format exr, found {format}")
    layered = (
        Layers(run_dir, task, channels, point, background, layers, datatype == "half", lights, world)
        if format == "exr"
        else None
    )
    if channels.partial and format not in _RAW:
        tell(f"shown: {channels.shown}; --format exr and npy hold all channels")

    single = out is not None and out.suffix.lower() == f".{format}"
    name = _file_name(Path(camera.partition("#")[0]).resolve().stem)
    folder = (
        out if out is not None and not single else run_dir / "frames" / name
    )  # "renders" holds the report's pictures
    animate = format in ANIMATIONS and len(views) > 1
    if single and len(views) > 1 and not animate:
        raise ConfigError(
            f"--out {out}: {len(views)} views do not fit one .{format} file; give a folder, or --format webp for an animation"
        )
    if animate:
        targets = [out if single and out is not None else folder.with_suffix(f".{format}")]
    else:
        targets = [out if single and out is not None else folder / f"{name}.{format}" for name in _file_names(views)]
    if not overwrite:
        refuse_results(run_dir, targets)
    for target in targets:
        target.parent.mkdir(parents=True, exist_ok=True)
    done = 0
    full = [False] * len(views)

    each = max(len(lights), 1)

    def drawn(alpha: torch.Tensor) -> None:
        nonlocal done
        full[done // each] |= bool((alpha > 0).any())
        done += 1
        progress(f"view {done // each + (done % each > 0)} of {len(views)}", done / (each * len(views)))

    def image(view: View) -> torch.Tensor:
        with watch:
            if lights:
                return point.upsample(
                    draw_sum(model, point.scale_view(view), lights, point.settings, background, drawn), view.camera
                )
            return point.render_view(model, view, background, drawn)

    def refuse_empty() -> None:
        """Rule: an image that shows nothing of the model is told, and a shot of such images is an error."""
        empty = [view for view, some in zip(views, full, strict=True) if not some]
        if not empty:
            return
        where = _apart(model, empty[0], world)
        if len(empty) < len(views):
            tell(f"warning: {len(empty)} of {len(views)} images are empty, first {empty[0].name}: {where}")
            return
        hint = (
            ""
            if camera in SETS or space == SCENE
            else "; a file's cameras are in the units of the run's data, or of the model with --space scene"
        )
        raise DataError(f"--camera {camera}: all {len(views)} images are empty: {where}{hint}")

    if animate:
        stack = [channels.display(image(v)) for v in views]
        refuse_empty()
        write_animation(targets[0], stack, fps or min(30.0, max(len(views) / 4.0, 5.0)))
        return targets
    for v, path in zip(views, targets, strict=True):
        if layered is None:
            _write(path, format, image(v), channels, fps)
        else:
            with watch:
                layered.write(path, model, v, drawn)
    try:
        refuse_empty()
    except DataError:
        for path in targets:
            path.unlink()
        raise
    return targets


def _apart(model: Primitives, view: View, world: World) -> str:
    """Where the model is and where a camera looks that does not see it, in words."""
    with torch.no_grad():
        geometry, _ = model.lower_density(view.conditions)
    if not geometry.count:
        return "no primitive is there under these conditions"
    means, reach = geometry.means.double().cpu(), geometry.scales.double().cpu().amax(1, keepdim=True)
    low, high = world.world_box(torch.stack([(means - reach).min(0).values, (means + reach).max(0).values]).numpy())
    seen = world.world_camera(view.camera)
    at, towards = seen.position.tolist(), seen.viewmat[2, :3].tolist()
    return f"the model is within {_point(low)} to {_point(high)}, and {view.name} at {_point(at)} looks towards {_point(towards)}"


def _point(numbers: Sequence[float]) -> str:
    return "(" + ", ".join(f"{x:.7g}" for x in numbers) + ")"


def _write(path: Path, format: str, pixels: torch.Tensor, channels: Channels, fps: float | None) -> None:
    """One image: all channels as the data set has them in npy, or what its channels look like."""
    if format == "npy":
        write_npy(path, pixels.contiguous().numpy())
    elif format == "png":
        images.write_png(path, channels.display(pixels))
    elif format == "webp":
        images.write_webp(path, channels.display(pixels))
    else:
        write_animation(path, [channels.display(pixels)], fps or 12.0)


def _views_of(file: CameraViews, task: TaskSpec, conditions: Mapping[str, str]) -> list[View]:
    """A view per camera; each at its own time where the file has times, the task has one, and the user gave no
    other."""
    timed = (
        file.times is not None
        and _TIME not in conditions
        and any(spec.name == _TIME and not spec.shape for spec in task.conditions)
    )
    times = [{_TIME: torch.tensor(time)} for time in file.times or ()] if timed else [{} for _ in file.named]
    return [View(name, camera, time) for (name, camera), time in zip(file.named, times, strict=True)]


def _illumination(
    choice: EnvironmentFile, config: RunConfig, task: TaskSpec, header: Mapping[str, Any], conditions: Mapping[str, str]
) -> Illumination:
    """The frames that stand for an environment."""
    if task.environment is None:
        raise ConfigError(f"--environment {choice.path}: task {task.name!r} has no light that it could replace")
    facts = header.get("data")
    if facts is None:  # written before models kept them
        facts = facts_of(task, load_dataset(config, task))
    if not isinstance(facts, dict):
        raise DataError(f"the model's header: data is {type(facts).__name__}; expected an object")
    up = JsonReader(facts, "the model's header: data").array("up", (3,), "3 numbers")
    found = task.environment(read_environment(choice.path, up, choice.rotation, choice.scale), choice.samples, facts)
    clash = sorted(conditions.keys() & found.conditions[0].keys())
    if clash:
        raise ConfigError(f"{flag(clash[0])} and --environment: give one of them")
    return found


def _format_of(out: Path | None, animated: bool) -> str:
    suffix = "" if out is None else out.suffix.lower().removeprefix(".")
    return suffix if suffix in FORMATS else "webp" if animated else "png"


def with_conditions(
    views: list[View], task: TaskSpec, texts: Mapping[str, str], warn: Callable[[str], None] = lambda text: None
) -> tuple[list[View], bool]:
    """Views with the conditions the user gave, and whether one of these is animated. Animated conditions go along
    together, frame by frame; where there are more frames than cameras, or the other way round, the fewer are spread
    evenly over the more.

    Raises:
        ConfigError: a view lacks a condition that the task needs, or as
        :func:`neuprim.core.conditions.read_conditions`.
    """
    given = read_conditions(task.conditions, texts, warn)
    frames = in_step(texts, given)
    if frames > 1:
        count = max(frames, len(views))
        names = f"{{}}_{{:0{max(3, len(str(count - 1)))}d}}"
        views = [
            replace(views[i * len(views) // count], name=names.format(views[i * len(views) // count].name, i))
            for i in range(count)
        ]
    moments = [
        {name: values[i * len(values) // len(views)] for name, values in given.items()} for i in range(len(views))
    ]
    views = [replace(v, conditions={**v.conditions, **moment}) for v, moment in zip(views, moments, strict=True)]
    for spec in task.conditions:
        for v in views:
            if spec.name not in v.conditions:
                raise ConfigError(
                    f"view {v.name} has no {spec.name}, which task {task.name!r} needs; give {flag(spec.name)}"
                )
    return views, frames > 1


def _file_names(views: Sequence[View]) -> list[str]:
    """Of each view, with its number where two would share a file."""
    names = [_file_name(v.name) for v in views]
    return (
        names
        if len({name.lower() for name in names}) == len(names)
        else [f"{i:03d}_{name}" for i, name in enumerate(names)]
    )


def _file_name(name: str) -> str:
    return "".join(c if c.isalnum() or c in "-_." else "_" for c in name)
