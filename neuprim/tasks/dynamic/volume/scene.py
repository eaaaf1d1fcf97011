"""``scene=smoke_fire`` and its like: OpenVDB files, given or simulated, as a data set."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuprim.core.checked import checked
from neuprim.core.data import Dataset, DataSource
from neuprim.core.errors import DataError
from neuprim.core.io.object_store import store_at
from neuprim.core.io.store import LocalStore
from neuprim.core.io.vdb import VdbFrame, sequence
from neuprim.core.task import Chunks, SceneContext
from neuprim.tasks.dynamic.simulation import simulate
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.chunks import number_of_chunks, planned
from neuprim.tasks.dynamic.volume.dataset import TRAINING, stored_points, volume_dataset
from neuprim.tasks.dynamic.volume.grids import GridReader, find_grids
from neuprim.tasks.dynamic.volume.looks import changed, named_look
from neuprim.tasks.dynamic.volume.normalise import Normalisation
from neuprim.tasks.dynamic.volume.optics import Look
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
    span = _span(asked, capture)
    rendered = _rendered(asked, capture, context).take(context.progress)
    up = torch.tensor(AXES[asked.up], dtype=torch.float64)
    return volume_dataset(name, source, capture, rendered, held_out, up, asked.train_every, span, asked.memory * 2.0**20)


def load_truth(settings: Mapping[str, Any], context: SceneContext, known: Mapping[str, Any] | None = None) -> RenderedFrames:
    """The same scene's images as work to be done; raises as :func:`load`.

    Args:
        known: of the same scene's ground truth in another process, which has surveyed the files.
    """
    asked, _, _, capture, _ = _prepare(settings, context, known)
    return _rendered(asked, capture, context)


def _rendered(asked: VolumeSettings, capture: Capture, context: SceneContext) -> RenderedFrames:
    store = LocalStore(context.cache_dir) if asked.cache is None else store_at(asked.cache, context.cache_dir / "copies")
    return RenderedFrames(capture, store)


def load_volume(settings: Mapping[str, Any], context: SceneContext) -> CaptureSource:
    """The same scene's files without any image. Raises as :func:`load`."""
    asked, _, _, capture, _ = _prepare(settings, context)
    span = _span(asked, capture)
    return CaptureSource(capture if span is None else capture.within(*span))


def load_chunks(config: Mapping[str, Any], context: SceneContext) -> Chunks | None:
    """The chunks that ``scene.chunks`` asks for, with the ground truth of all frames rendered, as their exposure is one; None for one run.

    Raises:
        ConfigError: more chunks than the frames allow. And as :func:`load`.
    """
    settings = {name: value for name, value in config["scene"].items() if name != "name"}
    asked, _, _, capture, held_out = _prepare(settings, context)
    learned, camera = len(capture.frames[:: asked.train_every]), capture.cameras[0]
    images = learned * (len(capture.cameras) - len(held_out)) * camera.width * camera.height * 4 * 2  # RGBA, half floats
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
    """All that is known before anything is rendered: settings, name, origin, what to render, and the cameras held out."""
    asked = checked(VolumeSettings, settings, "scene")
    _look(asked, AUTO[0])  # a typing error shows before anything is simulated
    folder, name, source = _files(asked, context)
    frames = _frames(folder, asked)
    reader = find_grids(frames, {str(meaning): name for meaning, name in asked.grids.items()})
    look = _look(asked, AUTO["density" not in reader.names])
    reader = reader.absorbing(look.extinction_grids, folder)
    if known is None:
        box, hottest = _survey(frames, reader, context.progress)
        if "flame_range" not in asked.optics and source == "real":
            look = dataclasses.replace(look, flame_range=(0.0, hottest)) if hottest > 0 else look
        normalisation = Normalisation.from_bounds(box)
        bounds = normalisation.to_scene(box)
    else:
        look = dataclasses.replace(look, flame_range=tuple(known["flame_range"]))
        normalisation, bounds = Normalisation.from_json(known["normalisation"]), np.array(known["bounds"])
    train, test = rig(asked.size, asked.cameras, up=asked.up, field_of_view=asked.field_of_view)
    capture = Capture(frames, reader, look, [*train, *test], asked.samples, normalisation, bounds, context.device)
    return asked, name, source, capture, range(len(train), len(train) + len(test))


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
    folder = simulate(asked.simulation, asked.timesteps, asked.resolution, context.seed, context.cache_dir, context.progress)
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


def _survey(frames: list[VdbFrame], reader: GridReader, progress: Progress) -> tuple[np.ndarray, float]:
    """(2, 3) box around all matter of all frames, world units, and the largest flame.

    Raises:
        DataError: no frame has any active voxel.
    """
    lows, highs, hottest = [], [], 0.0
    for i, frame in enumerate(frames):
        progress("looking through the frames", i / len(frames))
        for meaning, grid in reader.read(frame.path).items():
            bounds = grid.world_bounds()
            if bounds is None:
                continue
            if meaning == reader.extinction:
                lows.append(bounds[0])
                highs.append(bounds[1])
            elif meaning == "flames" and grid.range is not None:
                hottest = max(hottest, grid.range[1])
    if not lows:
        where = os.path.commonpath([f.path for f in frames])
        raise DataError(f"{where}: no frame has an active voxel of {reader.names[reader.extinction]!r}; expected matter in at least one")
    return np.stack([np.min(lows, 0), np.max(highs, 0)]), hottest
