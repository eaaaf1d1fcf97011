"""Input of the inspectors: frames of a model, with its density on a grid and the ground truth if there is one.

Also functions that choose the frames and the box of the grid, and open the ground truth.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels
from neuprim.core.conditions import Warn, condition_flag, read_conditions
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.vdb import VdbGrid, write_vdb
from neuprim.core.model.fields import Conditions, ConditionSpec
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import ActivePrimitives, Primitives
from neuprim.core.volumes.density_grid import density_grid
from neuprim.core.volumes.density_truth import DensityGridSource, DensityTruth
from neuprim.inspect.layers import Scale

_OUTSIDE = 0.002  # part of the absorption that may lie outside a model's box, at each of its faces


@dataclass(frozen=True)
class InspectionFrame:
    """One frame of a model for inspectors, with the model's extinction on a grid, computed at first use.

    Attributes:
        scene_from_index: (4, 4) transform from grid index to scene; the grid's axes are parallel to the scene's axes.
        top: upper end of the colour scale of the extinction, 1/scene unit; the same for all frames.
        gain: factor on the optical depth of :class:`~neuprim.inspect.layers.Volume`; the same for all frames.
        focus: (3,) centre of the extinction of all frames, scene units.
        levels: extinctions of isosurfaces, 1/scene unit; by default a tenth, a third and two thirds of ``top``.
        primitive: index of the primitive to show alone; None for the primitive that absorbs most.
        truth: function that returns the ground truth on the grid, (X, Y, Z) float32; None without ground truth.
        numbers: errors of the model against the ground truth.
        side: "model", or "truth" for a panel that shows the ground truth instead.
    """

    model: Primitives  # the model
    conditions: Conditions  # conditions of the frame
    title: str  # the conditions as text, e.g. "time 0.5"
    scene_from_index: Tensor
    shape: tuple[int, int, int]  # number of grid points along each axis
    top: float
    gain: float
    focus: tuple[float, ...] = (0.0, 0.0, 0.0)
    channels: Channels = field(default_factory=Channels)  # channels of the model's colours
    levels: tuple[float, ...] = ()
    primitive: int | None = None
    truth: Callable[[], np.ndarray] | None = None
    truth_name: str = ""  # name of the ground truth
    numbers: Mapping[str, float] | None = None
    side: str = "model"
    _grids: dict[str, np.ndarray] = field(default_factory=dict)  # shared by the panels of a frame

    def of_side(self, side: str) -> InspectionFrame:
        """Return a copy with :attr:`side` "model" or "truth". The copy shares the grids that are already computed."""
        return replace(self, side=side)

    @property
    def step(self) -> float:
        """Distance between neighbouring grid points, scene units."""
        return float(self.scene_from_index[0, 0])

    @property
    def origin(self) -> np.ndarray:
        """Position of the first grid point, (3,), scene units."""
        return np.asarray(self.scene_from_index[:3, 3].numpy())

    @property
    def box(self) -> np.ndarray:
        """Corners of the box that the voxels around the grid points fill, (2, 3), scene units."""
        low = self.origin - self.step / 2
        return np.stack([low, low + self.step * np.array(self.shape)])

    @property
    def scale(self) -> Scale:
        """Colour scale of the extinction, the same for all frames."""
        return Scale(0.0, self.top, title="extinction", unit="1/scene unit")

    @property
    def sigma(self) -> np.ndarray:
        """Extinction at the grid points, (X, Y, Z) float32, 1/scene unit.

        If :attr:`side` is "truth", this is the ground truth. If it is "model", this is the sum of the primitives'
        extinctions, each clamped at 0 from below.
        """
        if self.side not in self._grids:
            if self.side == "model":
                grid = density_grid(self.model, self.conditions, self.scene_from_index, self.shape).numpy()
            elif self.truth is None:
                raise ConfigError("there is no ground truth to show; give --against FILE.vdb, DIR or scene")
            else:
                grid = self.truth()
            self._grids[self.side] = grid
        return self._grids[self.side]

    @property
    def difference(self) -> np.ndarray:
        """Extinction of the model minus extinction of the ground truth, (X, Y, Z) float32."""
        return self.of_side("model").sigma - self.of_side("truth").sigma

    @cached_property
    def active(self) -> ActivePrimitives:
        """Primitives that are active (have extinction under the frame's conditions), without gradients."""
        with torch.no_grad():
            return self.model.active(self.conditions)

    @cached_property
    def rows(self) -> np.ndarray:
        """Indices of the active primitives in the model, (M,) int64, in the order of :attr:`geometry`."""
        return np.arange(self.model.count) if self.active.rows is None else self.active.rows.numpy()

    @property
    def geometry(self) -> Geometry:
        """Ellipsoids of the M active primitives, float32."""
        return self.active.geometry

    @cached_property
    def masses(self) -> np.ndarray:
        """Integral of the extinction over each active primitive's volume, (M,); see :func:`measure_absorption`."""
        return measure_absorption(self.active)

    @cached_property
    def colours(self) -> np.ndarray:
        """Display-referred colours of the M active primitives' centres, (M, 3) float32, seen from one fixed point."""
        low, high = self.box
        center = torch.from_numpy((low + high) / 2).float()
        eye = center + torch.tensor([1.0, -1.6, 0.7]) * float(np.linalg.norm(high - low))
        camera = Camera(look_at(eye, center, torch.tensor([0.0, 0.0, 1.0])), 64.0, 64.0, 32.0, 32.0, 64, 64)
        with torch.no_grad():
            rgb = self.model.lower(camera, self.conditions).center_colors(eye)
        return np.asarray(self.channels.display_rows(rgb.float().clamp_min(0)).numpy())

    def chosen_position(self) -> int:
        """Return the position, in :attr:`rows`, of the primitive to show alone.

        Raises:
            ConfigError: :attr:`primitive` does not exist or is not active in this frame.
        """
        wanted = self.primitive
        if wanted is None:
            return int(self.masses.argmax())
        if wanted >= (count := self.model.count):
            raise ConfigError(f"--primitive {wanted}: the model has {count} primitives, 0 to {count - 1}")
        found = np.flatnonzero(self.rows == wanted)
        if not len(found):
            raise ConfigError(f"--primitive {wanted}: this primitive absorbs nothing at {self.title}")
        return int(found[0])


def measure_absorption(active: ActivePrimitives) -> np.ndarray:
    """Estimate the integral of max(0, sigma) over each active primitive, (M,) float64.

    sigma is the extinction. The estimate is the mean of max(0, sigma) at 33 points of the ellipsoid, times the
    ellipsoid's volume.
    """
    i = torch.arange(33)
    radius, height, angle = ((i + 0.5) / 33) ** (1 / 3), 1 - 2 * ((i * 0.618034 * 7 + 0.5) % 1), i * 2.399963
    ring = (1 - height**2).clamp_min(0).sqrt()
    ball = torch.stack([ring * angle.cos(), ring * angle.sin(), height], 1) * radius[:, None]
    geometry = active.geometry
    every = torch.arange(geometry.count)
    total = torch.zeros(len(every))
    with torch.no_grad():
        for u in ball:
            x = geometry.means + (geometry.rotations @ (geometry.scales * u)[..., None])[..., 0]
            total += active.sigma(every, x).clamp_min(0)
    return np.asarray((total / len(ball) * geometry.scales.prod(1) * 4.18879).double().numpy())


# ---------------------------------------------------------------- which frames, and where


class GivenConditions(dict[str, Tensor]):
    """Conditions of a frame, as a dict. Reading a missing condition raises a ConfigError that names its option."""

    def __missing__(self, name: str) -> Tensor:
        raise ConfigError(f"the condition {name} is missing; give {condition_flag(name)}")


def read_inspected_conditions(
    specs: Sequence[ConditionSpec], texts: Mapping[str, str], warn: Warn = lambda text: None
) -> list[Conditions]:
    """Read the conditions of each frame with :func:`~neuprim.core.conditions.read_conditions`.

    ``texts`` maps a condition's name to the user's text. A scalar condition without text gets the middle of its range.
    Other conditions without text are left out. If several conditions are animated, the shorter animations are
    stretched to the number of frames of the longest.
    """
    given = read_conditions(specs, texts, warn)
    found: dict[str, list[Tensor]] = {}
    for spec in specs:
        if spec.name in given:
            found[spec.name] = given[spec.name]
        elif not spec.shape and all(map(math.isfinite, spec.range)):
            found[spec.name] = [torch.tensor(sum(spec.range) / 2)]
    count = max((len(values) for values in found.values()), default=1)
    return [
        GivenConditions({name: values[i * len(values) // count] for name, values in found.items()})
        for i in range(count)
    ]


def describe_inspected_conditions(conditions: Conditions) -> str:
    """Describe the conditions of a frame as text, e.g. "time 0.5"."""
    parts = []
    for name, value in conditions.items():
        numbers = [f"{x:.3g}" for x in value.flatten().tolist()]
        parts.append(f"{name} {numbers[0] if len(numbers) == 1 else '(' + ', '.join(numbers[:4]) + ')'}")
    return ", ".join(parts)


def parse_inspection_box(numbers: Sequence[float]) -> np.ndarray:
    """Convert the six numbers of ``--box`` to a (2, 3) box; raise ConfigError if the box has no volume."""
    if len(numbers) != 6 or not all(a < b for a, b in zip(numbers[:3], numbers[3:], strict=True)):
        given = ",".join(f"{x:g}" for x in numbers)
        raise ConfigError(f"--box {given}: expected the lower and the upper corner, such as -1,-1,-1,1,1,1")
    return np.array(numbers, np.float64).reshape(2, 3)


def find_inspection_box(model: Primitives, frames: Sequence[Conditions]) -> np.ndarray:
    """Return a (2, 3) float64 box that contains nearly all of the model's extinction in up to nine of ``frames``.

    Raises:
        DataError: the model absorbs nothing.
    """
    lows, highs = [], []
    for conditions in frames[:: max(1, len(frames) // 5)]:
        with torch.no_grad():
            active = model.active(conditions)
        geometry, weights = active.geometry, np.nan_to_num(measure_absorption(active), posinf=0.0)
        if not weights.sum() > 0:
            continue
        reach = (geometry.rotations * geometry.scales[:, None, :]).norm(dim=2).double().numpy()
        means = geometry.means.double().numpy()
        lows.append([_inspection_box_quantile(means[:, a] - reach[:, a], weights, _OUTSIDE) for a in range(3)])
        highs.append([_inspection_box_quantile(means[:, a] + reach[:, a], weights, 1 - _OUTSIDE) for a in range(3)])
    if not lows:
        raise DataError("the model absorbs nothing in any of these frames; there is nothing to show")
    return np.stack([np.min(lows, 0), np.max(highs, 0)])


def _inspection_box_quantile(values: np.ndarray, weights: np.ndarray, part: float) -> float:
    order = values.argsort()
    total = weights[order].cumsum()
    return float(values[order[min(int(np.searchsorted(total, part * total[-1])), len(order) - 1)]])


# ---------------------------------------------------------------- ground truth and files


def open_inspection_truth(path: str, volume: Callable[[], DensityGridSource | None]) -> tuple[DensityTruth, str]:
    """Open the ground-truth density that ``--against`` names; return the density and a one-line description.

    Args:
        path: an OpenVDB file, a folder of OpenVDB files, or "scene" for the files of the run's scene.
        volume: opens the files of the run's scene; returns None if the scene has no volumes.

    Raises:
        DataError: ``path`` does not exist, or the scene has no volumes.
    """
    place, scene = Path(path), volume()
    if scene is None:
        raise DataError(
            f"--against {path}: the run's scene has no volumes, so the position of these voxels in the scene is unknown"
        )
    if path == "scene" and not place.exists():
        return scene, "ground truth: the scene's own volumes"
    if not place.exists():
        raise DataError(f"--against {path}: no such file or folder; expected .vdb files, or scene for the scene's own")
    return scene.open_files(place), f"ground truth: {path}, placed and scaled by the rules of the run's scene"


def pair_inspected_frames(frames: Sequence[Conditions], truth: DensityTruth) -> list[tuple[Conditions, int]]:
    """Pair each frame of the model, given by its conditions, with the ground-truth frame of the nearest conditions.

    Return pairs (conditions, index of the ground-truth frame); each ground-truth frame occurs once at most. The
    conditions of a pair have the values of the ground-truth frame, as far as that frame has them.
    """
    pairs: dict[int, Conditions] = {}
    for conditions in frames:
        distances = [
            sum(float((conditions[name] - value).abs().sum()) for name, value in frame.conditions.items())
            for frame in truth.frames
        ]
        nearest = int(np.argmin(distances))
        pairs.setdefault(nearest, GivenConditions({**conditions, **truth.frames[nearest].conditions}))
    return [(conditions, number) for number, conditions in pairs.items()]


def write_inspection_vdb(path: Path, frame: InspectionFrame, world: World) -> None:
    """Write the frame's extinction, 1/scene unit, as an OpenVDB file in world coordinates; one voxel per grid point."""
    scalars = {f"neuprim_condition_{name}": float(x) for name, x in frame.conditions.items() if x.numel() == 1}
    metadata = {"neuprim_value": "extinction, 1/scene unit; each primitive clamped at 0 from below", **scalars}
    transform = world.world_from_scene.numpy() @ frame.scene_from_index.numpy()
    grid = VdbGrid.from_dense("extinction", frame.sigma, transform=transform, metadata=metadata)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_vdb(path, [grid], compression="zip")
