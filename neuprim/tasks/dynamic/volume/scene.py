"""Load volume scenes (``scene=smoke_fire`` and others): OpenVDB files, given or simulated, as a dataset."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch

from neuprim.core.data import Dataset, DataSource
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.store import Store, open_store
from neuprim.core.io.vdb import sequence
from neuprim.core.notices import warn_once
from neuprim.core.task import Chunks, SceneContext
from neuprim.core.validation import Accepts, Range, coerce, nonempty_text, validate, validate_fields
from neuprim.core.volumes.source import Extent
from neuprim.scenes.smoke.generate import TIMESTEPS, Resolution, simulate_smoke
from neuprim.tasks.dynamic.volume.capture import Capture, RenderedFrames, hemisphere_cameras
from neuprim.tasks.dynamic.volume.chunks import count_chunks, plan_chunks
from neuprim.tasks.dynamic.volume.dataset import TRAINING_MEMORY, TrainingFrames, total_extinction, volume_dataset
from neuprim.tasks.dynamic.volume.ground_truth import CaptureSource
from neuprim.tasks.dynamic.volume.optics import (
    DATA_DEPENDENT,
    UP_AXES,
    Axis,
    GridMeaning,
    Optics,
    optics_preset,
    override_optics,
)
from neuprim.tasks.dynamic.volume.survey import Normalisation, data_dependent_optics, find_grids, survey_frames

# ---------------------------------------------------------------- settings


def _frame_range(frames: str) -> range | None:
    """The numbers of "FIRST:LAST" or "FIRST:LAST:STEP", LAST included; None for text of another form."""
    match = re.fullmatch(r"(\d{1,9}):(\d{1,9})(?::(\d{1,9}))?", frames)
    if match is None or (step := int(match[3] or 1)) < 1 or int(match[1]) > int(match[2]):
        return None
    return range(int(match[1]), int(match[2]) + 1, step)


Span = Annotated[str, Accepts(lambda v: v.count(":") == 1 and _frame_range(v) is not None, "FIRST:LAST, as 0:19")]
Frames = Annotated[
    str, Accepts(lambda v: v == "all" or _frame_range(v) is not None, "all, FIRST:LAST or FIRST:LAST:STEP, as 0:100:2")
]


@dataclass(frozen=True)
class VolumeSettings:
    """Settings of a volume scene.

    Attributes:
        vdb: folder of .vdb files, or None to simulate.
        simulation: name of the built-in simulation; ``resolution``: voxels across its box; ``timesteps``: None: all.
        frames: "all", "FIRST:LAST" or "FIRST:LAST:STEP" by number, LAST included.
        span: "FIRST:LAST" by number, the frames for training and evaluation; times, box, exposure and images stay those
            of all ``frames``. None: all.
        chunks: number of chunks of time, each trained in its own run; "auto": see
            :func:`~neuprim.tasks.dynamic.volume.chunks.count_chunks`; None or 1: one run.
        grids: meaning -> name in the files.
        look: name of a preset of the optics, or "auto"; ``optics``: changes to the preset's settings.
        size: width and height of the images in pixels; ``samples``: rays per pixel side.
        cameras: on the upper hemisphere; two are held out. ``field_of_view``: degrees.
        train_every: train on every n-th frame only; the test views keep all.
        up: "y" or "z", the upward axis of the files.
        cache: folder or URL where the ground truth is stored; None: the user's cache on this machine.
        memory: MiB of decoded images and voxels in memory; others are read again when needed.
    """

    vdb: Annotated[Path, nonempty_text("a folder of .vdb files")] | None = None
    simulation: str | None = None
    resolution: Resolution = 64
    timesteps: Annotated[int, Range(2, TIMESTEPS[1])] | None = None
    frames: Frames = "all"
    span: Span | None = None
    chunks: Annotated[int, Range(1, 1000)] | Literal["auto"] | None = None
    grids: Mapping[GridMeaning, Annotated[str, nonempty_text("the name of a grid")]] = field(default_factory=dict)
    look: str = "auto"
    optics: Mapping[str, Any] = field(default_factory=dict)
    size: Annotated[int, Range(8, 4096)] = 160
    cameras: Annotated[int, Range(4, 1000)] = 40
    field_of_view: Annotated[float, Range(1, 120, says="degrees from 1 to 120")] = 27.0
    samples: Annotated[int, Range(1, 16)] = 2
    train_every: Annotated[int, Range(1, 1000)] = 1
    up: Axis = "z"
    cache: Annotated[str, nonempty_text("a folder, or a URL as s3://BUCKET/FOLDER")] | None = None
    memory: Annotated[int, Range(1, 2**20)] = 1408

    def __post_init__(self) -> None:
        validate_fields(self, "scene")
        if self.vdb is None and self.simulation is None:
            raise ConfigError("scene.vdb: required and not given; expected a folder of .vdb files")
        if self.span is not None and self.chunks is not None:
            raise ConfigError(
                f"scene.chunks={self.chunks}: chunks are spans of all chosen frames; "
                "expected no scene.span beside it, but scene.frames"
            )

    @property
    def memory_bytes(self) -> float:
        return self.memory * 2.0**20

    def resolve_optics(self, has_density: bool = True) -> Optics:
        """The preset with the user's changes; "auto" is for files with a density, or those whose hot gas absorbs.

        Raises:
            ConfigError: no such preset or setting, or an impossible value.
        """
        automatic = "smoke_fire" if has_density else "embergen_fire"
        preset = optics_preset(automatic if self.look == "auto" else self.look, self.up)
        return override_optics(preset, self.optics)


def choose_frames(frames: str, numbers: Sequence[int], where: str = "the sequence") -> list[int]:
    """Those of the ascending ``numbers`` of a sequence that ``scene.frames`` names.

    Raises:
        ConfigError: another form than "all", "FIRST:LAST" or "FIRST:LAST:STEP".
        DataError: none of the frames exists.
    """
    wanted = _frame_range(coerce(frames, Frames, "scene.frames"))
    if wanted is None:
        return list(numbers)
    chosen = [n for n in numbers if n in wanted]
    if numbers and not chosen:
        raise DataError(f"scene.frames={frames}: {where} has frames {numbers[0]} to {numbers[-1]}, and none of these")
    return chosen


# ---------------------------------------------------------------- loading


@dataclass(frozen=True)
class _PreparedScene:
    """Everything that is known before anything is rendered."""

    settings: VolumeSettings
    name: str
    source: DataSource
    capture: Capture
    held_out: range

    def span(self) -> tuple[int, int] | None:
        """First and last number of the chosen frames within ``scene.span``; None for all of them."""
        wanted = None if self.settings.span is None else _frame_range(self.settings.span)
        if wanted is None:
            return None
        numbers = [frame.number for frame in self.capture.frames if frame.number in wanted]
        if not numbers:
            begin, end = self.capture.clock
            raise DataError(
                f"scene.span={self.settings.span}: the chosen frames are {begin} to {end}, and none of these"
            )
        return numbers[0], numbers[-1]

    def rendered_frames(self, context: SceneContext) -> RenderedFrames:
        cache = self.settings.cache
        store = Store.local(context.cache_dir) if cache is None else open_store(cache, context.cache_dir / "copies")
        return RenderedFrames(self.capture, store)


def load_dataset(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load a volume scene: find or simulate files, survey them, render all cameras, store the images in the cache.

    Raises:
        ConfigError: unknown setting or impossible value.
        DataError: files that are missing, damaged, or without a usable grid; a cache that cannot be written.
    """
    scene = _prepare(settings, context)
    _report_chosen_extinctions(scene)
    span = scene.span()
    images = scene.rendered_frames(context).render_missing(context.progress)
    up = torch.tensor(UP_AXES[scene.settings.up], dtype=torch.float64)
    used = TrainingFrames(scene.settings.train_every, span, scene.settings.memory_bytes)
    return volume_dataset(scene.name, scene.source, scene.capture, images, scene.held_out, up, used)


def open_ground_truth(
    settings: Mapping[str, Any], context: SceneContext, known: Mapping[str, Any] | None = None
) -> RenderedFrames:
    """The scene's images as work to be done; raises as :func:`load_dataset`.

    Args:
        known: of the same scene's ground truth in another process, which has surveyed the files.
    """
    return _prepare(settings, context, known).rendered_frames(context)


def open_volumes(settings: Mapping[str, Any], context: SceneContext) -> CaptureSource:
    """The scene's files without any image; raises as :func:`load_dataset`."""
    scene = _prepare(settings, context)
    span = scene.span()
    return CaptureSource(scene.capture if span is None else scene.capture.within(*span))


def split_chunks(config: Mapping[str, Any], context: SceneContext) -> Chunks | None:
    """The chunks of ``scene.chunks``; None for one run. Renders all frames, as the chunks share one exposure.

    Raises:
        ConfigError: more chunks than the frames allow; and as :func:`load_dataset`.
    """
    scene = _prepare({name: value for name, value in config["scene"].items() if name != "name"}, context)
    options, capture = scene.settings, scene.capture
    frames, camera = len(capture.frames[:: options.train_every]), capture.cameras[0]
    views = frames * (len(capture.cameras) - len(scene.held_out))
    image_bytes = views * camera.width * camera.height * 4 * 2  # RGBA in half floats
    count = count_chunks(options.chunks, frames, image_bytes, options.memory_bytes * TRAINING_MEMORY)
    if count == 1:
        return None
    store = scene.rendered_frames(context).render_missing(context.progress)
    weight = partial(total_extinction, capture, store)
    return plan_chunks(capture, options.train_every, count, weight, config)


def _prepare(
    settings: Mapping[str, Any], context: SceneContext, known: Mapping[str, Any] | None = None
) -> _PreparedScene:
    options = validate(VolumeSettings, settings, "scene")
    options.resolve_optics()  # report typing errors before anything is simulated
    source: DataSource = "simulated" if options.vdb is None else "real"
    if options.vdb is not None:
        folder, name = options.vdb, options.vdb.name
    else:
        assert options.simulation is not None, "settings were checked"
        run = (options.simulation, options.timesteps, options.resolution, context.seed)
        folder = simulate_smoke(*run, context.cache_dir, context.progress)
        name = f"{options.simulation} (simulated)"
    files = sequence(folder).frames
    chosen = set(choose_frames(options.frames, [f.number for f in files], str(folder)))
    frames = [f for f in files if f.number in chosen]
    reader = find_grids(frames, {str(meaning): name for meaning, name in options.grids.items()})
    optics = options.resolve_optics("density" in reader.names)
    reader = reader.with_extinction(optics.extinction_grids, folder)
    measured: Mapping[int, Extent] = {}
    if known is None:
        survey = survey_frames(frames, reader, optics, context.progress)
        if not survey.hottest > 0:  # no flames in any frame: leave out everything that only flames need
            reader = dataclasses.replace(reader, names={m: n for m, n in reader.names.items() if m != "flames"})
        if source == "real":
            derived = data_dependent_optics(optics, reader.extinction, survey)
            changes = {key: value for key, value in derived.items() if key not in options.optics}
            optics = dataclasses.replace(optics, **changes)
        normalisation, measured = Normalisation.from_bounds(survey.box), survey.extents
        bounds = normalisation.to_scene(survey.box)
    else:
        derived = {key: known["look"][key] for key in DATA_DEPENDENT}
        low, high = derived["flame_range"]
        optics = dataclasses.replace(optics, **{**derived, "flame_range": (low, high)})
        reader = dataclasses.replace(reader, names=known["grids"])
        normalisation, bounds = Normalisation.from_json(known["normalisation"]), np.array(known["bounds"])
    train, test = hemisphere_cameras(options.size, options.cameras, up=options.up, field_of_view=options.field_of_view)
    cameras, device = [*train, *test], context.device
    capture = Capture(
        frames, reader, optics, cameras, options.samples, normalisation, bounds, device, measured=measured
    )
    return _PreparedScene(options, name, source, capture, range(len(train), len(train) + len(test)))


def _report_chosen_extinctions(scene: _PreparedScene) -> None:
    """Print one line with the extinctions that were chosen instead of the preset's."""
    capture = scene.capture
    preset = scene.settings.resolve_optics("density" in capture.reader.names)
    grids = {"extinction": capture.reader.extinction, "flame_extinction": "flames"}
    lines = []
    for key, meaning in grids.items():
        value, usual = getattr(capture.optics, key), getattr(preset, key)
        if value != usual:
            peak = f"values of grid {capture.reader.names[meaning]!r} go to about {usual / value:.2g}"
            lines.append(f"scene.optics.{key}={value:g} (look: {usual:g}), as {peak}")
    if lines:
        warn_once(f"{capture.frames[0].path.parent}: {'; '.join(lines)}. Set these to choose others")
