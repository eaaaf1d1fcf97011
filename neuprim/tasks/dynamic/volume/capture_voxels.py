"""Voxels of a volume sequence that models learn from, besides images: extinction, emission and albedo at points."""

from __future__ import annotations

import functools
import itertools
import math
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from neuprim.core.data.dataset import PointSamples, PointSupervision
from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.json_reader import read_npz_arrays
from neuprim.core.io.store import Store
from neuprim.core.io.vdb import VdbFrame
from neuprim.core.model.fields import CHANNEL
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.lit_medium import light_medium
from neuprim.tasks.dynamic.volume.medium import Medium

T = TypeVar("T")


class RecentFrames(Generic[T]):
    """Cache of items. ``read`` (index) provides an item on first use; ``size`` (item) returns the item's bytes.

    If the items exceed ``memory`` bytes, the least recently used items are dropped.
    """

    def __init__(self, read: Callable[[int], T], size: Callable[[T], int], memory: float) -> None:
        self._read, self._size, self._memory = read, size, memory
        self._items: OrderedDict[int, T] = OrderedDict()
        self._bytes = 0

    def __getitem__(self, index: int) -> T:
        if index in self._items:
            self._items.move_to_end(index)
            return self._items[index]
        self._items[index] = item = self._read(index)
        self._bytes += self._size(item)
        while len(self._items) > 1 and self._bytes > self._memory:
            self._bytes -= self._size(self._items.popitem(last=False)[1])
        return item


_NEAR, _FAR = 0.2, 0.1  # shares of the points around voxels with matter, and anywhere in the box
_ANY_FRAME = 0.1  # share of the draws that take any frame, so that nearly empty frames are learned as well
_MAX_OFFSET = 6  # voxels from one with matter, along each axis
_SPHERE = np.float32(4 * math.pi)  # isotropic smoke scatters this part of the light into each direction
_MARGIN = 0.1  # margin on each side of the sequence's box, as a share of its longest side

_VOXEL_ARRAYS = {
    "index": (np.int64, (None,)),
    "values": (np.float32, (None, None)),
    "shape": (np.int64, (3,)),
    "scene_from_index": (np.float64, (4, 4)),
}

_MAX_VOXEL_BYTES = 4 * 2**30  # of a frame; more than the largest grid that is read


@dataclass(frozen=True)
class MediumVoxels:
    """The voxels of a frame that are not empty.

    Attributes:
        index: (V,) int64 ascending, flat indices (i Y + j) Z + k of a grid of ``shape``.
        values: (V, C) float32 columns: sigma (the extinction); sigma times RGB radiance; if flames add to sigma, the
            part of sigma that comes from the extinction grid; if the model lights the voxels, this part times the RGB
            albedo.
        scene_from_index: (4, 4) float64 matrix from voxel indices to scene coordinates.
        channels: (V, C) float32 columns: sigma times the value of each channel. :meth:`write` leaves them out.
    """

    index: np.ndarray
    values: np.ndarray
    shape: tuple[int, int, int]
    scene_from_index: np.ndarray
    channels: np.ndarray = field(default_factory=lambda: np.zeros((0, 0), np.float32))

    @staticmethod
    def of(medium: Medium, lit: bool = False) -> MediumVoxels:
        """Return the voxels of a medium that have a non-zero value; ``lit`` adds the columns with the albedo."""
        bricks = medium.bricks
        columns = [medium.values]
        if medium.scattering is not None:
            columns.append(medium.scattering[..., None])
        if lit:
            nothing = np.broadcast_to(np.float32(0), (*medium.values.shape[:4], 3))
            columns.append(nothing if medium.scattered is None else medium.scattered)
        parts = [(np.zeros(0, np.int64), np.zeros((0, sum(column.shape[-1] for column in columns)), np.float32))]
        # bricks of one layer at a time, so that only the voxels of a layer must be sorted
        ends = np.flatnonzero(np.diff(bricks.origins[:, 0], append=-1)) + 1
        for first, last in itertools.pairwise([0, *ends.tolist()]):
            some = [column[first:last] for column in columns]
            filled = np.any([column.any(-1) for column in some], 0)
            if bricks.dense:
                index = np.flatnonzero(filled)
                rows = [column.reshape(-1, column.shape[-1])[index] for column in some]
            else:
                block, *cells = bricks.select(filled)
                index = np.ravel_multi_index(tuple(bricks.index((block + first, *cells)).T), bricks.shape)
                order = np.argsort(index)
                index = index[order]
                rows = [column[tuple(axis[order] for axis in (block, *cells))] for column in some]
            parts.append((index, np.concatenate(rows, 1)))
        index, values = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))
        return MediumVoxels(index, values, bricks.shape, medium.scene_from_index)

    def count_bytes(self) -> int:
        return self.index.nbytes + self.values.nbytes + self.channels.nbytes

    @property
    def has_part(self) -> bool:
        """Whether the extinction grid's part of sigma is stored, in column 4."""
        return self.values.shape[1] in (5, 8)

    @property
    def has_albedo(self) -> bool:
        """Whether the last three columns are sigma times albedo."""
        return self.values.shape[1] >= 7

    @functools.cached_property
    def rms(self) -> tuple[float, float, float, float]:
        """Root mean squares, over the voxels, of four quantities; 0 if there are no voxels or no such column.

        These are sigma, sigma times radiance, the extinction grid's part of sigma, and this part times albedo.
        """
        squares = np.square(self.values, dtype=np.float64).mean(0) if len(self.index) else np.zeros(8)
        part = squares[4] if self.has_part else 0.0
        scattered = squares[-3:].mean() if self.has_albedo else 0.0
        return tuple(float(np.sqrt(x)) for x in (squares[0], squares[1:4].mean(), part, scattered))  # type: ignore[return-value]

    @functools.cached_property
    def channel_squares(self) -> np.ndarray:
        """Mean square of each column of :attr:`channels` over all voxels; 0 if there are no voxels."""
        return np.square(self.channels, dtype=np.float64).sum(0) / max(len(self.index), 1)

    def write(self, path: Path) -> None:
        """Write the voxels to an .npz file; raises OSError."""
        arrays: dict[str, Any] = {name: np.asarray(getattr(self, name)) for name in _VOXEL_ARRAYS}
        with open(path, "wb") as file:
            np.savez(file, **arrays)

    @staticmethod
    def read(path: Path) -> MediumVoxels:
        """Read voxels that :meth:`write` wrote.

        Raises:
            DataError: the file is damaged, or its arrays are not voxels of a grid.
        """
        found = read_npz_arrays(path, _VOXEL_ARRAYS)
        index, values, matrix = found["index"], found["values"], found["scene_from_index"]
        x, y, z = (int(n) for n in found["shape"])
        ascending = not len(index) or (index[0] >= 0 and index[-1] < x * y * z and bool((np.diff(index) > 0).all()))
        inside = min(x, y, z) >= 0 and x * y * z < 2**62 and ascending
        finite = np.isfinite(values).all() and np.isfinite(matrix).all()
        if len(index) != len(values) or values.shape[1] not in (4, 5, 7, 8) or not inside or not finite:
            raise DataError(
                f"{path}: damaged ({len(index)} voxels of a grid of {x}x{y}x{z}; "
                "expected ascending voxel indices in the grid, and finite values)"
            )
        return MediumVoxels(index, values, (x, y, z), matrix)

    def find_cells(self, cells: np.ndarray) -> np.ndarray:
        """Return (M,) int64 rows of the voxels with integer indices ``cells`` (M, 3); -1 for empty voxels."""
        rows = np.full(len(cells), -1, np.int64)
        inside = ((cells >= 0) & (cells < np.array(self.shape))).all(1)
        if len(self.index) and inside.any():
            flat = np.ravel_multi_index(tuple(cells[inside].T), self.shape)
            place = np.searchsorted(self.index, flat).clip(max=len(self.index) - 1)
            rows[inside] = np.where(self.index[place] == flat, place, -1)
        return rows

    def centers(self) -> np.ndarray:
        """Return the (V, 3) float64 centres of the voxels, scene units."""
        cells = np.stack(np.unravel_index(self.index, self.shape), -1)
        return cells @ self.scene_from_index[:3, :3].T + self.scene_from_index[:3, 3]


def take_voxel_rows(values: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return (M, C): the ``rows`` (M,) of ``values`` (V, C); 0 where a row is -1."""
    found = np.zeros((len(rows), values.shape[1]), np.float32)
    found[rows >= 0] = values[rows[rows >= 0]]
    return found


class FrameVoxels(PointSupervision):
    """Sampler of voxels, for training that compares the model with the extinction of the files.

    The points of one draw are from one frame. In nine of ten draws, the probability of a frame is proportional to the
    frame's extinction; in one of ten, all frames are equally probable. 70 % of the points are voxels with matter, 20 %
    lie up to six voxels away from a voxel with matter, and 10 % anywhere in a box larger than the sequence's box.

    Args:
        folder: store of the images. The voxels are stored there, too, since lighting the voxels takes long.
        frames: the frames, each with its time, 0..1.
        exposure: radiance that the training images show as 1.
        weights: total extinction of each frame.
        memory: limit on the voxels in memory, bytes.
    """

    def __init__(
        self,
        capture: Capture,
        folder: Store,
        frames: Sequence[tuple[VdbFrame, Tensor]],
        exposure: float,
        weights: Sequence[float],
        memory: float,
    ) -> None:
        self.capture, self.folder, self.exposure = capture, folder, exposure
        self.components, self.channels = capture.components, capture.channels
        self.frames, self.times = [frame for frame, _ in frames], [time for _, time in frames]
        shares = torch.tensor(weights, dtype=torch.float64)
        self.chances = (1 - _ANY_FRAME) * shares / shares.sum().clamp_min(1e-300) + _ANY_FRAME / len(self.frames)
        self._voxels = RecentFrames(self._read_voxels, MediumVoxels.count_bytes, memory)

    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        t = int(torch.multinomial(self.chances, 1, generator=generator))
        voxels = self._voxels[t]
        near, far = round(_NEAR * count), round(_FAR * count)
        if not len(voxels.index):
            near, far = 0, count
        low, high = self.capture.bounds
        margin = _MARGIN * float((high - low).max())
        uniform = torch.rand((far, 3), generator=generator, dtype=torch.float64).numpy()
        places = low - margin + uniform * (high - low + 2 * margin)
        back = np.linalg.inv(voxels.scene_from_index)
        cells = np.rint(places @ back[:3, :3].T + back[:3, 3]).astype(np.int64)
        known = np.zeros(0, np.int64)
        if far < count:
            rows = torch.randint(len(voxels.index), (count - far,), generator=generator).numpy()
            chosen = np.stack(np.unravel_index(voxels.index[rows], voxels.shape), -1)
            chosen[:near] += torch.randint(-_MAX_OFFSET, _MAX_OFFSET + 1, (near, 3), generator=generator).numpy()
            cells, known = np.concatenate([cells, chosen]), rows[near:]
        places = np.concatenate([voxels.find_cells(cells[: count - len(known)]), known])
        values = take_voxel_rows(voxels.values, places)
        points = cells @ voxels.scene_from_index[:3, :3].T + voxels.scene_from_index[:3, 3]
        sigma, light, part, scattered = voxels.rms
        fallback = self.capture.optics.extinction or 1.0  # for empty frames
        # the extinction grid's part of sigma; all of sigma in a frame without flames
        parts = torch.from_numpy(values[:, 4 if voxels.has_part else 0].copy())
        exposure, albedo = np.float32(self.exposure), values[:, -3:] if voxels.has_albedo else None
        light, scattered = self._light_scales(light, scattered)
        return PointSamples(
            name=f"frame_{self.frames[t].number:04d}",
            conditions={"time": self.times[t]},
            points=torch.from_numpy(points).float(),
            sigma=torch.from_numpy(values[:, 0].copy()),
            source=torch.from_numpy(values[:, 1:4] / exposure),
            sigma_scale=sigma or fallback,
            source_scale=(light or fallback) / self.exposure,
            components=dict.fromkeys(self.components, (parts, part or sigma or fallback))
            | self._draw_channels(voxels, places, sigma or fallback),
            scattered=None if albedo is None else torch.from_numpy(albedo / (_SPHERE * exposure)),
            scattered_scale=(scattered or fallback) / self.exposure,
        )

    def _draw_channels(self, voxels: MediumVoxels, rows: np.ndarray, sigma: float) -> dict[str, tuple[Tensor, float]]:
        """Return the channels of :attr:`PointSamples.components` for drawn rows of voxels (-1: empty voxels)."""
        if not self.channels:
            return {}
        drawn = torch.from_numpy(take_voxel_rows(voxels.channels, rows))
        found, first = dict[str, tuple[Tensor, float]](), 0
        for name, (size, width, _) in self.channels.items():
            columns = slice(first, first + width)
            typical = float(voxels.channel_squares[columns].mean()) ** 0.5 or sigma * size
            found[CHANNEL + name] = (drawn[:, columns].contiguous(), typical)
            first += width
        return found

    def _light_scales(self, emitted: float, scattered: float) -> tuple[float, float]:
        """Return two scales, by which the loss divides errors of emitted light, and of light scattered per irradiance.

        If the model lights the voxels, both scales are derived from the sum of emitted and scattered light, so that
        errors of the weaker part do not count as much as errors of the stronger part.

        Args:
            emitted: root mean square of sigma times radiance.
            scattered: root mean square of the extinction grid's part of sigma times albedo; 0 if it is not stored.
        """
        light = self.capture.optics.light
        if not scattered or light is None:
            return emitted, scattered
        irradiance = sum(light.irradiance) / 3
        total = emitted + scattered * irradiance / (4 * math.pi)
        return total, total / irradiance

    def _read_voxels(self, t: int) -> MediumVoxels:
        frame = self.frames[t]
        voxels = self.folder.retry(lambda: self._read_or_make_voxels(frame), warn_once)
        if not self.channels:
            return voxels
        values = self.capture.read_channels(frame, voxels.centers())
        return replace(voxels, channels=voxels.values[:, :1] * np.concatenate(list(values.values()), 1))

    def _supervised_medium(self, frame: VdbFrame) -> Medium:
        """Return the medium with whose voxels a model is compared in training.

        The medium's radiance includes scattered light if the capture has a single light. If there are several lights,
        scattered light is not included, since the model computes it.
        """
        capture, medium = self.capture, self.capture.medium(frame)
        if capture.lights > 1:
            return medium
        return light_medium(medium, capture.frame_lights(frame)[0], capture.optics, reuse=True)

    def _read_or_make_voxels(self, frame: VdbFrame) -> MediumVoxels:
        lit = self.capture.lights > 1
        name = f"{self.capture.frame_folder(frame)}/{'voxels_albedo' if lit else 'voxels'}.npz"
        path = self.folder.fetch_file(name, _MAX_VOXEL_BYTES)
        if not path.is_file():
            made = MediumVoxels.of(self._supervised_medium(frame), lit)
            try:
                self.folder.write_file(name, made.write)
            except OSError as error:
                raise DataError(f"cannot write the voxels of {frame.path} to {path}: {error}") from error
            return made
        try:
            return MediumVoxels.read(path)
        except DataError as error:
            raise DataError(f"{error}; delete it to read the frame again") from error
