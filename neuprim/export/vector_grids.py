"""Further grids of exported OpenVDB files: velocities of the primitives, emission, albedo, and channels."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.conditions import frame_interval
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.extensions import ExportJob
from neuprim.core.io.vdb import VdbGrid, VdbTiles
from neuprim.core.model.fields import Conditions, LoweredDensity
from neuprim.core.model.primitives import ActivePrimitives, Primitives
from neuprim.core.volumes.density_truth import DensityComparison, VoxelLook
from neuprim.core.volumes.points import weighted_extinctions_at

_STEP = 1e-3  # of central differences in time, which are exact for motion that is quadratic in time
_LEAVES = 512  # evaluated at once, with about 64 MB of sums


@dataclass(frozen=True)
class VelocityExport:
    """Settings and sampler of the OpenVDB grid ``vel``, the velocity of the primitives.

    Attributes:
        interval: units of the condition "time" per second or per frame.
        unit: unit of the velocities, for metadata.
        scene_from_world: (4, 4) float64 transform from world to scene coordinates.
        threads: number of threads, 0 for all cores.
    """

    interval: float
    unit: str
    scene_from_world: np.ndarray
    threads: int

    def sample_grid(self, model: Primitives, conditions: Conditions, density: VdbGrid) -> VdbGrid:
        """Return the grid ``vel`` of a frame, with the active voxels of ``density``.

        The value of a voxel is the mean velocity of the primitives at its centre, weighted by their extinctions.

        Args:
            model: the model from which ``density`` was sampled.
            conditions: conditions of the frame, among them "time".
        """
        per_time = np.linalg.inv(self.scene_from_world[:3, :3]).T * self.interval
        with torch.no_grad():
            active = model.to(device.HOST).active(conditions)
            form = active.field.lower(active.own, active.geometry, conditions)
            sums = sum_at_voxels(
                active, form, primitive_velocities(active), density, self.scene_from_world, self.threads
            )
        values = _ratio(sums[..., 1:], sums[..., :1]) @ per_time
        metadata = {"vector_type": "contravariant relative", "neuprim_units": self.unit}
        return vector_grid("vel", density, values.astype(np.float32), metadata)


@dataclass(frozen=True)
class LookExport:
    """Settings and sampler of the OpenVDB grids ``emission`` and ``albedo``.

    Attributes:
        names: the grids to write.
        exposure: the radiance of a pixel whose value in a training image is 1.
        per_world: scene units per world unit.
        scene_from_world: (4, 4) float64 transform from world to scene coordinates.
        threads: number of threads, 0 for all cores.
    """

    names: tuple[str, ...]
    exposure: float
    per_world: float
    scene_from_world: np.ndarray
    threads: int

    def sample_grids(self, model: Primitives, conditions: Conditions, extinction: VdbGrid) -> list[VdbGrid]:
        """Return the grids of a frame, with the active voxels of ``extinction``.

        ``emission`` is the sum over primitives of extinction times emitted colour, radiance per world unit.
        ``albedo`` is the mean scattering albedo of the primitives, weighted by their extinctions.
        """
        with torch.no_grad():
            active, form, weights = self._weights(model, conditions)
            sums = sum_at_voxels(active, form, weights, extinction, self.scene_from_world, self.threads)
        found = {
            "emission": sums[..., 1:4] * np.float32(self.per_world),
            "albedo": _ratio(sums[..., 4:], sums[..., :1]),
        }
        units = {"emission": "radiance per world unit", "albedo": "fraction of the extinction"}
        return [vector_grid(n, extinction, found[n], {"neuprim_units": units[n]}) for n in self.names]

    def measure_errors(self, model: Primitives, conditions: Conditions, truth: VoxelLook) -> dict[str, float]:
        """Return name -> error of emission, and of albedo times extinction, against one frame of .vdb files.

        ``truth`` has the emission and scattering of this frame at its voxels, from the files that the model was fitted
        to.
        """
        points = torch.from_numpy(truth.points)
        with torch.no_grad():
            active, form, weights = self._weights(model, conditions)
            sums = weighted_extinctions_at(active, form, points, weights, threads=self.threads).numpy()
        true = {"emission": truth.emission, "albedo": truth.scattered}
        found: dict[str, float] = {}
        for name, values in (("emission", sums[:, 1:4]), ("albedo", sums[:, 4:])):
            own = true[name]
            if name in self.names and own is not None:
                comparison = DensityComparison()
                comparison.add_block(own, values)
                found |= {f"{name}.{key}": value for key, value in (comparison.errors() or {}).items()}
        return found

    def _weights(self, model: Primitives, conditions: Conditions) -> tuple[ActivePrimitives, LoweredDensity, Tensor]:
        """Return the N active primitives of a frame, their density, and their emission and albedo as one tensor.

        The tensor is (N, 6): emitted radiance (RGB), then scattering albedo. Without scattering it is (N, 3).
        """
        active = model.to(device.HOST).active(conditions)
        params = {spec.name: active.params[spec.name] for spec in model.colour.parameters()}
        emitted, scattered = model.colour.isotropic(params, conditions), model.colour.scattering(params)
        assert emitted is not None, "checked by choose_look"
        parts = [emitted * self.exposure]
        if scattered is not None:  # radiance is albedo E/(4 pi); in shadow, training may make it larger than possible
            parts.append((scattered * (4 * math.pi * self.exposure)).clamp_max(1.0))
        return active, active.field.lower(active.own, active.geometry, conditions), torch.cat(parts, 1).float()


def choose_look(
    job: ExportJob, conditions: Conditions, per_world: float, scene_from_world: np.ndarray
) -> LookExport | None:
    """Return the sampler of the grids that the options ``emission`` and ``albedo`` request; None if no option is set.

    Raises:
        ConfigError: the colours of the model do not contain emission, or do not contain albedo.
        DataError: the model's header has an impossible exposure.
    """
    names = tuple(name for name in ("emission", "albedo") if job.flag(name))
    if not names:
        return None
    colour, params = job.run.model.colour, job.run.model.params
    own = {spec.name: params[spec.name] for spec in colour.parameters()}
    emitted = colour.isotropic(own, conditions)
    if emitted is None or emitted.shape[1] != 3:
        raise ConfigError(
            f"{names[0]}=true: the colours of this model are not emitted light; expected a task=dynamic run"
        )
    if "albedo" in names and colour.scattering(own) is None:
        raise ConfigError(
            "albedo=true: the colours of this model contain the light; expected a run with scene.lights=4"
        )
    exposure = job.run.header.get("data", {}).get("exposure", 1.0)
    if isinstance(exposure, bool) or not isinstance(exposure, (int, float)) or not 0 < exposure < math.inf:
        raise DataError(f"{job.run.directory}: exposure {exposure!r} in the model's header; expected a number above 0")
    return LookExport(names, float(exposure), per_world, scene_from_world, job.run.settings.threads)


def sample_channels(
    model: Primitives, conditions: Conditions, extinction: VdbGrid, scene_from_world: np.ndarray, threads: int
) -> list[VdbGrid]:
    """Return one grid per channel of the model, with the active voxels of ``extinction``.

    The value of a voxel is the mean of the primitives' values at its centre, weighted by their extinctions.
    """
    with torch.no_grad():
        active = model.to(device.HOST).active(conditions)
        channels = active.field.channels(active.own)
        if not channels:
            return []
        form = active.field.lower(active.own, active.geometry, conditions)
        weights = torch.cat([*channels.values()], 1)
        sums = sum_at_voxels(active, form, weights, extinction, scene_from_world, threads)
    values, grids = _ratio(sums[..., 1:], sums[..., :1]), list[VdbGrid]()
    for name, own in channels.items():
        part, values = (np.ascontiguousarray(x) for x in np.split(values, [own.shape[1]], -1))
        scalar = replace(extinction, name=name, values=part[..., 0].copy(), metadata={})
        grids.append(scalar if own.shape[1] == 1 else vector_grid(name, extinction, part, {}))
    return grids


def sum_at_voxels(
    active: ActivePrimitives,
    form: LoweredDensity,
    weights: Tensor,
    grid: VdbGrid,
    scene_from_world: np.ndarray,
    threads: int,
) -> np.ndarray:
    """Sum values of N primitives at the centres of the active voxels of ``grid``, which has L leaves of 8^3 voxels.

    ``form`` is the closed form of the density. Return (L, 8, 8, 8, 1 + C): the sum of extinctions, then the sums of
    extinctions times ``weights`` (N, C). Inactive voxels have 0.
    """
    values = np.zeros((*grid.masks.shape, 1 + weights.shape[1]), np.float32)
    scene_from_index = scene_from_world @ grid.transform
    for start in range(0, len(values), _LEAVES):
        part = slice(start, start + _LEAVES)
        leaf, *inside = np.nonzero(grid.masks[part])
        index = grid.origins[part][leaf] + np.stack(inside, -1)
        points = torch.from_numpy(index @ scene_from_index[:3, :3].T + scene_from_index[:3, 3])
        sums = weighted_extinctions_at(active, form, points, weights, threads=threads)
        values[part][grid.masks[part]] = sums.numpy()
    return values


def _ratio(sums: np.ndarray, total: np.ndarray) -> np.ndarray:
    ratio: np.ndarray = sums / np.maximum(total, np.finfo(np.float32).tiny)
    return ratio


def vector_grid(name: str, like: VdbGrid, values: np.ndarray, metadata: dict[str, str]) -> VdbGrid:
    """Return an OpenVDB grid of vectors ``values`` (L, 8, 8, 8, 3), with the L leaves and voxels of grid ``like``."""
    tree = (np.zeros(3, np.float32), like.origins, values, like.masks, VdbTiles.none(3))
    return VdbGrid(name, like.transform, *tree, kind="unknown", half=like.half, metadata=metadata)


def choose_velocity(
    job: ExportJob, model: Primitives, frames: Sequence[Conditions], scene_from_world: np.ndarray
) -> VelocityExport | None:
    """Return the sampler of the grid that the option ``velocity`` asks for; None without this option.

    Raises:
        ConfigError: the primitives do not move, or the interval between frames is unknown.
    """
    rate = job.number("fps", 0.1, 240.0)
    if not job.flag("velocity"):
        return None
    active = model.active(frames[0])
    if "time" not in frames[0] or active.geometry is active.stored:
        expected = "a model with motion in model.density.time"
        raise ConfigError(
            f"velocity=true: the primitives of this model do not move; expected {expected}. Omit velocity."
        )
    interval = frame_interval(job.run.header, (float(conditions["time"]) for conditions in frames))
    if interval is None:
        found = "the frame interval is unknown: one frame, and the model has no numbered frames"
        raise ConfigError(f"velocity=true: {found}; expected several frames. Pass a range, such as --time 0:1:48.")
    unit = "world units per frame" if rate is None else "world units per second"
    return VelocityExport(interval * (rate or 1.0), unit, scene_from_world, job.run.settings.threads)


def primitive_velocities(active: ActivePrimitives) -> Tensor:
    """Return the (N, 3) float32 velocities of a frame's primitives, in scene units per unit of the condition "time"."""
    own = {name: value.double() for name, value in active.own.items()}
    stored = active.stored.double()

    def means(step: float) -> Tensor:
        time = active.conditions["time"].double() + step
        return active.field.move(own, stored, {**active.conditions, "time": time}).means

    return ((means(_STEP) - means(-_STEP)) / (2 * _STEP)).float()
