"""The voxel files a scene was made from: how they lie beside the model, and what they hold."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from neuprim.core.errors import DataError
from neuprim.core.volumes.density_errors import DensityTruth


class Extent(NamedTuple):
    """Largest value of the absorbing grid of a frame, and the (2, 3) box around its active voxels, world units, or
    None."""

    largest: float
    box: np.ndarray | None

    @staticmethod
    def around(extents: Sequence[Extent]) -> Extent:
        """That of several frames together."""
        boxes = [extent.box for extent in extents if extent.box is not None]
        box = np.stack([np.min([b[0] for b in boxes], 0), np.max([b[1] for b in boxes], 0)]) if boxes else None
        return Extent(max((extent.largest for extent in extents), default=0.0), box)


@dataclass(frozen=True)
class Placement:
    """How scene units follow from the world of the files.

    Attributes:
        scene_from_world: (4, 4) float64.
        numbers: of the frames.
        times: name -> value per frame of the condition that tells frames apart, e.g. ``{"time": [0.0, 0.5, 1.0]}``.
        sigma_per_unit: extinction, 1/scene unit, of a grid value of 1.
        grid: name of the grid that absorbs.
        exact: whether that grid alone makes the extinction; if not, other grids add to it.
        component: the name of that grid's part of the extinction in models.
        extents: of that grid in every frame; empty if unknown.
    """

    scene_from_world: np.ndarray
    numbers: Sequence[int]
    times: Mapping[str, Sequence[float]]
    sigma_per_unit: float
    grid: str
    exact: bool = True
    component: str = "density"
    extents: Sequence[Extent] = ()

    def same(self, other: Placement) -> bool:
        """Whether both mean the same frames, places and values."""
        a, b = (
            (p.scene_from_world.tolist(), list(p.numbers), p.sigma_per_unit, p.grid, p.exact) for p in (self, other)
        )
        return a == b

    def to_json(self) -> dict[str, Any]:
        """Plain numbers, exact when read back."""
        return {
            "scene_from_world": self.scene_from_world.tolist(),
            "numbers": list(self.numbers),
            "times": {name: list(values) for name, values in self.times.items()},
            "sigma_per_unit": self.sigma_per_unit,
            "grid": self.grid,
            "exact": self.exact,
            "component": self.component,
            "extents": [[one.largest, None if one.box is None else one.box.tolist()] for one in self.extents],
        }

    @staticmethod
    def from_json(record: Mapping[str, Any], where: str) -> Placement:
        """Read what :meth:`to_json` gave; ``where`` names the file in errors.

        Raises:
            DataError: anything else.
        """

        def extent(largest: Any, box: Any) -> Extent:
            return Extent(float(largest), None if box is None else np.array(box, np.float64).reshape(2, 3))

        try:
            made = Placement(
                np.array(record["scene_from_world"], np.float64).reshape(4, 4),
                [int(n) for n in record["numbers"]],
                {str(name): [float(v) for v in values] for name, values in record["times"].items()},
                float(record["sigma_per_unit"]),
                str(record["grid"]),
                bool(record["exact"]),
                str(record.get("component", "density")),
                [extent(*pair) for pair in record.get("extents", ())],
            )
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError) as error:
            raise DataError(f"{where}: header field 'world' is damaged ({error!r})") from None
        matrix, count = made.scene_from_world, len(made.numbers)
        sound = (
            np.isfinite(matrix).all()
            and (matrix[3] == (0, 0, 0, 1)).all()
            and abs(np.linalg.det(matrix)) > 0
            and 0 < made.sigma_per_unit < np.inf
            and all(
                0 <= one.largest < np.inf and (one.box is None or np.isfinite(one.box).all()) for one in made.extents
            )
            and all(len(values) == count for values in made.times.values())
            and len(made.extents) in (0, count)
        )
        if not sound:
            raise DataError(
                f"{where}: header field 'world' is damaged; expected an invertible affine matrix, and a time per frame"
            )
        return made


class VolumeSource(DensityTruth):
    """The files themselves, one frame at a time; ``frames`` are those of the placement."""

    placement: Placement

    @abstractmethod
    def transform(self, frame: int) -> np.ndarray | None:
        """(4, 4) float64, index to world, of the absorbing grid of a frame; None where the frame lacks it."""

    @abstractmethod
    def of(self, path: Path) -> DensityTruth:
        """Another file, or folder of frames, read by the same rules and placed as these are.

        Raises:
            DataError: nothing in ``path`` fits.
        """
