"""Find the grids of an OpenVDB sequence, measure them, and map the sequence into the scene's unit box."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from neuprim.core.data.dataset import ChannelRange
from neuprim.core.errors import DataError, nearest
from neuprim.core.io.vdb import DENSE_LIMIT, VdbFrame, VdbGrid, read_grids, read_header
from neuprim.core.volumes.density_truth import GridExtent
from neuprim.tasks.dynamic.volume.optics import Optics

USUAL_NAMES = {
    "density": ("density", "smoke", "soot"),
    "temperature": ("temperature", "heat", "temp"),
    "flames": ("flames", "flame", "fire"),
    "color": ("color", "colour", "Cd", "albedo"),
}
"""Grid names of exporters (EmberGen, Mantaflow, Houdini) by meaning."""

_PEAK_QUANTILE = 0.999  # of a grid's voxels, so that single outliers do not change the optics


@dataclass(frozen=True)
class GridReader:
    """Reader of the grids of .vdb files by meaning ("density", "temperature", "flames", "color").

    Attributes:
        names: meaning of a grid -> its name in the files.
        extinction: meaning of the grid that absorbs.
        level_sets: names of the level sets to convert to fog volumes; other level sets are refused.
    """

    names: Mapping[str, str]
    extinction: str = "density"
    level_sets: frozenset[str] = frozenset()

    def with_extinction(self, wanted: Sequence[str], folder: Path) -> GridReader:
        """Return a reader whose extinction grid is the first of ``wanted`` that the sequence has.

        Raises:
            DataError: the sequence has none of these grids.
        """
        for meaning in wanted:
            if meaning in self.names:
                return replace(self, extinction=meaning)
        listed = ", ".join(f"{meaning} ({name!r})" for meaning, name in self.names.items())
        raise DataError(
            f"{folder}: scene.look takes extinction from {' or '.join(wanted)}, but the files have {listed}; "
            f"choose another scene.look, or name the grid: scene.grids.{wanted[0]}=NAME"
        )

    def read(self, path: Path) -> dict[str, VdbGrid]:
        """Read one file: return meaning -> grid. Missing grids are left out, since exporters drop empty grids.

        If the colour grid NAME is missing, the grids NAME_r, NAME_g and NAME_b become the channels of one grid.
        """
        in_file = {grid.name for grid in read_header(path).grids}
        found = {}
        for meaning, name in self.names.items():
            parts = _color_channels(name) if meaning == "color" and name not in in_file else [name]
            if in_file.issuperset(parts):
                grids = list(read_grids(path, parts, level_sets=name in self.level_sets))
                try:
                    grids = [grid.fog() if grid.kind == "level set" else grid for grid in grids]
                    found[meaning] = grids[0] if len(grids) == 1 else _merge_color_channels(name, grids)
                except DataError as error:
                    raise DataError(f"{path}: {error}") from error
        return found


def _color_channels(name: str) -> list[str]:
    return [f"{name}_{channel}" for channel in "rgb"]


def _merge_color_channels(name: str, grids: Sequence[VdbGrid]) -> VdbGrid:
    """Return the grid ``name`` with three channels from the grids of its channels, which must have the same voxels."""
    first = grids[0]
    for grid in grids:
        if grid.channels != 1 or not np.allclose(grid.transform, first.transform, rtol=1e-6, atol=0):
            expected = f"one number per voxel and the transform of {first.name!r}"
            raise DataError(f"grid {grid.name!r} has another transform or number of channels; expected {expected}")
    boxes = [grid.bounds for grid in grids if grid.bounds is not None] or [((0, 0, 0), (0, 0, 0))]
    low, high = np.min(boxes, 0)[0].tolist(), np.max(boxes, 0)[1].tolist()
    box = ((low[0], low[1], low[2]), (high[0], high[1], high[2]))
    values = np.stack([grid.to_dense(box, DENSE_LIMIT // 3, 0.0) for grid in grids], -1)
    return VdbGrid.from_dense(name, values, lower=low, transform=first.transform)


def find_volume_grids(frames: Sequence[VdbFrame], chosen: Mapping[str, str]) -> GridReader:
    """Find the grids by meaning in all frames, first by the names that the user chose, then by common names.

    Raises:
        DataError: a chosen grid is in no file or cannot be read (such as points), frames use different usual names of
            one meaning, or no grid absorbs.
    """
    refusals: dict[str, str | None] = {}  # name -> why the grid cannot be used
    level_sets: set[str] = set()
    stored: dict[Path, set[str]] = {}  # names of the grids of each file
    for frame in frames:
        grids = read_header(frame.path).grids
        stored[frame.path] = {grid.name for grid in grids}
        for grid in grids:
            refusal = grid.refusal()
            if grid.name not in refusals or refusal is None:
                refusals[grid.name] = refusal
            if refusal and not grid.undecodable():
                level_sets.add(grid.name)
    folder = frames[0].path.parent
    names: dict[str, str] = {}
    for meaning, usual in USUAL_NAMES.items():
        if meaning == "color":
            candidates = [*usual, chosen.get("color", usual[0])]
            refusals |= {name: None for name in candidates if refusals.keys() >= set(_color_channels(name))}
        if meaning in chosen:
            name = chosen[meaning]
            where = f"{folder}: scene.grids.{meaning}={name}"
            if name not in refusals:
                raise DataError(f"{where}: no frame has such a grid{nearest(name, refusals)}")
            if refusals[name] and name not in level_sets:
                raise DataError(f"{where}: the grid {refusals[name]}")
            names[meaning] = name
        elif usable := [name for name in usual if name in refusals and refusals[name] is None]:
            names[meaning] = usable[0]
            for path, there in stored.items() if meaning in ("density", "flames") else ():
                if usable[0] not in there and (others := there.intersection(usable)):
                    what = f"no grid {usable[0]!r}, which other frames have, but {sorted(others)[0]!r}"
                    raise DataError(f"{path}: {what}; expected equal names. Choose one: scene.grids.{meaning}=NAME")
    if not {"density", "temperature"} & names.keys():
        listed = ", ".join(f"{name} ({why or 'readable'})" for name, why in sorted(refusals.items())) or "none"
        raise DataError(
            f"{folder}: no grid of density or temperature; found: {listed}. Name one: scene.grids.density=NAME"
        )
    return GridReader(names, level_sets=frozenset(level_sets & set(chosen.values())))


_LARGEST_CHANNEL = 1e15  # squares are float32


def measure_vdb_channels(
    frames: Sequence[VdbFrame], names: Sequence[str], progress: Callable[[str, float], None]
) -> dict[str, ChannelRange]:
    """Return the range of each of the grids ``names`` in all frames.

    Raises:
        DataError: no frame has a grid, or a grid cannot be read, is 0 everywhere, or differs in numbers per voxel.
    """
    found: dict[str, ChannelRange] = {}
    folder, stored = frames[0].path.parent, set[str]()
    for i, frame in enumerate(frames if names else ()):
        progress("measuring channels", i / len(frames))
        in_file = {grid.name for grid in read_header(frame.path).grids}
        stored |= in_file
        for grid in read_grids(frame.path, [name for name in names if name in in_file]):
            largest, width, lowest = found.get(grid.name, ChannelRange(0.0, grid.channels, 0.0))
            if grid.channels != width:
                what = f"grid {grid.name!r} has {grid.channels} numbers per voxel"
                raise DataError(f"{frame.path}: {what}; expected {width}, as in earlier frames")
            values = grid.active_values()
            values = values[np.isfinite(values)]
            most = float(np.abs(values).max(initial=0.0))
            if most > _LARGEST_CHANNEL:
                what = f"grid {grid.name!r} has values up to {most:.3g}"
                raise DataError(f"{frame.path}: {what}; expected at most {_LARGEST_CHANNEL:.0e}")
            found[grid.name] = ChannelRange(max(largest, most), width, min(lowest, float(values.min(initial=0.0))))
    for name in names:
        if name not in found or not found[name].largest:
            problem = "the grid is 0 in all frames" if name in found else "no frame has such a grid"
            raise DataError(f"{folder}: scene.channels={name}: {problem}{nearest(name, stored - {name})}")
    return found


# ---------------------------------------------------------------- measuring


@dataclass(frozen=True)
class SequenceSurvey:
    """Statistics of the grids of all frames of a sequence.

    Attributes:
        box: (2, 3) bounds of all matter, world units.
        extents: frame number -> extent of its extinction grid.
        hottest: largest value of the flame grids.
        peaks: meaning of a grid -> the value that one voxel in a thousand exceeds.
        voxel: shortest edge of a voxel of the extinction and flame grids, world units.
    """

    box: np.ndarray
    extents: dict[int, GridExtent]
    hottest: float
    peaks: dict[str, float]
    voxel: float


def survey_volume_frames(
    frames: list[VdbFrame], reader: GridReader, optics: Optics, progress: Callable[[str, float], None]
) -> SequenceSurvey:
    """Read all frames and measure their grids. Matter is the extinction grid, and the flames if they absorb.

    Raises:
        DataError: no frame has an active voxel.
    """
    matter, extents, hottest, voxel = list[GridExtent](), dict[int, GridExtent](), 0.0, math.inf
    histograms = {meaning: np.zeros(1 << 15) for meaning in (reader.extinction, optics.flame_grid)}
    needed = {reader.extinction, *([optics.flame_grid] if optics.uses_flames else [])}
    for i, frame in enumerate(frames):
        progress("looking through the frames", i / len(frames))
        extents[frame.number] = GridExtent(0.0, 0.0, None)
        for meaning, grid in reader.read(frame.path).items():
            if grid.channels != 1 and meaning in needed:
                what = f"grid {reader.names[meaning]!r} has {grid.channels} channels"
                raise DataError(f"{frame.path}: {what}; expected 1")
            box = grid.world_bounds()
            if box is None or meaning not in histograms or grid.channels != 1:
                continue
            low, high = (max(value, 0.0) for value in grid.range or (0.0, 0.0))
            extent = GridExtent(low, high, box)
            voxel = min(voxel, float(np.linalg.norm(grid.transform[:3, :3], axis=0).min()))
            histograms[meaning] += _count_vdb_values(grid)
            if meaning == reader.extinction:
                extents[frame.number] = extent
            if meaning == optics.flame_grid:
                hottest = max(hottest, extent.largest)
            if meaning == reader.extinction or optics.mixes(reader.names):
                matter.append(extent)
    box = GridExtent.around(matter).box
    if box is None:
        where = os.path.commonpath([f.path for f in frames])
        name = reader.names[reader.extinction]
        raise DataError(f"{where}: no frame has an active voxel of {name!r}; expected active voxels in at least one")
    peaks = {m: _peak_vdb_value(counts) for m, counts in histograms.items()}
    return SequenceSurvey(box, extents, hottest, peaks, voxel)


def _count_vdb_values(grid: VdbGrid) -> np.ndarray:
    """Return a histogram (2^15,) of the positive active voxels. A value's bin is the upper 16 bits of its float32."""
    values, tiles = grid.active_values(), grid.tiles
    voxels = np.ones(len(values))
    voxels[len(values) - np.count_nonzero(tiles.active) :] = tiles.sizes[tiles.active].astype(np.float64) ** 3
    positive = np.isfinite(values) & (values > 0)
    return np.bincount(values[positive].astype(np.float32).view(np.uint32) >> 16, voxels[positive], 1 << 15)


def _peak_vdb_value(counts: np.ndarray) -> float:
    """Return the 99.9 % quantile of a histogram of :func:`_count_vdb_values`, to about 1 %; 0 without values."""
    cumulative = np.cumsum(counts)
    place = int(np.searchsorted(cumulative, _PEAK_QUANTILE * cumulative[-1]))
    return float(np.uint32(place << 16 | 1 << 15).view(np.float32)) if cumulative[-1] else 0.0


def data_dependent_optics(optics: Optics, extinction: str, survey: SequenceSurvey) -> dict[str, Any]:
    """Return the settings of ``optics`` that depend on the values in the files, adapted to these values.

    Presets assume grids with a peak of about 1. The extinctions are therefore divided by the peak of the files' grids.
    The divisor is rounded to a power of two, so that the divisor rarely changes when frames are added or left out.
    """
    grids = {"extinction": extinction, "flame_extinction": optics.flame_grid}
    settings: dict[str, Any] = {
        key: getattr(optics, key) * 2.0 ** -round(math.log2(survey.peaks[meaning]))
        for key, meaning in grids.items()
        if survey.peaks[meaning] > 0
    }
    return settings | ({"flame_range": (0.0, survey.hottest)} if survey.hottest > 0 else {})


@dataclass(frozen=True)
class CaptureNormalisation:
    """Map from .vdb world to scene: scene = (world - center) · scale, equal for all frames, without rotation."""

    center: tuple[float, float, float]
    scale: float

    @staticmethod
    def from_bounds(bounds: np.ndarray) -> CaptureNormalisation:
        """Return the map of the box ``bounds`` (2, 3), world units, to a box around the origin with longest side 1.

        Raises:
            DataError: the box is not finite, or has no volume.
        """
        low, high = np.asarray(bounds, np.float64)
        longest = float((high - low).max())
        if not np.isfinite(high - low).all() or longest <= 0.0 or not math.isfinite(1.0 / longest):
            raise DataError(
                f"normalisation: box from {low.tolist()} to {high.tolist()}; expected a finite box with a volume"
            )
        x, y, z = ((low + high) / 2).tolist()
        return CaptureNormalisation((x, y, z), 1.0 / longest)

    def to_scene(self, points: np.ndarray) -> np.ndarray:
        """Convert (…, 3) world points to float64 scene points."""
        return (np.asarray(points, np.float64) - self.center) * self.scale

    def matrix(self) -> np.ndarray:
        """Return the (4, 4) float64 matrix from world to scene, for column vectors."""
        matrix = np.diag([self.scale, self.scale, self.scale, 1.0])
        matrix[:3, 3] = -np.asarray(self.center) * self.scale
        return matrix
