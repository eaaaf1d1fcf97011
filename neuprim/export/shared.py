"""Helpers shared by export formats: colours as spherical harmonics, a model's bounding box, comparison views."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at, orbit
from neuprim.core.data import View
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.extensions import ExportJob, TrainedModel
from neuprim.core.model import sh
from neuprim.core.model.fields import Conditions

AXES_TO_GLTF = {
    "z": np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]]),
    "-z": np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]]),
    "y": np.eye(4),
    "-y": np.diag([1.0, -1, -1, 1]),
}
"""Upward axis of the data -> (4, 4) rotation about x to glTF's axes, in which y is up."""


def closest_up_axis(up: Tensor) -> str:
    """Return which of the axes y, z, -y and -z is closest to an upward direction (3,); USD and glTF know no x."""
    axis = max((1, 2), key=lambda a: (abs(float(up[a])), a))
    return ("-" if up[axis] < 0 else "") + "xyz"[axis]


def gltf_up_notes(up: str) -> list[str]:
    """Return a note if data with the upward axis ``up`` are turned to glTF's axes."""
    back = "; Blender and others turn it back" if up == "z" else ""
    return [] if up == "y" else [f"turned from {up} up to glTF's y up{back}"]


def upside_down_usd_notes(up: str) -> list[str]:
    """Return a note if the upward axis ``up`` of the data is -y or -z, which a USD stage cannot state."""
    turn = f"up is {up} in the data, USD knows only y and z: turn the stage by 180 degrees about x"
    return [turn] if up.startswith("-") else []


_DEGREE = 3
_DIRECTIONS = 64
_VIEWS, _SIZE = 8, 160


class ExportHarmonics:
    """Colours of M primitives as spherical harmonics of the direction of view: max(0, SH(direction) + 1/2).

    The primitives are those that are active under some conditions.

    Attributes:
        dc: (M, C) float64 coefficients of degree 0, in the convention of 3D Gaussian splatting.
        rest: (M, 15, C) float64 coefficients of degrees 1 to 3, in the same convention.
        residual: RMS error of the fit over directions and primitives; 0.0 if the model's colours are harmonics.
    """

    def __init__(self, dc: Tensor, rest: Tensor | None, residual: float) -> None:
        bands = sh.sh_coefficient_count(_DEGREE) - 1
        full = torch.zeros(len(dc), bands, dc.shape[1], dtype=torch.float64)
        if rest is not None:
            full[:, : rest.shape[1]] = rest
        self.dc, self.rest, self.residual = dc.double(), full, residual

    def evaluate(self, rows: Tensor, directions: Tensor) -> Tensor:
        """Return (P, C) colours of primitives ``rows`` (P,) along unit ``directions`` (P, 3), camera to primitive."""
        basis = sh.sh_basis(directions.double(), _DEGREE)
        mixed = basis[:, :1] * self.dc[rows] + (basis[:, 1:, None] * self.rest[rows]).sum(1)
        return (mixed + 0.5).clamp_min(0.0)

    def rotate(self, rotation: Tensor | None) -> ExportHarmonics:
        """Return these colours after the axes are rotated by ``rotation`` (3, 3) or None; exact in each SH band."""
        if rotation is None:
            return self
        directions = fibonacci_sphere(_DIRECTIONS)
        after, before = (sh.sh_basis(d, _DEGREE)[:, 1:] for d in (directions @ rotation.T, directions))
        rest = torch.einsum("bk,nkc->nbc", torch.linalg.pinv(after) @ before, self.rest)
        return ExportHarmonics(self.dc, rest, self.residual)

    def select_channels(self, channels: tuple[int, ...]) -> ExportHarmonics:
        """Return the harmonics of the given channels only, in the given order."""
        index = list(channels)
        return ExportHarmonics(self.dc[:, index], self.rest[:, :, index], self.residual)


def find_export_rgb_channels(run: TrainedModel, hint: str = "") -> tuple[int, int, int]:
    """Return the indices of a model's red, green and blue channels; three equal indices for a grey model.

    Raises:
        ConfigError: the model is neither coloured nor grey; ``hint`` is inserted into the message.
    """
    channels = run.channels
    if channels.rgb is None:
        found = f"{run.directory}: the model has {channels.count} channels, {channels.name_list}"
        expected = f"this format stores red, green and blue{hint}; --format ply and npz hold all channels"
        raise ConfigError(f"{found}; {expected}")
    return channels.rgb


def fit_export_harmonics(run: TrainedModel, conditions: Conditions) -> ExportHarmonics:
    """Return a model's colours under some conditions as spherical harmonics.

    The result is exact if the colour field consists of spherical harmonics. Otherwise, degree 3 is fitted by least
    squares to the colours at the primitives' centres, seen from far away in 64 directions.

    Raises:
        ConfigError: the colour field does not give one colour per primitive.
    """
    model = run.model
    with torch.no_grad():
        params = model.active(conditions).params
        exact = model.colour.harmonics({spec.name: params[spec.name] for spec in model.colour.parameters()}, conditions)
        if exact is not None:
            return ExportHarmonics(exact[0], exact[1], 0.0)
        directions = fibonacci_sphere(_DIRECTIONS)
        seen = torch.stack([_export_colours_from_afar(run, conditions, d) for d in directions], 1)  # (M, V, C)
        basis = sh.sh_basis(directions, _DEGREE)
        fitted = torch.einsum("bv,nvc->nbc", torch.linalg.pinv(basis), seen - 0.5)
        residual = float((torch.einsum("vb,nbc->nvc", basis, fitted) + 0.5 - seen).square().mean().sqrt())
        return ExportHarmonics(fitted[:, 0], fitted[:, 1:], residual)


def _export_colours_from_afar(run: TrainedModel, conditions: Conditions, direction: Tensor) -> Tensor:
    """Return (M, C) float64 colours at the primitives' centres, all seen from far away along one direction."""
    means = run.model.params["means"].double()
    middle = means.mean(0)
    reach = float((means - middle).norm(dim=-1).max()) + 1.0
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    camera = Camera(look_at(middle - 1e4 * reach * direction, middle, up), 1e4, 1e4, 32, 32, 64, 64)
    lowered = run.model.lower(camera, conditions, run.settings)
    if not lowered.colour.per_primitive:
        form = type(lowered.colour).__name__
        raise ConfigError(
            f"{run.directory}: colours of the form {form} have no value per primitive; expected --format ply or npz"
        )
    return lowered.center_colors(camera.position).double()


def fibonacci_sphere(count: int) -> Tensor:
    """Return (count, 3) float64 unit vectors spread evenly (a Fibonacci lattice)."""
    i = torch.arange(count, dtype=torch.float64)
    z = 1 - (2 * i + 1) / count
    turn = i * math.pi * (3 - math.sqrt(5))
    r = (1 - z * z).sqrt()
    return torch.stack([r * turn.cos(), r * turn.sin(), z], -1)


def choose_export_views(job: ExportJob, which: str, conditions: Conditions) -> tuple[list[View], str]:
    """Choose at most eight views to compare an export with its model; return the views and their description.

    Args:
        which: "test" for cameras of the scene, "orbit" around the model, or "auto". "auto" takes test cameras if the
            model has no conditions (such scenes load quickly) and the scene can be read, else an orbit.
    """
    if which == "test" or (which == "auto" and not job.run.task.conditions):
        try:
            views = job.run.dataset().test
            picks = sorted({round(i * (len(views) - 1) / (_VIEWS - 1)) for i in range(_VIEWS)})
            return [replace(views.view(i), conditions=conditions) for i in picks], f"{len(picks)} test views"
        except NeuprimError:
            if which == "test":
                raise
    with torch.no_grad():
        geometry, _ = job.run.model.lower_density(conditions)
    means = geometry.means.double()
    low, high = (torch.quantile(means[:100_000], q, dim=0) for q in (0.02, 0.98))
    middle, reach = (low + high) / 2, float((high - low).norm()) / 2 + float(geometry.scales.median())
    focal = 0.5 * _SIZE / math.tan(math.radians(20))
    template = Camera(torch.eye(4, dtype=torch.float64), focal, focal, _SIZE / 2, _SIZE / 2, _SIZE, _SIZE)
    cameras = orbit(template, middle, torch.tensor([0.0, 0.0, 1.0]), 3.0 * reach, math.radians(25), _VIEWS)
    return [View(f"orbit_{i}", c, conditions) for i, c in enumerate(cameras)], f"{_VIEWS} orbit views"


def find_export_box(job: ExportJob, frames: Sequence[Conditions]) -> tuple[Tensor, Tensor]:
    """Return the bounding box of the active ellipsoids in all frames: lower and upper corner (3,) float64, scene units.

    Raises:
        ConfigError: no primitive is active in any of the frames.
    """
    lows, highs = [], []
    with torch.no_grad():
        for conditions in frames:
            geometry, _ = job.run.model.lower_density(conditions)
            if geometry.count:
                reach = (geometry.rotations.double() * geometry.scales.double()[:, None, :]).norm(dim=-1)
                lows.append((geometry.means.double() - reach).min(0).values)
                highs.append((geometry.means.double() + reach).max(0).values)
    if not lows:
        raise ConfigError(f"{job.run.directory}: no primitive is active under these conditions; nothing to export")
    return torch.stack(lows).min(0).values, torch.stack(highs).max(0).values
