"""Export format ``vdb``: the density as an OpenVDB fog volume, one file per frame of a dynamic model; lossy (sampled).

The density grid is the sum of the primitives' densities at the voxels' centres, each clamped at 0 from below. Values
below ``threshold`` are not stored (background 0, inactive).

A model that was fitted to .vdb files is written on the voxels and in the units of these source files. Values are
limited to the largest value of the source frame and to the box of its active voxels. If flames add to the model's
extinction, only the part that comes from the source's extinction grid is written. Other models are written in the
coordinates of the run's data, on cubic voxels with index (0, 0, 0) at the scene's origin.

Units (metadata ``neuprim_units``):

* ``source``: sigma divided by the extinction per unit of the source's grid
* ``world``: extinction per world unit, which a volume shader multiplies by a length
* ``scene``: extinction per scene unit, i.e. sigma

The channels of the model, e.g. the temperature (``scene.channels``), are grids of their own. ``velocity=true``,
``emission=true`` and ``albedo=true`` add vector grids (:mod:`neuprim.export.vector_grids`), and ``usd=true`` adds a
stage of the files (:mod:`neuprim.export.usd_volume`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from neuprim.core.conditions import frame_numbers
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport
from neuprim.core.io.vdb import VdbGrid, VdbTiles, vdb_scale_transform, write_vdb
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import API_VERSION
from neuprim.core.volumes.density_grid import density_grid
from neuprim.core.volumes.density_truth import (
    DensityGridPlacement,
    DensityGridSource,
    GridExtent,
    measure_channel_errors,
    measure_density_errors,
)
from neuprim.export.shared import closest_up_axis, find_export_box, upside_down_usd_notes
from neuprim.export.usd_volume import write_usd_volume
from neuprim.export.vector_grids import choose_look, choose_velocity, sample_channels

OPTIONS = {
    "grid": (None, "voxels along the longest side, 8 to 2048 (default: the source's own voxels, else 128)"),
    "voxel_size": (None, "edge of a voxel in world units, instead of grid"),
    "units": ("auto", "source, world or scene; auto: source where the model was fitted to .vdb files, else world"),
    "threshold": (
        None,
        "values below it are not stored (default: the smallest active value of the source, but at least an optical "
        "depth of 0.001 along the box)",
    ),
    "half": (None, "16-bit floats, true or false (default: as in the source)"),
    "name": (None, "name of the grid (default: the source's name in units=source, else density)"),
    "velocity": (False, "also write the grid vel: velocities of the primitives, in world units per frame"),
    "emission": (False, "also write the grid emission: extinction times emitted colour, linear RGB"),
    "albedo": (False, "also write the grid albedo, of models trained with scene.lights=4"),
    "usd": (False, "also write density.usda, a USD stage that shows the files as a volume"),
    "fps": (None, "frames per second, for usd and the files' metadata; with it, vel is in world units per second"),
}
_LARGEST_THRESHOLD = 0.01  # of the source's largest value, if the user sets no threshold
_SLAB_BYTES = 64 * 2**20
_MOST_VOXELS = 2**34


@dataclass(frozen=True)
class _GridFrame:
    """A frame to write: its number in the file name, and its conditions.

    ``source`` is the index of the frame with equal conditions in the source (the .vdb files that the model was fitted
    to); None if the source has no such frame.
    """

    number: int
    conditions: Conditions
    source: int | None = None


def _write_vdb_frames(job: ExportJob) -> ExportReport:
    source, placement, notes = _find_export_source(job)
    frames = _list_export_frames(job, placement)
    paths = _name_vdb_files(job, frames)
    units = job.choice("units", "auto", "source", "world", "scene")
    if units == "auto":
        units = "source" if placement else "world"
    if units == "source" and placement is None:
        raise ConfigError("units=source: the model's header names no .vdb files; expected units=world or units=scene")
    scene_from_world = job.run.world.scene_from_world.numpy() if placement is None else placement.scene_from_world
    per_world = abs(np.linalg.det(scene_from_world[:3, :3])) ** (1 / 3)
    factor = {"source": 1 / placement.sigma_per_unit if placement else 1.0, "world": per_world, "scene": 1.0}[units]
    every = [] if placement is None else [_export_frame_conditions(placement, i) for i in range(len(placement.numbers))]
    # of all frames, so that voxels and threshold do not depend on the chosen ones
    box = np.stack([v.numpy() for v in find_export_box(job, [*every, *(f.conditions for f in frames)])])
    threshold = job.number("threshold", 0.0, 1e9)
    if threshold is None:
        threshold = 1e-3 / float((box[1] - box[0]).max()) * factor
        if placement is not None:  # the values of a solid block are no threshold
            extent = GridExtent.around(placement.extents)
            smallest = min(extent.smallest, _LARGEST_THRESHOLD * extent.largest)
            threshold = max(threshold, smallest * placement.sigma_per_unit * factor)
    name = placement.grid if placement is not None and units == "source" else "density"
    name = name if job.options["name"] is None else str(job.options["name"])
    half = source is not None and source.half and units == "source"
    half = half if job.options["half"] is None else job.flag("half")
    own = job.number("grid") is None and job.number("voxel_size") is None and source is not None
    origin = np.zeros(3) if placement else job.run.world.world_from_scene[:3, 3].numpy()
    fallback = _export_voxel_transform(job, box, scene_from_world, origin)
    sampler = _VdbExportSampler(job, _exported_component(job, placement), scene_from_world, name, factor, threshold)
    channels = list(job.run.model.density.channels(job.run.model.params))
    if name in channels:
        raise ConfigError(f"name={name}: the model has a channel of this name; expected another name for the density")
    moving = choose_velocity(job, sampler.model, [f.conditions for f in frames], scene_from_world)
    look = choose_look(job, frames[0].conditions, per_world, scene_from_world)
    whole = sampler._replace(model=job.run.model)
    names, boxes, rate = list[str](), list[np.ndarray](), job.number("fps", 0.1, 240.0)
    metadata = {"neuprim_units": units, "neuprim_sigma_per_unit": 1 / factor, "neuprim_threshold": threshold}
    metadata |= {} if rate is None else {"neuprim_fps": rate}
    errors: dict[str, float] = {}
    for i, (frame, path) in enumerate(zip(frames, paths, strict=True)):
        job.progress("writing frames", i / len(frames))
        transform = None
        if own and source is not None and frame.source is not None:
            transform = source.grid_transform(frame.source)
        transform = fallback if transform is None else transform
        grid = sampler.sample_grid(frame.conditions, transform)
        if placement is not None and placement.extents:
            extents = placement.extents  # for a time between frames, the extent of all
            extent = GridExtent.around(extents) if frame.source is None else extents[frame.source]
            grid = _clamp_exported_grid(grid, extent, placement.sigma_per_unit * factor)
        others = []
        if look is not None or channels:  # flames glow where the exported extinction may be 0
            lit = grid if sampler.model is whole.model else whole.sample_grid(frame.conditions, transform)
            lit = replace(lit, half=half)
            others += [] if look is None else look.sample_grids(job.run.model, frame.conditions, lit)
            others += sample_channels(job.run.model, frame.conditions, lit, scene_from_world, job.run.settings.threads)
        more = {f"neuprim_{key}": float(v) for key, v in frame.conditions.items() if v.numel() == 1}
        grid = replace(grid, half=half, metadata={**metadata, **more})
        if moving is not None:
            others.append(moving.sample_grid(sampler.model, frame.conditions, grid))
        write_vdb(path, [grid, *others])
        names, bounds = [g.name for g in (grid, *others)], grid.world_bounds()
        boxes += [] if bounds is None else [bounds]
        if source is not None and frame.source is not None:
            errors |= _measure_vdb_errors(job, source, frame.source, frame.conditions)
            found: dict[str, float] = {}
            truth = None if look is None else source.look(frame.source)
            if look is not None and truth is not None:
                found |= look.measure_errors(job.run.model, frame.conditions, truth)
            known = source.channels(frame.source) if channels else None
            if known is not None:
                own_errors = measure_channel_errors(job.run.model, frame.conditions, known, job.run.settings.threads)
                found |= {f"{n}.{key}": value for n, each in own_errors.items() for key, value in each.items()}
            errors |= {f"frame_{frame.number:04d}.{key}": value for key, value in found.items()}
    notes.append(f"grid {name!r} in {units} units: extinction per scene unit = value x {1 / factor:g}")
    if channels:
        notes.append(f"channels {', '.join(channels)}: means of the primitives, weighted by extinction")
    if moving is not None:
        notes.append(f"grid 'vel' in {moving.unit}, mean of the primitives weighted by extinction")
    if placement is not None and not placement.exact:
        notes.append(f"flames absorb, too: written is the part that comes from {placement.grid!r} alone")
    world = "the source's world" if placement else "the coordinates of the run's data"
    where = "the source's own voxels and world" if own else f"cubic voxels in {world}"
    notes.append(f"on {where}; values below {threshold:.3g} are left out")
    if errors and placement is not None:
        notes.append(
            f"errors: the model's extinction from {placement.grid!r} against the files' own values of that grid, "
            "on their voxels (every n-th along each axis in large boxes), as in metrics.json"
        )
    if job.flag("usd"):
        files = {frame.number: path for frame, path in zip(frames, paths, strict=True)}
        up = closest_up_axis(torch.from_numpy(scene_from_world[:3, :3].T) @ job.run.world.up)
        notes += upside_down_usd_notes(up)
        stage = job.out / "density.usda"
        write_usd_volume(stage, files, names, boxes, up, rate)
        paths.append(stage)
    return ExportReport(tuple(paths), False, errors, tuple(notes))


def _exported_component(job: ExportJob, placement: DensityGridPlacement | None) -> Primitives:
    """Return the model to export, whose extinction can be compared with the source's grid of extinctions.

    If flames add to the model's extinction, the result has only the part that comes from this grid. The source is the
    set of .vdb files that the model was fitted to; without it (``placement`` is None), return the run's model.

    Raises:
        ConfigError: the model has not learned this part separately.
    """
    model = job.run.model
    if placement is None or placement.exact:
        return model
    if placement.component not in model.density.components(model.params):
        raise ConfigError(
            f"{job.run.directory}: the model's extinction is a sum of flames and grid {placement.grid!r}, so the "
            "part of this grid is unknown; train again with train.supervision=both and scene.optics.extinction above 0"
        )
    return model.component(placement.component)


def _clamp_exported_grid(grid: VdbGrid, extent: GridExtent, per_unit: float) -> VdbGrid:
    """Limit a grid to the largest value and to the box of a source frame, ``extent``.

    A value of 1 in the source corresponds to ``per_unit`` in the grid.
    """
    offsets = np.stack(np.meshgrid(*(np.arange(8),) * 3, indexing="ij"), -1)
    centres = (grid.origins[:, None, None, None] + offsets) @ grid.transform[:3, :3].T + grid.transform[:3, 3]
    inside = np.zeros(grid.masks.shape, bool)
    if extent.box is not None:
        inside = ((centres >= extent.box[0]) & (centres <= extent.box[1])).all(-1)
    kept = grid.masks & inside
    values = np.where(kept, np.minimum(grid.values, np.float32(extent.largest * per_unit)), np.float32(0))
    some = kept.any((1, 2, 3))
    return replace(grid, origins=grid.origins[some], values=values[some], masks=kept[some])


# ---------------------------------------------------------------- which frames, and where


def _find_export_source(
    job: ExportJob,
) -> tuple[DensityGridSource | None, DensityGridPlacement | None, list[str]]:
    """Find the source of a model: the .vdb files that it was fitted to.

    Return the files, None if they cannot be used; their placement, None if there is no source; messages for the user.
    """
    notes: list[str] = []
    source = None
    try:
        source = job.run.volume()
    except NeuprimError as error:
        notes.append(f"the source's files cannot be read, so neither their voxels nor errors against them: {error}")
    record = job.run.header.get("world")
    kept = None
    if isinstance(record, dict) and "grid" in record:
        kept = DensityGridPlacement.from_json(record, str(job.run.directory / "model.safetensors"))
    if source is not None and kept is not None and not kept.matches(source.placement):
        reason = "the source's files are not those that the model was fitted to"
        notes.append(f"{reason}, so neither their voxels nor errors against them")
        source = None
    return source, kept if source is None else source.placement, notes


def _list_export_frames(job: ExportJob, placement: DensityGridPlacement | None) -> list[_GridFrame]:
    """List the frames to write: the frames that the user names, else all frames of the model's source .vdb files.

    If the times of the frames match different frame numbers of the source, the frames get these numbers. Otherwise,
    frames are numbered from 0. A model without conditions, such as the time, has one frame.
    """
    if not job.run.task.conditions:
        return [_GridFrame(0, {})]
    if job.conditions or placement is None:
        names = None if placement is None else placement.times.keys()
        wanted = job.frames(several=True, names=names)
        source = [_export_source_frame(conditions, placement) for conditions in wanted]
        numbers = frame_numbers(job.run.header, wanted)
        return [_GridFrame(*frame) for frame in zip(numbers, wanted, source, strict=True)]
    return [_GridFrame(n, _export_frame_conditions(placement, i), i) for i, n in enumerate(placement.numbers)]


def _export_frame_conditions(placement: DensityGridPlacement, frame: int) -> dict[str, Tensor]:
    return {name: torch.tensor(values[frame]) for name, values in placement.times.items()}


def _export_source_frame(conditions: Conditions, placement: DensityGridPlacement | None) -> int | None:
    """Return the index of the source's frame with the given conditions; None if no frame has them."""
    if placement is None:
        return None
    for i in range(len(placement.numbers)):
        known = _export_frame_conditions(placement, i)
        same = (torch.allclose(known[k].float(), v.float(), atol=1e-6) for k, v in conditions.items())
        if known.keys() == conditions.keys() and all(same):
            return i
    return None


def _name_vdb_files(job: ExportJob, frames: list[_GridFrame]) -> list[Path]:
    """Return the paths of the files to write: one file, or one per frame in a folder."""
    suffix = job.out.suffix.lower()
    if suffix == ".vdb":
        if job.flag("usd"):
            raise ConfigError(f"--out {job.out}: usd=true writes several files; expected a folder")
        if len(frames) > 1:
            raise ConfigError(f"--out {job.out}: {len(frames)} frames need several files; expected a folder")
        return [job.out]
    if not job.run.task.conditions:
        if suffix:
            raise ConfigError(f"--out {job.out}: expected a file name with .vdb, or a folder")
        return [job.out / "density.vdb"]
    width = max(4, len(str(max(f.number for f in frames))))
    return [job.out / f"density_{f.number:0{width}d}.vdb" for f in frames]


def _export_voxel_transform(
    job: ExportJob, box: np.ndarray, scene_from_world: np.ndarray, origin: np.ndarray
) -> np.ndarray:
    """Return the (4, 4) transform world_from_index of cubic voxels, for the option ``grid`` or ``voxel_size``.

    Args:
        box: (2, 3) corners of the model's bounding box, scene units.
        origin: (3,) position of voxel (0, 0, 0), world units.
    """
    count, size = job.count("grid", 8, 2048), job.number("voxel_size", 1e-9, 1e9)
    if count is not None and size is not None:
        raise ConfigError("grid and voxel_size: both are given; expected one of them")
    corners = np.linalg.inv(scene_from_world)[:3, :3] @ (box[1] - box[0])
    return vdb_scale_transform(size or float(np.abs(corners).max()) / (count or 128), origin.tolist())


# ---------------------------------------------------------------- sampling


class _VdbExportSampler(NamedTuple):
    """Sampler of a model's extinction on voxels, into a grid called ``name``.

    Extinctions (1/scene unit) are multiplied by ``factor``. Products below ``threshold`` are not stored.
    """

    job: ExportJob
    model: Primitives
    scene_from_world: np.ndarray
    name: str
    factor: float
    threshold: float

    def sample_grid(self, conditions: Conditions, transform: np.ndarray) -> VdbGrid:
        """Sample one frame as a sparse grid. Only one block at a time is dense in memory.

        Args:
            transform: (4, 4) matrix from voxel indices to world coordinates.

        Raises:
            ConfigError: the model's bounding box has too many voxels.
        """
        scene_from_index = self.scene_from_world @ transform
        try:
            low, high = (v.numpy() for v in find_export_box(self.job, [conditions]))
        except ConfigError:  # no primitive is active in this frame: an empty grid is a frame too
            low = high = scene_from_index[:3, 3]
        corners = np.stack(np.meshgrid(*np.stack([low, high], -1), indexing="ij"), -1).reshape(-1, 3)
        back = np.linalg.inv(scene_from_index)
        index = corners @ back[:3, :3].T + back[:3, 3]
        if not (np.abs(index) < 2**30).all():
            raise ConfigError(
                f"voxel index {np.abs(index).max():.3g} is too large; use a larger voxel_size or smaller grid"
            )
        first = np.floor(index.min(0)).astype(np.int64) & ~7
        size = (np.ceil(index.max(0)).astype(np.int64) & ~7) + 8 - first
        if math.prod(size.tolist()) > _MOST_VOXELS:
            voxels = f"{' x '.join(map(str, size))} voxels around the model"
            raise ConfigError(f"{voxels}; expected at most {_MOST_VOXELS:.0e}. Use a larger voxel_size or smaller grid")
        parts = [g for g in self._sample_blocks(conditions, scene_from_index, first, size) if len(g.origins)]
        leaves = (
            np.concatenate([np.zeros((0, 3), np.int32), *(g.origins for g in parts)]),
            np.concatenate([np.zeros((0, 8, 8, 8), np.float32), *(g.values for g in parts)]),
            np.concatenate([np.zeros((0, 8, 8, 8), bool), *(g.masks for g in parts)]),
        )
        return VdbGrid(self.name, np.array(transform, np.float64), np.zeros((), np.float32), *leaves, VdbTiles.none())

    def _sample_blocks(
        self, conditions: Conditions, scene_from_index: np.ndarray, first: np.ndarray, size: np.ndarray
    ) -> Iterator[VdbGrid]:
        """Yield one sparse grid per block of voxels. A dense block fits into about 64 MiB.

        Sides of blocks along x and y are multiples of 8 voxels. All blocks together start at index ``first`` and have
        ``size``.
        """
        settings = self.job.run.settings
        rows = max(8, min(int(size[1]), _SLAB_BYTES // (32 * int(size[2])) & ~7))
        planes = max(8, min(int(size[0]), _SLAB_BYTES // (4 * rows * int(size[2])) & ~7))
        for x in range(0, int(size[0]), planes):
            for y in range(0, int(size[1]), rows):
                corner = first + np.array([x, y, 0])
                shape = (min(planes, int(size[0]) - x), min(rows, int(size[1]) - y), int(size[2]))
                shifted = scene_from_index.copy()
                shifted[:3, 3] += shifted[:3, :3] @ corner
                matrix = torch.from_numpy(shifted)
                sigma = density_grid(self.model, conditions, matrix, shape, settings.threads).numpy()
                values = sigma * np.float32(self.factor)
                values[values < self.threshold] = 0.0
                yield VdbGrid.from_dense(self.name, values, lower=corner.tolist())


def _measure_vdb_errors(
    job: ExportJob, source: DensityGridSource, frame: int, conditions: Conditions
) -> dict[str, float]:
    """Return errors of the model's extinction against a frame of the source, on the source's voxels."""
    settings = job.run.settings
    part = {} if source.placement.exact else {"component": source.placement.component}
    found = measure_density_errors(job.run.model, conditions, source, frame, settings.threads, **part)
    return {f"frame_{source.placement.numbers[frame]:04d}.{key}": value for key, value in (found or {}).items()}


EXPORTER = Exporter(
    API_VERSION,
    "vdb",
    "the density as OpenVDB, one file per frame; lossy (sampled)",
    _write_vdb_frames,
    OPTIONS,
    conditions=True,
    default="vdb",
)
