"""Load volume scenes (``scene=smoke_fire`` and others) from given or simulated OpenVDB files; split them into chunks.

A long sequence can be trained in chunks of time, each in its own run. Chunks divide the training frames evenly, in
order. Each chunk also contains a few frames beyond its ends, over which neighbouring chunks are blended
(:mod:`neuprim.tasks.dynamic.time_density`). All chunks use the times, box, cameras and exposure of the whole sequence,
so that the trained models can be joined without conversion.
"""

from __future__ import annotations

import itertools
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch

from neuprim.core.data import Dataset, DataSource
from neuprim.core.data.dataset import ChannelRange
from neuprim.core.errors import ConfigError, DataError, warn_once
from neuprim.core.io.store import Store, open_store
from neuprim.core.io.vdb import VdbFrame, list_vdb_files
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import Chunk, Chunks, SceneContext
from neuprim.core.validation import Accepts, Range, nonempty_text, validate_fields, validate_settings, validate_value
from neuprim.core.volumes.density_truth import GridExtent
from neuprim.scenes.smoke.smoke_scenes import MAX_TIMESTEPS, Resolution, simulate_smoke
from neuprim.tasks.dynamic.time_density import ChunkOverlaps, TimeDensity
from neuprim.tasks.dynamic.volume.capture import (
    Capture,
    CapturedVdbFrames,
    choose_rays_per_pixel,
    hemisphere_capture_cameras,
)
from neuprim.tasks.dynamic.volume.capture_dataset import (
    TRAINING_MEMORY,
    TrainingFrames,
    total_extinction_of_vdb_frame,
    volume_dataset,
)
from neuprim.tasks.dynamic.volume.capture_density import CaptureDensity
from neuprim.tasks.dynamic.volume.motion import find_velocity_grid
from neuprim.tasks.dynamic.volume.optics import (
    DATA_DEPENDENT,
    UP_AXES,
    Axis,
    GridMeaning,
    Optics,
    optics_preset,
    override_optics,
)
from neuprim.tasks.dynamic.volume.survey import (
    CaptureNormalisation,
    data_dependent_optics,
    find_volume_grids,
    measure_vdb_channels,
    survey_volume_frames,
)

# ---------------------------------------------------------------- settings


def _vdb_frame_range(frames: str) -> range | None:
    """Parse "FIRST:LAST" or "FIRST:LAST:STEP" to frame numbers, LAST included; None for other text."""
    match = re.fullmatch(r"(\d{1,9}):(\d{1,9})(?::(\d{1,9}))?", frames)
    if match is None or (step := int(match[3] or 1)) < 1 or int(match[1]) > int(match[2]):
        return None
    return range(int(match[1]), int(match[2]) + 1, step)


Span = Annotated[str, Accepts(lambda v: v.count(":") == 1 and _vdb_frame_range(v) is not None, "FIRST:LAST, e.g. 0:19")]
Frames = Annotated[
    str,
    Accepts(lambda v: v == "all" or _vdb_frame_range(v) is not None, "all, FIRST:LAST or FIRST:LAST:STEP, as 0:100:2"),
]


Channel = Annotated[str, Accepts(str.isidentifier, "the name of a grid, of letters, digits and underscores")]


@dataclass(frozen=True)
class VdbSceneSettings:
    """Settings of a volume scene.

    Attributes:
        vdb: folder of .vdb files, or None to simulate.
        simulation: name of a built-in simulation.
        resolution: voxels across the box of the simulation.
        timesteps: number of simulated time steps; None for all.
        frames: "all", "FIRST:LAST" or "FIRST:LAST:STEP" by number, LAST included.
        span: "FIRST:LAST" by number, the frames for training and evaluation; None for all. Times, box, exposure and
            images are still those of all ``frames``.
        chunks: number of time chunks, each trained in its own run; None or 1 for one run. For "auto" see
            :func:`count_time_chunks`.
        grids: meaning ("density", "flames", ...) -> name of the grid in the files.
        channels: names of grids in the files whose values the model also learns, e.g. the temperature or the velocity,
            to export them again.
        velocity: name of the grid of velocities with which primitives start; "auto" for a usual name; "none": at rest.
        look: name of a preset of the optics, or "auto".
        optics: changes to the preset's settings.
        size: width and height of the images in pixels.
        samples: n for n x n rays per pixel; None for 1 if pixels are narrower than voxels, else 2.
        cameras: number of cameras on the upper hemisphere; two cameras are held out.
        field_of_view: full angle, degrees.
        lights: number of directional lights per frame: the light of the look, then random lights. Each training camera
            sees a frame under one of these lights. With several lights, the light is a condition (an input) of the
            model; a single light is part of the colours.
        train_every: n: train on every n-th frame only. The test views have all frames.
        up: "y" or "z", the upward axis of the files.
        cache: folder or URL where the ground truth is stored; None for the user's cache on this machine.
        memory: limit on the decoded images and voxels in memory, MiB; beyond it, data are read again when needed.
    """

    vdb: Annotated[Path, nonempty_text("a folder of .vdb files, or one of them")] | None = None
    simulation: str | None = None
    resolution: Resolution = 64
    timesteps: Annotated[int, Range(2, MAX_TIMESTEPS)] | None = None
    frames: Frames = "all"
    span: Span | None = None
    chunks: Annotated[int, Range(1, 1000)] | Literal["auto"] | None = None
    grids: Mapping[GridMeaning, Annotated[str, nonempty_text("the name of a grid")]] = field(default_factory=dict)
    channels: tuple[Channel, ...] = ()
    velocity: Annotated[str, nonempty_text("the name of a grid, auto or none")] = "auto"
    look: str = "auto"
    optics: Mapping[str, Any] = field(default_factory=dict)
    size: Annotated[int, Range(8, 4096)] = 160
    cameras: Annotated[int, Range(4, 1000)] = 40
    field_of_view: Annotated[float, Range(1, 120, says="degrees from 1 to 120")] = 27.0
    samples: Annotated[int, Range(1, 16)] | None = None
    lights: Annotated[int, Range(1, 64)] = 1
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
                f"scene.chunks={self.chunks}: chunks cannot be combined with scene.span; "
                "choose the frames with scene.frames instead"
            )

    @property
    def memory_bytes(self) -> float:
        return self.memory * 2.0**20

    def resolve_optics(self, has_density: bool = True) -> Optics:
        """Return the optics: the preset with the user's changes.

        ``look="auto"`` selects "smoke_fire" for files with a density, else "embergen_fire", in which hot gas absorbs.

        Raises:
            ConfigError: a preset or setting does not exist, or a value is out of range.
        """
        automatic = "smoke_fire" if has_density else "embergen_fire"
        preset = optics_preset(automatic if self.look == "auto" else self.look, self.up)
        return override_optics(preset, self.optics)


def choose_volume_frames(frames: str, numbers: Sequence[int], where: str = "the sequence") -> list[int]:
    """Select the frames of ``scene.frames`` from the ascending frame ``numbers`` of a sequence.

    Raises:
        ConfigError: ``frames`` is not "all", "FIRST:LAST" or "FIRST:LAST:STEP".
        DataError: none of the frames exists.
    """
    wanted = _vdb_frame_range(validate_value(frames, Frames, "scene.frames"))
    if wanted is None:
        return list(numbers)
    chosen = [n for n in numbers if n in wanted]
    if numbers and not chosen:
        raise DataError(f"scene.frames={frames}: no such frame; {where} has frames {numbers[0]} to {numbers[-1]}")
    return chosen


# ---------------------------------------------------------------- loading


@dataclass(frozen=True)
class _PreparedVdbScene:
    """A volume scene before rendering: its settings, source, capture and held-out cameras."""

    settings: VdbSceneSettings
    name: str
    source: DataSource
    capture: Capture
    held_out: range

    def span_ends(self) -> tuple[int, int] | None:
        """Return first and last number of the frames within ``scene.span``; None if the user set no span."""
        wanted = None if self.settings.span is None else _vdb_frame_range(self.settings.span)
        if wanted is None:
            return None
        numbers = [frame.number for frame in self.capture.frames if frame.number in wanted]
        if not numbers:
            begin, end = self.capture.clock
            raise DataError(
                f"scene.span={self.settings.span}: no frame is in the span; "
                f"expected a part of the chosen frames, {begin} to {end}"
            )
        return numbers[0], numbers[-1]

    def rendered_frames(self, context: SceneContext) -> CapturedVdbFrames:
        cache = self.settings.cache
        store = Store.local(context.cache_dir) if cache is None else open_store(cache, context.cache_dir / "copies")
        return CapturedVdbFrames(self.capture, store)


def load_volume_scene(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load a volume scene: find or simulate .vdb files, measure them, render all cameras, store images in the cache.

    Raises:
        ConfigError: a setting is unknown, or a value is out of range.
        DataError: files are missing, damaged, or without a usable grid, or the cache cannot be written.
    """
    scene = _prepare_vdb_scene(settings, context)
    _report_chosen_optics(scene)
    span = scene.span_ends()
    images = scene.rendered_frames(context).render_missing(context.progress)
    up = torch.tensor(UP_AXES[scene.settings.up], dtype=torch.float64)
    used = TrainingFrames(scene.settings.train_every, span, scene.settings.memory_bytes)
    return volume_dataset(scene.name, scene.source, scene.capture, images, scene.held_out, up, used)


def open_captured_vdb_frames(
    settings: Mapping[str, Any], context: SceneContext, known: Mapping[str, Any] | None = None
) -> CapturedVdbFrames:
    """Prepare the images of a volume scene without rendering them; raises as :func:`load_volume_scene`.

    Args:
        known: facts about this scene from another process (:attr:`CapturedVdbFrames.known`), so that the files need not
            be measured again.
    """
    return _prepare_vdb_scene(settings, context, known).rendered_frames(context)


def open_volume_source(settings: Mapping[str, Any], context: SceneContext) -> CaptureDensity:
    """Open the .vdb files of a volume scene without rendering images; raises as :func:`load_volume_scene`."""
    scene = _prepare_vdb_scene(settings, context)
    span = scene.span_ends()
    return CaptureDensity(scene.capture if span is None else scene.capture.select_frames(*span))


def _prepare_vdb_scene(
    settings: Mapping[str, Any], context: SceneContext, known: Mapping[str, Any] | None = None
) -> _PreparedVdbScene:
    options = validate_settings(VdbSceneSettings, settings, "scene")
    options.resolve_optics()  # report typing errors before anything is simulated
    if options.vdb is not None:
        folder, name = options.vdb, (options.vdb if options.vdb.is_dir() else options.vdb.parent).name
    else:
        assert options.simulation is not None, "settings were checked"
        run = (options.simulation, options.timesteps, options.resolution, context.seed)
        folder = simulate_smoke(*run, context.cache_dir, context.progress)
        name = f"{options.simulation} (simulated)"
    files = list_vdb_files(folder).frames
    chosen = set(choose_volume_frames(options.frames, [f.number for f in files], str(folder)))
    frames = [f for f in files if f.number in chosen]
    reader = find_volume_grids(frames, {str(meaning): name for meaning, name in options.grids.items()})
    optics = options.resolve_optics("density" in reader.names)
    reader = reader.with_extinction(optics.extinction_grids, folder)
    measured: Mapping[int, GridExtent] = {}
    channels: Mapping[str, ChannelRange] = {}
    velocity = find_velocity_grid(frames, options.velocity)
    train, test = hemisphere_capture_cameras(
        options.size, options.cameras, up=options.up, field_of_view=options.field_of_view
    )
    if known is None:
        survey = survey_volume_frames(frames, reader, optics, context.progress)
        if not survey.hottest > 0:  # no flames in any frame: leave out everything that only flames need
            needless = {optics.flame_grid} - {reader.extinction}
            reader = replace(reader, names={m: n for m, n in reader.names.items() if m not in needless})
        if options.vdb is not None:
            derived = data_dependent_optics(optics, reader.extinction, survey)
            optics = replace(optics, **{key: value for key, value in derived.items() if key not in options.optics})
        for name in {reader.extinction, reader.names[reader.extinction]} & set(options.channels):
            raise ConfigError(f"scene.channels: {name!r} is the extinction, which every model learns; expected others")
        channels = measure_vdb_channels(frames, options.channels, context.progress)
        normalisation, measured = CaptureNormalisation.from_bounds(survey.box), survey.extents
        bounds = normalisation.to_scene(survey.box)
        auto_samples = choose_rays_per_pixel(train[0], survey.voxel * normalisation.scale)
    else:
        derived = {key: known["look"][key] for key in DATA_DEPENDENT}
        optics = replace(optics, **{**derived, "flame_range": tuple(derived["flame_range"])})
        reader = replace(reader, names=known["grids"])
        center, bounds = tuple(known["normalisation"]["center"]), np.array(known["bounds"])
        normalisation = CaptureNormalisation(center, known["normalisation"]["scale"])
        auto_samples = known["samples"]
    views = ([*train, *test], options.samples or auto_samples)
    if options.lights > 1 and optics.light is None:
        found = f"scene.lights={options.lights}: look {options.look} has no light"
        raise ConfigError(f"{found}; add scene.optics.light={{direction: [x, y, z], irradiance: [r, g, b]}}")
    lights = (options.lights, len(test))
    capture = Capture(
        frames, reader, optics, *views, normalisation, bounds, *lights, measured=measured, channels=channels,
        velocity=velocity,
    )  # fmt: skip
    source: DataSource = "simulated" if options.vdb is None else "real"
    return _PreparedVdbScene(options, name, source, capture, range(len(train), len(train) + len(test)))


def _report_chosen_optics(scene: _PreparedVdbScene) -> None:
    """Print the extinctions that were adapted to the files, and whether temperature could glow instead of flames."""
    capture, folder = scene.capture, scene.capture.frames[0].path.parent
    preset = scene.settings.resolve_optics("density" in capture.reader.names)
    lines = []
    for key, meaning in {"extinction": capture.reader.extinction, "flame_extinction": preset.flame_grid}.items():
        value, usual = getattr(capture.optics, key), getattr(preset, key)
        if value != usual:
            peak = f"values of grid {capture.reader.names[meaning]!r} go up to about {usual / value:.2g}"
            lines.append(f"scene.optics.{key}={value:g} (look: {usual:g}), because {peak}")
    if lines:
        warn_once(f"{folder}: {'; '.join(lines)}. Set these settings to use other values")
    heat = capture.reader.names.get("temperature")
    if preset.uses_flames and heat and preset.flame_grid not in capture.reader.names:
        warn_once(f"{folder}: no flames, so nothing glows; scene.grids.flames={heat} makes the grid {heat!r} glow")


# ---------------------------------------------------------------- chunks of time

MAX_FRAMES, MIN_FRAMES = 100, 25
"""Maximum and minimum frames per chunk for "auto". Short chunks cut off primitives that are active for a long time."""

_TIME_POWERS = {"window_center": 1, "velocity": -1, "acceleration": -2, "W_t": -1}
"""Parameter whose unit contains time -> the exponent of time in the unit, e.g. -1 for a velocity."""

_FRAMES_PER_OVERLAP, _MAX_OVERLAP = 8, 3
"""A chunk contains extra frames beyond each end: one per eight of the chunk's frames, from one to three. Without an
overlap, the change from one chunk's model to the next is visible where little moves. A long overlap costs time,
because its frames are trained twice."""


def split_into_time_chunks(config: Mapping[str, Any], context: SceneContext) -> Chunks | None:
    """Return the time chunks (parts that are trained separately) of a run; None if the run is not split.

    All frames are rendered first, since the chunks share one exposure.

    Raises:
        ConfigError: there are too few frames for so many chunks. Other errors are as in :func:`load_volume_scene`.
    """
    scene = _prepare_vdb_scene({name: value for name, value in config["scene"].items() if name != "name"}, context)
    options, capture = scene.settings, scene.capture
    frames, camera = capture.frames[:: options.train_every], capture.cameras[0]
    views = len(frames) * (len(capture.cameras) - len(scene.held_out))
    image_bytes = views * camera.width * camera.height * 4 * 2  # RGBA in half floats
    count = count_time_chunks(options.chunks, len(frames), image_bytes, options.memory_bytes * TRAINING_MEMORY)
    if count == 1:
        return None
    store = scene.rendered_frames(context).render_missing(context.progress)
    begins = [number * len(frames) // count for number in range(count + 1)]
    times = [float(torch.tensor(capture.time(frame))) for frame in frames]  # float32 as in views
    extra = min(max(len(frames) // count // _FRAMES_PER_OVERLAP, 1), _MAX_OVERLAP)
    overlaps = tuple((times[begin - extra], times[begin + extra - 1]) for begin in begins[1:-1])
    parts = [frames[max(begin - extra, 0) : end + extra] for begin, end in itertools.pairwise(begins)]
    # primitives are divided by extinction, like the starting points of one run
    weights = [sum(total_extinction_of_vdb_frame(capture, store, frame) for frame in part) for part in parts]
    used = [number for number in range(count) if weights[number] > 0]  # a chunk without matter cannot be trained
    if not used:
        return None
    total_frames = sum(len(parts[number]) for number in used)
    width = max(len(str(frame.number)) for frame in frames)
    chunks = []
    for number in used:
        part = parts[number]
        first, last = part[0].number, part[-1].number
        changes = {"scene.chunks": None, "scene.span": f"{first}:{last}", **_rescale_time(capture, part, config)}
        name = f"frames_{first:0{width}}-{last:0{width}}"
        chunks.append(Chunk(name, changes, weights[number] / sum(weights), len(part) / total_frames))
    return Chunks(tuple(chunks), lambda models: join_time_chunks(models, used, overlaps))


def count_time_chunks(requested: int | str | None, frames: int, image_bytes: int, memory: float) -> int:
    """Return the number of time chunks: the requested number or, for "auto", a suitable one.

    "auto" uses as many chunks as needed so that no chunk has more than :data:`MAX_FRAMES` frames and the images of each
    chunk fit in memory. But no chunk has fewer than :data:`MIN_FRAMES` frames.

    Args:
        frames: number of training frames.
        image_bytes: size of all decoded training images.
        memory: bytes of decoded images that a run can hold in memory.

    Raises:
        ConfigError: a chunk would have fewer than two frames.
    """
    if requested == "auto":
        wanted = max(math.ceil(frames / MAX_FRAMES), math.ceil(image_bytes / memory))
        return max(min(wanted, frames // MIN_FRAMES), 1)
    count = int(requested or 1)
    if count > 1 and 2 * count > frames:
        reason = "a chunk needs at least two training frames"
        expected = f"at most {frames // 2}, because {reason}" if frames >= 4 else f"null, because {reason}"
        available = "is 1 frame" if frames == 1 else f"are {frames} frames"
        raise ConfigError(f"scene.chunks={count}: there {available} for training; expected {expected}")
    return count


def _rescale_time(capture: Capture, frames: Sequence[VdbFrame], config: Mapping[str, Any]) -> dict[str, Any]:
    """Return setting -> value to change for a chunk, the part ``frames`` of a sequence that is trained separately.

    Learning rates of time-dependent parameters are adapted to the chunk's length in time. The initial window is limited
    to this length.
    """
    length = capture.time(frames[-1]) - capture.time(frames[0])
    density = TimeDensity(config["model"]["neurons"], **config["model"]["density"])
    rates = {spec.name: config["train"]["rates"].get(spec.name, spec.lr) for spec in density.parameters()}
    settings: dict[str, Any] = {
        f"train.rates.{name}": rates[name] * length**power for name, power in _TIME_POWERS.items() if name in rates
    }
    window = config["model"]["init"].get("window")
    if isinstance(window, int | float) and window > length:
        settings["model.init.window"] = length
    return settings


def join_time_chunks(models: Sequence[Primitives], numbers: Sequence[int], overlaps: ChunkOverlaps) -> Primitives:
    """Join the models of time chunks to one model, which sums their extinctions and sources, weighted by chunk.

    Args:
        models: models with the same field settings, in the time of the whole sequence.
        numbers: chunk number of each model, 0 to len(overlaps); chunks without a model are empty.
        overlaps: overlaps in time of neighbouring chunks.

    Raises:
        ConfigError: models have different field settings, or a model is already joined.
    """
    first = models[0]
    for model in models:
        if not isinstance(model.density, TimeDensity) or model.density.seams:
            raise ConfigError(
                f"cannot join chunks: a chunk's model has the density {type(model.density).__name__} "
                f"{model.density.settings()}; expected a TimeDensity without seams (overlaps of joined chunks)"
            )
        if any(getattr(model, kind).settings() != getattr(first, kind).settings() for kind in ("density", "colour")):
            raise ConfigError(
                "cannot join chunks: their models have different forms; expected equal settings of density and colour. "
                f"Found the densities {first.density.settings()} and {model.density.settings()}"
            )
    density = TimeDensity(**{**first.density.settings(), "seams": overlaps})
    params = {name: torch.cat([model.params[name].detach().cpu() for model in models]) for name in first.params}
    labels = zip(models, numbers, strict=True)
    params["chunk"] = torch.cat([torch.full((model.count, 1), float(number)) for model, number in labels])
    specs = Primitives(density, first.colour, params).specs
    return Primitives(density, first.colour, {spec.name: params[spec.name] for spec in specs})
