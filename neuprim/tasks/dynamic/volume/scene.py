"""``scene=smoke_fire`` and its like: OpenVDB files, given or simulated, as a data set."""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuprim.core.data import Dataset, DataSource
from neuprim.core.errors import DataError
from neuprim.core.io.store import Store, open_store
from neuprim.core.io.vdb import VdbFrame, sequence
from neuprim.core.notices import warn_once
from neuprim.core.task import Chunks, SceneContext
from neuprim.core.validation import validate
from neuprim.core.volumes.source import Extent
from neuprim.scenes.smoke.generate import simulate_smoke
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.chunks import number_of_chunks, planned
from neuprim.tasks.dynamic.volume.dataset import TRAINING, stored_points, volume_dataset
from neuprim.tasks.dynamic.volume.grids import GridReader, find_grids
from neuprim.tasks.dynamic.volume.looks import changed, named_look
from neuprim.tasks.dynamic.volume.normalise import Normalisation
from neuprim.tasks.dynamic.volume.optics import FOLLOWING, Look
from neuprim.tasks.dynamic.volume.rendered import RenderedFrames
from neuprim.tasks.dynamic.volume.rig import AXES, rig
from neuprim.tasks.dynamic.volume.settings import VolumeSettings, choose_frames
from neuprim.tasks.dynamic.volume.source import CaptureSource

__all__ = ["load", "load_chunks", "load_truth", "load_volume"]

Progress = Callable[[str, float], None]


def load(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """The data set of a volume scene: files found or simulated, surveyed, rendered from all cameras, kept in the cache.

    Raises:
        ConfigError: unknown setting or impossible value.
        DataError: files that are missing, damaged, or without a usable grid; a cache that cannot be written.
    """
    asked, name, source, capture, held_out = _prepare(settings, context)
    _tell(asked, capture)
    span = _span(asked, capture)
    rendered = _rendered(asked, capture, context).take(context.progress)
    up = torch.tensor(AXES[asked.up], dtype=torch.float64)
    return volume_dataset(
        name, source, capture, rendered, held_out, up, asked.train_every, span, asked.memory * 2.0**20
    )


def load_truth(
    settings: Mapping[str, Any], context: SceneContext, known: Mapping[str, Any] | None = None
) -> RenderedFrames:
    """The same scene's images as work to be done; raises as :func:`load`.

    Args:
        known: of the same scene's ground truth in another process, which has surveyed the files.
    """
    asked, _, _, capture, _ = _prepare(settings, context, known)
    return _rendered(asked, capture, context)


def _rendered(asked: VolumeSettings, capture: Capture, context: SceneContext) -> RenderedFrames:
    store = (
        Store.local(context.cache_dir) if asked.cache is None else open_store(asked.cache, context.cache_dir / "copies")
    )
    return RenderedFrames(capture, store)


def load_volume(settings: Mapping[str, Any], context: SceneContext) -> CaptureSource:
    """The same scene's files without any image. Raises as :func:`load`."""
    asked, _, _, capture, _ = _prepare(settings, context)
    span = _span(asked, capture)
    return CaptureSource(capture if span is None else capture.within(*span))


def load_chunks(config: Mapping[str, Any], context: SceneContext) -> Chunks | None:
    """The chunks that ``scene.chunks`` asks for, with the ground truth of all frames rendered, as their exposure is
    one; None for one run.

    Raises:
        ConfigError: more chunks than the frames allow. And as :func:`load`.
    """
    settings = {name: value for name, value in config["scene"].items() if name != "name"}
    asked, _, _, capture, held_out = _prepare(settings, context)
    learned, camera = len(capture.frames[:: asked.train_every]), capture.cameras[0]
    images = (
        learned * (len(capture.cameras) - len(held_out)) * camera.width * camera.height * 4 * 2
    )  # RGBA, half floats
    count = number_of_chunks(asked.chunks, learned, images, asked.memory * 2.0**20 * TRAINING)
    if count == 1:
        return None
    store = _rendered(asked, capture, context).take(context.progress)

    def weight(frame: VdbFrame) -> float:
        return float(stored_points(capture.points(store, frame), "weight")["weight"])

    return planned(capture, asked.train_every, count, weight, config)


def _prepare(
    settings: Mapping[str, Any], context: SceneContext, known: Mapping[str, Any] | None = None
) -> tuple[VolumeSettings, str, DataSource, Capture, range]:
    """All that is known before anything is rendered: settings, name, origin, what to render, and the cameras held
    out."""
    asked = validate(VolumeSettings, settings, "scene")
    _look(asked, AUTO[0])  # a typing error shows before anything is simulated
    folder, name, source = _files(asked, context)
    frames = _frames(folder, asked)
    reader = find_grids(frames, {str(meaning): name for meaning, name in asked.grids.items()})
    look = _look(asked, AUTO["density" not in reader.names])
    reader = reader.absorbing(look.extinction_grids, folder)
    measured: Mapping[int, Extent] = {}
    if known is None:
        survey = _survey(frames, reader, look, context.progress)
        if not survey.hottest > 0:  # no frame has a flame: what only flames need is left out of everything that follows
            reader = dataclasses.replace(reader, names={m: n for m, n in reader.names.items() if m != "flames"})
        if source == "real":
            look = dataclasses.replace(
                look,
                **{key: v for key, v in _following(look, reader.extinction, survey).items() if key not in asked.optics},
            )
        normalisation, measured = Normalisation.from_bounds(survey.box), survey.extents
        bounds = normalisation.to_scene(survey.box)
    else:
        low, high = known["look"]["flame_range"]
        look = dataclasses.replace(
            look, **{**{key: known["look"][key] for key in FOLLOWING}, "flame_range": (low, high)}
        )
        reader = dataclasses.replace(reader, names=known["grids"])
        normalisation, bounds = Normalisation.from_json(known["normalisation"]), np.array(known["bounds"])
    train, test = rig(asked.size, asked.cameras, up=asked.up, field_of_view=asked.field_of_view)
    capture = Capture(
        frames, reader, look, [*train, *test], asked.samples, normalisation, bounds, context.device, measured=measured
    )
    return asked, name, source, capture, range(len(train), len(train) + len(test))


def _tell(asked: VolumeSettings, capture: Capture) -> None:
    """Say in one line which extinctions were chosen in place of the look's own."""
    usual = _look(asked, AUTO["density" not in capture.reader.names])
    grids = {"extinction": capture.reader.extinction, "flame_extinction": "flames"}
    chosen = [
        f"scene.optics.{key}={getattr(capture.look, key):g} (look: {getattr(usual, key):g}), as values of grid {capture.reader.names[meaning]!r} go "
        f"to about {getattr(usual, key) / getattr(capture.look, key):.2g}"
        for key, meaning in grids.items()
        if getattr(capture.look, key) != getattr(usual, key)
    ]
    if chosen:
        warn_once(f"{capture.frames[0].path.parent}: {'; '.join(chosen)}. Set these to choose others")


def _span(asked: VolumeSettings, capture: Capture) -> tuple[int, int] | None:
    """First and last number of the chosen frames that ``scene.span`` names; None for all of them."""
    if asked.span is None:
        return None
    first, last = asked.span_numbers
    own = [frame.number for frame in capture.frames if first <= frame.number <= last]
    if not own:
        begin, end = capture.clock
        raise DataError(f"scene.span={asked.span}: the chosen frames are {begin} to {end}, and none of these")
    return own[0], own[-1]


def _files(asked: VolumeSettings, context: SceneContext) -> tuple[Path, str, DataSource]:
    if asked.vdb is not None:
        return asked.vdb, asked.vdb.name, "real"
    assert asked.simulation is not None, "settings were checked"
    folder = simulate_smoke(
        asked.simulation, asked.timesteps, asked.resolution, context.seed, context.cache_dir, context.progress
    )
    return folder, f"{asked.simulation} (simulated)", "simulated"


def _frames(folder: Path, asked: VolumeSettings) -> list[VdbFrame]:
    found = sequence(folder).frames
    chosen = choose_frames(asked.frames, [f.number for f in found], str(folder))
    return [f for f in found if f.number in set(chosen)]


AUTO = ("smoke_fire", "embergen_fire")
"""Looks that ``look=auto`` takes for files with a density, and for those where the hot gas itself has to absorb."""


def _look(asked: VolumeSettings, automatic: str) -> Look:
    """The look by name with the user's changes.

    Raises:
        ConfigError: no such look or setting, or an impossible value.
    """
    return changed(named_look(automatic if asked.look == "auto" else asked.look, asked.up), asked.optics)


@dataclasses.dataclass(frozen=True)
class _Survey:
    """What the grids of all frames hold.

    Attributes:
        box: (2, 3) around all matter, world units.
        extents: number of a frame -> that of its extinction grid.
        hottest: the largest flame.
        typical: meaning -> a value that one voxel in a thousand exceeds.
    """

    box: np.ndarray
    extents: dict[int, Extent]
    hottest: float
    typical: dict[str, float]


class _Histogram:
    """How often positive values occur, to about 1 % of their size, so that a quantile of a whole sequence takes little
    memory."""

    def __init__(self) -> None:
        self.counts = np.zeros(1 << 15, np.int64)

    def add(self, values: np.ndarray) -> None:
        """The upper half of a positive float32's bits rises with it."""
        positive = values[np.isfinite(values) & (values > 0)]
        self.counts += np.bincount(positive.astype(np.float32).view(np.uint32) >> 16, minlength=len(self.counts))

    def quantile(self, share: float) -> float:
        """0 without any value."""
        below = np.cumsum(self.counts)
        place = int(np.searchsorted(below, share * below[-1]))
        return float(np.uint32(place << 16 | 1 << 15).view(np.float32)) if below[-1] else 0.0


def _survey(frames: list[VdbFrame], reader: GridReader, look: Look, progress: Progress) -> _Survey:
    """Looks through all frames. What absorbs is matter: the extinction grid, and flames where the look gives them an
    extinction.

    Raises:
        DataError: no frame has any active voxel.
    """
    matter, extents, hottest = list[Extent](), dict[int, Extent](), 0.0
    values = {meaning: _Histogram() for meaning in (reader.extinction, "flames")}
    for i, frame in enumerate(frames):
        progress("looking through the frames", i / len(frames))
        own = Extent(0.0, None)
        for meaning, grid in reader.read(frame.path).items():
            box = grid.world_bounds()
            if box is None or meaning not in values or grid.channels != 1:
                continue
            extent = Extent(max(grid.range[1], 0.0) if grid.range else 0.0, box)
            values[meaning].add(grid.active_values())
            if meaning == reader.extinction:
                own = extent
            if meaning == "flames":
                hottest = max(hottest, extent.largest)
            if meaning == reader.extinction or look.mixes(reader.names):
                matter.append(extent)
        extents[frame.number] = own
    box = Extent.around(matter).box
    if box is None:
        where = os.path.commonpath([f.path for f in frames])
        raise DataError(
            f"{where}: no frame has an active voxel of {reader.names[reader.extinction]!r}; expected matter in at least one"
        )
    return _Survey(box, extents, hottest, {meaning: found.quantile(_TYPICAL) for meaning, found in values.items()})


_TYPICAL = 0.999
"""Quantile of a grid's voxels that counts as its peak: single voxels far above the others do not change the optics."""


def _following(look: Look, absorbing: str, survey: _Survey) -> dict[str, Any]:
    """The settings of a look that follow the files: its extinctions are for grids that peak at about 1, and are divided
    by their peak.

    The divisor is rounded to a power of two, so that a few frames more or less change nothing.
    """
    grids = {"extinction": absorbing, "flame_extinction": "flames"}
    scaled = {
        key: getattr(look, key) * 2.0 ** -round(math.log2(survey.typical[m]))
        for key, m in grids.items()
        if survey.typical[m] > 0
    }
    return {**scaled, **({"flame_range": (0.0, survey.hottest)} if survey.hottest > 0 else {})}
