"""Render images of a finished run: its held-out views, an orbit, or given cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor

from neuprim.core.cameras.camera_files import read_camera_file
from neuprim.core.cameras.pinhole import CameraViews
from neuprim.core.cameras.world import World
from neuprim.core.channels import read_stored_channels
from neuprim.core.conditions import (
    check_file_condition,
    condition_flag,
    count_condition_frames,
    frames_to_times,
    read_conditions,
)
from neuprim.core.data import View
from neuprim.core.environment import EnvironmentFile, Illumination, read_environment
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io import images
from neuprim.core.io.files import write_npy
from neuprim.core.io.images import write_animation
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.model.fields import Conditions
from neuprim.core.task import TaskSpec
from neuprim.plugins.attribution import call_task_facts, call_task_orbit
from neuprim.runs.color_space import load_output_color_space
from neuprim.runs.measure import render_light_sum
from neuprim.runs.open import StoredRun, load_dataset, load_run, move_to_render_device, refuse_run_results
from neuprim.runs.render_config import RunExrLayers, parse_run_rendering
from neuprim.runs.shutter import choose_shutter, mean_in_linear_light

__all__ = ["RenderRequest", "render_run"]

SPACES = WORLD, SCENE = ("world", "scene")
"""Values of ``--space``: the coordinates of cameras in a file."""

SETS = ("orbit", "test")
"""Values of ``--camera`` that select cameras of the run."""

ANIMATIONS = ("webp", "gif", "mp4")
FORMATS = ("png", "exr", "npy", *ANIMATIONS)
"""Formats that ``neuprim render`` writes. npy holds all channels unchanged, and EXR holds all channels as linear
light. The other formats hold the displayed image."""


@dataclass(frozen=True)
class RenderRequest:
    """Request for :func:`render_run`, with the arguments of ``neuprim render``.

    Attributes:
        camera: "orbit", "test" (the held-out views) or a file of cameras.
        size: (width, height) in pixels; None for the size of the cameras.
        format: "png", "exr", "npy", "webp", "gif" or "mp4". None: the suffix of ``out`` decides; otherwise views that
            differ in a condition become a WebP animation and others PNGs.
        out: file or folder to write; None for a folder in the run's ``frames``.
        frames: number of views of an orbit.
        conditions: name -> text, e.g. ``{"time": "0:1"}``.
        fps: frames per second of an animation, also written to OpenEXR headers; None for the rate in the file of
            cameras. Without any rate, an animation takes about four seconds, and headers state no rate.
        environment: environment map that replaces the task's light.
        overrides: render settings, see :class:`~neuprim.runs.render_config.RenderConfig`.
        layers: layers of an OpenEXR file, separated by commas; None for all layers except those of single lights.
        colorspace: name of an OpenColorIO colour space for layers of light in OpenEXR files; None: linear Rec. 709.
        datatype: type of alpha and layers of light in OpenEXR files: "half" (16 bits) or "float" (32 bits, default).
        compression: compression of OpenEXR files: "zip" (default) and "piz" are lossless, "dwaa" is not.
        crop: whether OpenEXR files store only the pixels around the visible part of the model (the data window).
        deep: largest number of samples of a pixel in deep OpenEXR files; None: write flat files.
        space: coordinates of cameras in files, lights and depths: "world" (coordinates of the data's files) or "scene"
            (coordinates of the model).
        overwrite: whether to replace pictures of the run's report.
        frame: numbers of source frames to render, e.g. "1001-1048x2", for volumes; they replace the condition "time"
            and appear in file names.
        shutter: motion blur: part of the interval between two frames in which the shutter is open, centred on each
            frame; None for none. See :class:`~neuprim.runs.shutter.Shutter`.
        shutter_samples: number of sub-frames of each image with motion blur.
    """

    camera: str
    size: tuple[int, int] | None = None
    format: str | None = None
    out: Path | None = None
    frames: int = 60
    conditions: Mapping[str, str] = field(default_factory=dict)
    fps: float | None = None
    environment: EnvironmentFile | None = None
    overrides: Sequence[str] = ()
    layers: str | None = None
    datatype: str | None = None
    colorspace: str | None = None
    compression: str | None = None
    crop: bool = False
    deep: int | None = None
    space: str = WORLD
    overwrite: bool = False
    frame: str | None = None
    shutter: float | None = None
    shutter_samples: int = 8


def render_run(
    run: Path | StoredRun,
    request: RenderRequest,
    notify: Callable[[str], None] = lambda text: None,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
) -> list[Path]:
    """Render images of a run as one file per view, or as one animation; return the files.

    Args:
        notify: function that is called with lines for the user, e.g. about conditions outside the training range.
        progress: function that is called with (text, fraction 0..1).

    Raises:
        NeuprimError: cameras, conditions or run directory are wrong, or the model is in none of the images.
        BackendUnavailable: a package that the file format needs is missing.
    """
    run = load_run(run)
    session = _RunRenderSession(run, request, notify, progress)
    targets = session.choose_targets()
    if not request.overwrite:
        refuse_run_results(run.directory, targets)
    for target in targets:
        target.parent.mkdir(parents=True, exist_ok=True)
    if session.animate:
        session.write_animation(targets[0])
    else:
        session.write_images(targets)
    return targets


class _RunRenderSession:
    """State of one :func:`render_run` call: the loaded run, the model to render, and the views and lights to render."""

    def __init__(
        self,
        run: StoredRun,
        request: RenderRequest,
        notify: Callable[[str], None],
        progress: Callable[[str, float], None],
    ) -> None:
        self.run, self.request, self.notify, self.progress = run, request, notify, progress
        channels, in_world = run.model.colour.channels, request.space == WORLD
        self.world = run.world if in_world else World()
        self.task = run.task if in_world else run.scene_task
        self.render_config = parse_run_rendering(request.overrides, run.config.renderer, run.model)
        self.background = torch.tensor([float(x) for x in run.header.get("background", [0.0] * channels)])
        self.channels = read_stored_channels(run.directory, run.header, self.task, channels)
        self.lights = () if request.environment is None else self._load_lights(request.environment)
        self._file: CameraViews | None = None  # None: the cameras are of the run
        self.views, self.fps = self._load_views()
        with run.plugins.attribute_errors():
            numbers, conditions = self._choose_frames()
            self.views = self._views_of_frames(numbers)
            self.views, animated = set_run_view_conditions(self.views, self.task, conditions, notify)
            if numbers:
                self.views = _name_views_by_frame(self.views, numbers, self._camera_name())
            model = self.render_config.prepare_model(run.model)
        self.shutter = None
        if request.shutter is not None:
            blur = (request.shutter, request.shutter_samples)
            self.shutter = choose_shutter(*blur, self.task.conditions, run.header, self.views)
        self.model = move_to_render_device(model, self.render_config.settings, self.views[0])
        suffix = "" if request.out is None else request.out.suffix.lower().removeprefix(".")
        usual = suffix if suffix in FORMATS else "webp" if animated else "png"
        self.format = request.format or usual
        self.animate = self.format in ANIMATIONS and len(self.views) > 1
        for option, value in (
            ("--layers", request.layers),
            ("--datatype", request.datatype),
            ("--colorspace", request.colorspace),
            ("--compression", request.compression),
            ("--crop", request.crop or None),
            ("--deep", request.deep),
        ):
            if value is not None and self.format != "exr":
                text = option if value is True else f"{option} {value}"
                raise ConfigError(f"{text}: only for OpenEXR; expected --format exr, found {self.format}")
        half, drawn = request.datatype == "half", (self.channels, self.render_config, self.background)
        layers = RunExrLayers(run.directory, self.task, *drawn, request.layers, half, self.lights, self.world, self.fps)
        colors = None if request.colorspace is None else load_output_color_space(request.colorspace)
        layers = replace(layers, compression=request.compression or "zip", crop=request.crop, deep=request.deep)
        layers = replace(layers, shutter=self.shutter, color_space=colors)
        self.layers = layers if self.format == "exr" else None
        if self.channels.hides_channels and self.format not in ("exr", "npy"):
            notify(f"shown: {self.channels.display_text}; --format exr and npy hold all channels")
        self._passes = 0  # images so far, as _count_pass counts them
        self._visible: list[bool] = []  # whether the image of each view so far shows the model

    def _load_lights(self, environment: EnvironmentFile) -> Sequence[Conditions]:
        """Return each light's conditions. Images under these lights add up to the image under the environment map."""
        with self.run.plugins.attribute_errors():
            illumination = self._illuminate(environment)
        lights = illumination.frames(environment.guesses)
        if not lights:
            raise ConfigError(
                f"--environment-unseen drop: all light of {environment.path} comes from directions unseen in training"
            )
        guessed = environment.guesses and any(illumination.guessed)
        hint = " (--environment-unseen drop leaves it out)" if guessed else ""
        for note in illumination.notes:
            self.notify(f"{environment.path}: {note}{hint}")
        return lights

    def _illuminate(self, environment: EnvironmentFile) -> Illumination:
        if self.task.environment is None:
            raise ConfigError(
                f"--environment {environment.path}: task {self.task.name!r} has no light that it could replace"
            )
        facts = self.run.header.get("data")
        if facts is None:  # a model of an imported file has none
            facts = call_task_facts(self.task, load_dataset(self.run))
        if not isinstance(facts, dict):
            raise DataError(f"the model's header: data is {type(facts).__name__}; expected an object")
        up = JsonReader(facts, "the model's header: data").array("up", (3,), "3 numbers")
        image = read_environment(environment.path, up, environment.rotation, environment.scale)
        illumination = self.task.environment(image, environment.samples, facts)
        clash = sorted(self.request.conditions.keys() & illumination.conditions[0].keys())
        if clash:
            raise ConfigError(f"{condition_flag(clash[0])} and --environment: give only one of these flags")
        return illumination

    def _load_views(self) -> tuple[list[View], float | None]:
        """Return the views to render, in the model's coordinates, and the frames per second; None if not stated."""
        request, fps = self.request, self.request.fps
        if request.camera not in SETS:
            file = self._file = read_camera_file(Path(request.camera), request.size)
            for note in file.notes:
                self.notify(f"{request.camera}: {note}")
            typed = request.conditions if request.frame is None else {**request.conditions, "time": request.frame}
            views = _run_views_of_camera_file(file, self.task, typed, request.camera, self.notify)
            fps = fps or file.fps
            views = [replace(view, camera=self.world.scene_camera(view.camera)) for view in views]
        else:
            dataset = load_dataset(self.run)
            with self.run.plugins.attribute_errors():
                if request.camera == "orbit":
                    views = list(call_task_orbit(self.task, dataset, request.frames))
                else:
                    views = [dataset.test.view(i) for i in range(len(dataset.test))]
        if request.size is not None:
            views = [replace(view, camera=view.camera.resized(*request.size)) for view in views]
        if self.lights:  # they replace the views' own; where only the presence matters, the first is used
            views = [replace(view, conditions={**view.conditions, **self.lights[0]}) for view in views]
        return views, fps

    def _views_of_frames(self, numbers: Sequence[int]) -> list[View]:
        """Return the views to render at the frames of ``--frame``: all views if their number fits, or one per frame.

        The time codes of a USD stage are frame numbers. Raises ConfigError if cameras of a file match no frames.
        """
        views, file, count = self.views, self._file, len(numbers)
        if file is None:
            return [views[i * len(views) // count] for i in range(count)] if 1 < count < len(views) else views
        at = {math.floor(code + 0.5): view for code, view in zip(file.codes or (), views, strict=False)}
        if numbers and all(number in at for number in numbers):
            return [at[number] for number in numbers]
        if len(views) == 1 or count in (0, len(views)) or (count == 1 and not at):
            return views
        known = f" (of frames {min(at)} to {max(at)})" if at else ""
        raise ConfigError(
            f"--frame {self.request.frame}: {count} {'frame' if count == 1 else 'frames'}, but {self.request.camera} "
            f"has {len(views)} cameras{known}; expected {'frames in that range' if at else 'one frame'}, or as many "
            "frames as cameras"
        )

    def _camera_name(self) -> str:
        return _view_file_names([Path(self.request.camera.partition("#")[0]).resolve().stem])[0]

    def _choose_frames(self) -> tuple[list[int], Mapping[str, str]]:
        """Return the source frame numbers that ``--frame`` names, and the texts of options such as ``--time``.

        With ``--frame``, the text of ``--time`` lists the times of these frames. Without ``--frame``, return no
        numbers, and the texts as the user gave them.
        """
        text, conditions = self.request.frame, self.request.conditions
        if text is None:
            return [], conditions
        return frames_to_times(text, conditions, self.run.header)

    def choose_targets(self) -> list[Path]:
        """Return the files to write, one per view or one for an animation."""
        out, suffix = self.request.out, f".{self.format}"
        single = out is not None and out.suffix.lower() == suffix
        if single and len(self.views) > 1 and not self.animate:
            raise ConfigError(
                f"--out {out}: {len(self.views)} views do not fit one {suffix} file; "
                "give a folder, or --format webp for an animation"
            )
        if single and out is not None:
            return [out]
        name = self._camera_name()
        # "renders" holds the report's pictures
        folder = self.run.directory / "frames" / name if out is None else out
        if self.animate:  # only the suffix of an animation is replaced: shot.v001 becomes shot.v001.webp
            stem = folder.stem if folder.suffix.lower().removeprefix(".") in ANIMATIONS else folder.name
            return [folder.with_name(stem + suffix)]
        return [folder / f"{name}{suffix}" for name in _view_file_names([view.name for view in self.views])]

    def write_animation(self, path: Path) -> None:
        stack = [self.channels.display(self._render_pixels(view)) for view in self.views]
        self._report_empty_images()
        write_animation(path, stack, self.fps or min(30.0, max(len(self.views) / 4.0, 5.0)))

    def write_images(self, paths: Sequence[Path]) -> None:
        for view, path in zip(self.views, paths, strict=True):
            if self.layers is None:
                self._write_image(path, self._render_pixels(view))
            else:
                self._visible.append(False)
                with self.run.plugins.attribute_errors():
                    self.layers.write(path, self.model, view, self._count_pass)
        try:
            self._report_empty_images()
        except DataError:
            for path in paths:
                path.unlink()
            raise

    def _write_image(self, path: Path, pixels: Tensor) -> None:
        """Write one image: npy files hold the data set's channels unchanged, other formats the displayed image."""
        shown = pixels if self.format == "npy" else self.channels.display(pixels)
        if self.format == "npy":
            write_npy(path, shown.contiguous().numpy())
        elif self.format in ("png", "webp"):
            (images.write_png if self.format == "png" else images.write_webp)(path, shown)
        else:
            write_animation(path, [shown], self.fps or 12.0)

    def _render_pixels(self, view: View) -> Tensor:
        self._visible.append(False)
        if self.shutter is None:
            return self._render_sub_frame(view)
        sub_frames = (self._render_sub_frame(moment) for moment in self.shutter.sub_frames(view))
        return mean_in_linear_light(sub_frames, self.channels.color_space)

    def _render_sub_frame(self, view: View) -> Tensor:
        config = self.render_config
        with self.run.plugins.attribute_errors():
            if not self.lights:
                return config.render_view(self.model, view, self.background, self._count_pass)
            small = config.scale_view(view)
            image = render_light_sum(self.model, small, self.lights, config.settings, self.background, self._count_pass)
            return config.upsample(image, view.camera)

    def _count_pass(self, alpha: Tensor) -> None:
        """Count a rendered image, note whether its ``alpha`` shows the model, and report the progress.

        There is one image for each view, sub-frame of motion blur and light.
        """
        each, count = max(len(self.lights), 1) * (self.shutter.samples if self.shutter else 1), len(self.views)
        self._visible[-1] |= bool((alpha > 0).any())
        self._passes += 1
        self.progress(f"view {-(-self._passes // each)} of {count}", self._passes / (each * count))

    def _report_empty_images(self) -> None:
        """Name the images that do not show the model; raise DataError if no image shows it.

        The error states the model's box and the first camera's pose.
        """
        if any(self._visible):
            names = _view_file_names([view.name for view in self.views])
            empty = [name for name, visible in zip(names, self._visible, strict=True) if not visible]
            if empty:
                listed = ", ".join(empty[:8]) + (", ..." if len(empty) > 8 else "")
                self.notify(f"{len(empty)} of {len(names)} images are empty: {listed}")
            return
        view, where = self.views[0], "no primitive is there under these conditions"
        with torch.no_grad():
            geometry, _ = self.model.lower_density(view.conditions)
        if geometry.count:
            means, reach = geometry.means.double().cpu(), geometry.scales.double().cpu().amax(1, keepdim=True)
            corners = torch.stack([(means - reach).min(0).values, (means + reach).max(0).values])
            camera = self.world.world_camera(view.camera)
            low, high = self.world.world_box(corners.numpy())
            points = low, high, camera.position.tolist(), camera.viewmat[2, :3].tolist()
            start, end, at, towards = ("(" + ", ".join(f"{x:.7g}" for x in point) + ")" for point in points)
            where = f"the model is within {start} to {end}, and {view.name} at {at} looks towards {towards}"
        raise DataError(
            f"--camera {self.request.camera}: all {len(self.views)} images are empty: {where}; expected cameras "
            f"in the coordinates of the run's data; add --space scene if they are in scene coordinates"
        )


def _run_views_of_camera_file(
    file: CameraViews,
    task: TaskSpec,
    conditions: Mapping[str, str],
    path: str,
    warn: Callable[[str], None] = lambda text: None,
) -> list[View]:
    """Return one view per camera in the file, with the file's time if the task has a time and the user gave none."""
    spec = next((spec for spec in task.conditions if spec.name == "time" and not spec.shape), None)
    if spec is None or file.times is None or "time" in conditions:
        return [View(name, camera, {}) for name, camera in file.named]
    times = check_file_condition(spec, f"{path}: time", file.times, warn)
    return [View(name, camera, {"time": time}) for (name, camera), time in zip(file.named, times, strict=True)]


def set_run_view_conditions(
    views: list[View], task: TaskSpec, texts: Mapping[str, str], warn: Callable[[str], None] = lambda text: None
) -> tuple[list[View], bool]:
    """Return the views with the conditions (e.g. time) that the user typed, and whether a condition is animated.

    All animated conditions advance together, frame by frame. If there are fewer cameras than frames, cameras are
    repeated evenly. If there are fewer frames than cameras, frames are repeated evenly.

    Raises:
        ConfigError: a view lacks a condition that the task needs, or a text is refused by
        :func:`neuprim.core.conditions.read_conditions`.
    """
    given = read_conditions(task.conditions, texts, warn)
    frames = count_condition_frames(texts, given)
    if frames > 1:
        count = max(frames, len(views))
        digits = max(3, len(str(count - 1)))
        chosen = [views[i * len(views) // count] for i in range(count)]
        views = [replace(view, name=f"{view.name}_{i:0{digits}d}") for i, view in enumerate(chosen)]
    animated = []
    for i, view in enumerate(views):
        moment = {name: values[i * len(values) // len(views)] for name, values in given.items()}
        animated.append(replace(view, conditions={**view.conditions, **moment}))
    for spec in task.conditions:
        for view in animated:
            if spec.name not in view.conditions:
                raise ConfigError(
                    f"view {view.name} has no {spec.name}, which task {task.name!r} needs; "
                    f"give {condition_flag(spec.name)}"
                )
    return animated, frames > 1


def _name_views_by_frame(views: Sequence[View], numbers: Sequence[int], name: str) -> list[View]:
    """Name views after the frames that they show, e.g. ``NAME.1001``, as compositing programs expect."""
    shown = (numbers[i * len(numbers) // len(views)] for i in range(len(views)))
    return [replace(view, name=f"{name}.{number:04d}") for view, number in zip(views, shown, strict=True)]


def _view_file_names(names: Sequence[str]) -> list[str]:
    """Return a file name for each view; the names are numbered if two views would have the same one."""
    names = ["".join(c if c.isalnum() or c in "-_." else "_" for c in name) for name in names]
    if len({name.lower() for name in names}) == len(names):
        return list(names)
    return [f"{i:03d}_{name}" for i, name in enumerate(names)]
