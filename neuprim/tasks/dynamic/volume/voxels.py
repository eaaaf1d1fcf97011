"""A sequence's voxels to learn from: those that hold matter, and empty ones around them and in the whole box."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neuprim.core.data.dataset import PointSamples, PointSupervision
from neuprim.core.errors import DataError
from neuprim.core.io.arrays import read_arrays
from neuprim.core.io.store import Store
from neuprim.core.io.vdb import VdbFrame
from neuprim.core.notices import warn_once
from neuprim.tasks.dynamic.volume.capture import Capture
from neuprim.tasks.dynamic.volume.medium import Medium

__all__ = ["FrameVoxels", "Voxels"]

_NEAR, _FAR = 0.2, 0.1
"""Shares of the points that are drawn around voxels with matter, and anywhere in the box."""

_ANY = 0.1
"""Share of the steps whose frame is any, so that frames with little or nothing are learned, too."""

_AROUND = 6
"""How far around, in voxels along each axis."""

_MARGIN = 0.1
"""How much larger than the sequence's box the one is that points are drawn in, on each side, in its longest sides."""


_ARRAYS = {
    "index": (np.int64, (None,)),
    "values": (np.float32, (None, None)),
    "shape": (np.int64, (3,)),
    "scene_from_index": (np.float64, (4, 4)),
}

_MOST = 4 * 2**30
"""Bytes of a frame's voxels: more than the largest grid that is read has."""


@dataclass(frozen=True)
class Voxels:
    """A frame's voxels that hold matter or light.

    Attributes:
        index: (V,) int64 ascending, flat indices (i Y + j) Z + k of a grid of ``shape``.
        values: (V, C) float32, sigma, sigma times radiance, and where flames add to sigma the part of it that the
        extinction grid makes. shape: of the grid; scene_from_index: (4, 4) float64.
    """

    index: np.ndarray
    values: np.ndarray
    shape: tuple[int, int, int]
    scene_from_index: np.ndarray

    @staticmethod
    def of(medium: Medium) -> Voxels:
        """Those of a medium that are not all zero."""
        flat = medium.values.reshape(-1, 4)
        if medium.scattering is not None:
            flat = np.concatenate([flat, medium.scattering.reshape(-1, 1)], 1)
        index = np.flatnonzero(flat.any(1))
        x, y, z = medium.values.shape[:3]
        return Voxels(index.astype(np.int64), np.ascontiguousarray(flat[index]), (x, y, z), medium.scene_from_index)

    @cached_property
    def sizes(self) -> tuple[float, float, float]:
        """Root mean squares of sigma, of sigma times radiance, and of the extinction grid's part, over the voxels; 0
        without any."""
        if not len(self.index):
            return 0.0, 0.0, 0.0
        squares = np.square(self.values, dtype=np.float64).mean(0)
        return tuple(float(np.sqrt(x)) for x in (squares[0], squares[1:4].mean(), squares[4:].sum()))  # type: ignore[return-value]

    @property
    def bytes(self) -> int:
        return self.index.nbytes + self.values.nbytes

    def write(self, path: Path) -> None:
        """As a file of arrays. Raises OSError."""
        with open(path, "wb") as file:
            np.savez(
                file,
                index=self.index,
                values=self.values,
                shape=np.array(self.shape),
                scene_from_index=self.scene_from_index,
            )

    @staticmethod
    def read(path: Path) -> Voxels:
        """What :meth:`write` wrote.

        Raises:
            DataError: damaged, or voxels that are not those of any grid.
        """
        found = read_arrays(path, _ARRAYS)
        index, values, matrix = found["index"], found["values"], found["scene_from_index"]
        x, y, z = (int(n) for n in found["shape"])
        inside = (
            min(x, y, z) >= 0
            and x * y * z < 2**62
            and (not len(index) or (index[0] >= 0 and index[-1] < x * y * z and bool((np.diff(index) > 0).all())))
        )
        finite = np.isfinite(values).all() and np.isfinite(matrix).all()
        if len(index) != len(values) or values.shape[1] not in (4, 5) or not inside or not finite:
            raise DataError(
                f"{path}: damaged ({len(index)} voxels of a grid of {x}x{y}x{z}; expected ascending places in it, and finite values)"
            )
        return Voxels(index, values, (x, y, z), matrix)

    def at(self, cells: np.ndarray) -> np.ndarray:
        """(M, C) values at (M, 3) integer indices; 0 outside."""
        found = np.zeros((len(cells), self.values.shape[1]), np.float32)
        inside = ((cells >= 0) & (cells < np.array(self.shape))).all(1)
        flat = np.ravel_multi_index(tuple(cells[inside].T), self.shape) if len(self.index) else np.zeros(0, np.int64)
        if not len(flat):
            return found
        place = np.searchsorted(self.index, flat).clip(max=len(self.index) - 1)
        found[inside] = np.where((self.index[place] == flat)[:, None], self.values[place], np.float32(0))
        return found


class FrameVoxels(PointSupervision):
    """Points on the voxels' centres of one frame after another.

    A frame is drawn as often as it has a share of the sequence's extinction, and one draw in ten takes any. 70 % of the
    points are voxels with matter, 20 % lie up to six voxels beside one, and 10 % anywhere in a box a little larger than
    the sequence's.

    Args:
        folder: of the capture's images; a frame's voxels are kept beside them once they were read, as the light in them
        may take long. frames, times, weights: those to learn from, and each one's extinction.
        exposure: what radiance is divided by.
        memory: bytes of voxels that are kept; beyond them those of the oldest frame are read again when needed.
    """

    def __init__(
        self,
        capture: Capture,
        folder: Store,
        frames: Sequence[VdbFrame],
        times: Sequence[Tensor],
        weights: Sequence[float],
        exposure: float,
        memory: float,
    ) -> None:
        self.capture, self.folder, self.frames, self.times = capture, folder, list(frames), list(times)
        self.exposure, self.memory, self.components = exposure, memory, capture.components
        shares = torch.tensor(weights, dtype=torch.float64)
        self.chances = (1 - _ANY) * shares / shares.sum().clamp_min(1e-300) + _ANY / len(frames)
        self._kept: OrderedDict[int, Voxels] = OrderedDict()

    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        t = int(torch.multinomial(self.chances, 1, generator=generator))
        voxels = self.voxels(t)
        near, far = round(_NEAR * count), round(_FAR * count)
        if not len(voxels.index):
            near, far = 0, count
        low, high = self.capture.bounds
        margin = _MARGIN * float((high - low).max())
        places = (
            low
            - margin
            + torch.rand((far, 3), generator=generator, dtype=torch.float64).numpy() * (high - low + 2 * margin)
        )
        back = np.linalg.inv(voxels.scene_from_index)
        cells = np.rint(places @ back[:3, :3].T + back[:3, 3]).astype(np.int64)
        known = np.zeros((0, voxels.values.shape[1]), np.float32)
        if far < count:
            rows = torch.randint(len(voxels.index), (count - far,), generator=generator).numpy()
            chosen = np.stack(np.unravel_index(voxels.index[rows], voxels.shape), -1)
            chosen[:near] += torch.randint(-_AROUND, _AROUND + 1, (near, 3), generator=generator).numpy()
            cells, known = np.concatenate([cells, chosen]), voxels.values[rows[near:]]
        values = np.concatenate([voxels.at(cells[: count - len(known)]), known])
        points = cells @ voxels.scene_from_index[:3, :3].T + voxels.scene_from_index[:3, 3]
        sigma, light, part = voxels.sizes
        usual = self.capture.look.extinction or 1.0  # of a frame that holds nothing
        return PointSamples(
            f"frame_{self.frames[t].number:04d}",
            {"time": self.times[t]},
            torch.from_numpy(points).float(),
            torch.from_numpy(values[:, 0].copy()),
            torch.from_numpy(values[:, 1:4] / np.float32(self.exposure)),
            sigma or usual,
            (light or usual) / self.exposure,
            {name: (self._part(values), part or sigma or usual) for name in self.components},
        )

    @staticmethod
    def _part(values: np.ndarray) -> Tensor:
        """(M,) the extinction grid's part of sigma; all of it in a frame without flames."""
        return torch.from_numpy(values[:, 4 if values.shape[1] > 4 else 0].copy())

    def voxels(self, t: int) -> Voxels:
        """Those of a frame, from memory, its file in the cache, or its own."""
        if t in self._kept:
            self._kept.move_to_end(t)
            return self._kept[t]
        self._kept[t] = found = self._read(self.frames[t])
        while len(self._kept) > 1 and sum(v.bytes for v in self._kept.values()) > self.memory:
            self._kept.popitem(last=False)
        return found

    def _read(self, frame: VdbFrame) -> Voxels:
        return self.folder.retry(lambda: self._read_or_make(frame), warn_once)

    def _read_or_make(self, frame: VdbFrame) -> Voxels:
        name = f"{self.capture.name(frame)}/voxels.npz"
        path = self.folder.fetch_file(name, _MOST)
        if not path.is_file():
            made = Voxels.of(self.capture.medium(frame))
            try:
                self.folder.write_file(name, made.write)
            except OSError as error:
                raise DataError(f"cannot write the voxels of {frame.path} to {path}: {error}") from error
            return made
        try:
            return Voxels.read(path)
        except DataError as error:
            raise DataError(f"{error}; delete it to read the frame again") from error
