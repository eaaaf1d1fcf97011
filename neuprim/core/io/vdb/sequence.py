"""A folder of OpenVDB files as frames in time."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from neuprim.core.errors import DataError, nearest
from neuprim.core.io.vdb.grid import Bounds, Grid
from neuprim.core.io.vdb.header import FileHeader, read_header
from neuprim.core.io.vdb.read import LEAF_LIMIT, read_grid

__all__ = ["VdbFrame", "FrameSurvey", "Sequence", "Survey", "sequence"]


@dataclass(frozen=True)
class VdbFrame:
    """One file and the number in its name."""

    number: int
    path: Path


@dataclass(frozen=True)
class FrameSurvey:
    """What one frame holds of one grid.

    Attributes:
        frame: the file.
        present: it has the grid at all. If not, all that follows is None or 0.
        voxel_size: edges in world units.
        bounds: box of active voxels, in indices; None if none is active.
        world_bounds: (2, 3) the same in world units, voxels with their extent.
        range: least and greatest finite active value.
        active_voxels, non_finite: counts.
    """

    frame: VdbFrame
    present: bool = False
    voxel_size: tuple[float, float, float] | None = None
    bounds: Bounds | None = None
    world_bounds: np.ndarray | None = None
    range: tuple[float, float] | None = None
    active_voxels: int = 0
    non_finite: int = 0


@dataclass(frozen=True)
class Survey:
    """One grid over all frames of a sequence."""

    name: str
    frames: tuple[FrameSurvey, ...]

    @property
    def absent(self) -> tuple[int, ...]:
        """Numbers of the frames without the grid."""
        return tuple(f.frame.number for f in self.frames if not f.present)

    @property
    def empty(self) -> tuple[int, ...]:
        """Numbers of the frames that have the grid, but no active voxel in it."""
        return tuple(f.frame.number for f in self.frames if f.present and f.bounds is None)

    @property
    def voxel_sizes(self) -> tuple[tuple[float, float, float], ...]:
        """The different voxel sizes, in order of appearance; more than one where the simulation changed its
        resolution."""
        return tuple(dict.fromkeys(f.voxel_size for f in self.frames if f.voxel_size is not None))

    @property
    def world_bounds(self) -> np.ndarray | None:
        """(2, 3) box around the active voxels of all frames, in world units; None if there are none."""
        boxes = [f.world_bounds for f in self.frames if f.world_bounds is not None]
        return np.stack([np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)]) if boxes else None

    @property
    def range(self) -> tuple[float, float] | None:
        """Least and greatest finite active value of all frames."""
        found = [f.range for f in self.frames if f.range is not None]
        return (min(r[0] for r in found), max(r[1] for r in found)) if found else None


@dataclass(frozen=True)
class Sequence:
    """Frames in the order of their numbers.

    Attributes:
        folder: where they are.
        frames: one or more.
        gaps: (first, last) number of every run of missing ones.
    """

    folder: Path
    frames: tuple[VdbFrame, ...]
    gaps: tuple[tuple[int, int], ...]

    def __len__(self) -> int:
        return len(self.frames)

    def headers(self) -> Iterator[FileHeader]:
        """Every frame's header, one at a time."""
        return (read_header(frame.path) for frame in self.frames)

    def read(self, index: int, name: str, *, max_bytes: int = LEAF_LIMIT) -> Grid | None:
        """Grid ``name`` of the frame at position ``index``; None if that frame has no such grid.

        An empty frame gives a grid without leaves, whatever bounding box its metadata claims.

        Raises:
            DataError: as :func:`~neuprim.core.io.vdb.read.read_grid`.
        """
        path = self.frames[index].path
        if all(grid.name != name for grid in read_header(path).grids):
            return None
        return read_grid(path, name, max_bytes=max_bytes)

    def survey(self, name: str) -> Survey:
        """Reads grid ``name`` of every frame, one at a time, and says what changes.

        Raises:
            DataError: no frame has it, or a file is damaged.
        """
        found: list[FrameSurvey] = []
        for index, frame in enumerate(self.frames):
            grid = self.read(index, name)
            if grid is None:
                found.append(FrameSurvey(frame))
                continue
            found.append(
                FrameSurvey(
                    frame,
                    True,
                    grid.voxel_size,
                    grid.bounds,
                    grid.world_bounds(),
                    grid.range,
                    grid.active_voxels,
                    grid.non_finite,
                )
            )
        if not any(f.present for f in found):
            names = {grid.name for header in self.headers() for grid in header.grids}
            raise DataError(f"{self.folder}: none of {len(self)} frames has a grid {name!r}{nearest(name, names)}")
        return Survey(name, tuple(found))


def sequence(folder: Path, prefix: str | None = None) -> Sequence:
    """The .vdb files of a folder, sorted by the last number in each name: ``fire_9.vdb`` comes before ``fire_10.vdb``.

    Args:
        folder: not searched deeper.
        prefix: what stands before the number, where a folder holds several sequences.

    Raises:
        DataError: no folder, no .vdb file, a name without a number, several prefixes, or one number twice.
    """
    folder = Path(folder)
    try:
        if not folder.is_dir():
            raise DataError(
                f"{folder}: {'is a file' if folder.exists() else 'no such folder'}; expected a folder with .vdb files"
            )
        paths = sorted(p for p in folder.iterdir() if p.suffix.lower() == ".vdb" and p.is_file())
    except OSError as error:  # no permission, a name that is too long
        raise DataError(
            f"{folder}: cannot be read ({error.strerror or error}); expected a folder with .vdb files"
        ) from error
    found: dict[str, list[VdbFrame]] = {}
    odd: list[str] = []
    for path in paths:
        match = re.fullmatch(r"(.*?)([0-9]+)([^0-9]*)", path.stem, re.DOTALL)
        if match is None or len(match[2]) > 18:
            odd.append(path.name)
        else:
            found.setdefault(match[1] + "*" * bool(match[3]) + match[3], []).append(VdbFrame(int(match[2]), path))
    if prefix is not None:
        found, odd = {k: v for k, v in found.items() if k == prefix}, []
    if not found and not odd:
        raise DataError(f"{folder}: no .vdb file{'' if prefix is None else f' named {prefix}NUMBER.vdb'}")
    if odd:
        raise DataError(f"{folder / odd[0]}: no frame number in the name; expected names like fire_12.vdb")
    if len(found) > 1:
        names = ", ".join(repr(name) for name in sorted(found))
        raise DataError(f"{folder}: files of several sequences: {names}; expected one prefix per folder")
    frames = sorted(next(iter(found.values())), key=lambda frame: frame.number)
    gaps: list[tuple[int, int]] = []
    for before, after in itertools.pairwise(frames):
        if before.number == after.number:
            raise DataError(f"{after.path}: frame {after.number} is also {before.path.name}; expected each number once")
        if after.number > before.number + 1:
            gaps.append((before.number + 1, after.number - 1))
    return Sequence(folder, tuple(frames), tuple(gaps))
