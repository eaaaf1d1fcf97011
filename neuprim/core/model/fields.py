"""Density fields and colour fields: the parameters of primitives, and how they *lower* to a closed form.

Before a frame is drawn, conditions such as time or light are folded into one of a few closed forms
(:mod:`neuprim.core.model.forms`) that the renderer knows. The renderer never sees a task.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.cameras.world import World
from neuprim.core.model.forms import (  # noqa: F401 - the forms are part of this interface
    Constant,
    Cosine,
    CustomColour,
    CustomDensity,
    LoweredColour,
    LoweredDensity,
    RayNet,
    Shade,
    Shading,
)
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import ParameterSpec, Params
from neuprim.core.model.sh import lowest_band_colors

if TYPE_CHECKING:
    from neuprim.core.settings import RenderSettings

Conditions = Mapping[str, Tensor]
"""Condition name ("time", "light", a plugin's "wavelength") -> value for one frame."""


@dataclass(frozen=True)
class ConditionSpec:
    """A quantity a frame depends on besides its camera; command-line flags derive from these.

    Attributes:
        name: of the flag, and the key in a frame's conditions.
        range: lowest and highest value of every element. Numbers that are not finite are refused; beyond the range
            there is a warning, or with ``strict`` a refusal.
        parse: the text of ``--NAME TEXT`` -> one tensor of ``shape`` per frame; raises
            :class:`~neuprim.core.errors.ConfigError`. Where ``shape`` is ``()``, lists and ranges are parsed before
            (:mod:`neuprim.core.conditions`).
        sweep: a text of ``--NAME TEXT`` that animates the condition, for the commands a report offers; empty: none.
        in_frames: (text, count) -> the text that means the same in so many frames, if it does not say how many.
        place: for positions: ``parse`` of a text in the world of the user's files, (text, world) -> scene units.
        of_scene: (scene settings) -> whether the views of a scene have the condition.
    """

    name: str
    shape: tuple[int, ...]
    unit: str
    range: tuple[float, float]
    parse: Callable[[str], list[Tensor]]
    strict: bool = False
    sweep: str = ""
    in_frames: Callable[[str, int], str | None] = lambda text, count: None
    place: Callable[[str, World], list[Tensor]] | None = None
    of_scene: Callable[[Mapping[str, Any]], bool] = lambda scene: True

    def within(self, world: World) -> ConditionSpec:
        """The condition of a model in ``world``: users write positions in the coordinates of their files."""
        place = self.place
        return self if place is None or world.identity else replace(self, parse=lambda text: place(text, world))

    def given(self, value: Tensor, world: World) -> Tensor:
        """A value as users write and read it: float64 world coordinates of a position."""
        return value if self.place is None else world.world_points(value)


# ---------------------------------------------------------------- fields


class Field(ABC):
    """Per-primitive parameters with a meaning; ``init_settings``: keys of ``model.init`` that initialisers read."""

    init_settings: tuple[str, ...] = ()

    @abstractmethod
    def parameters(self) -> list[ParameterSpec]:
        """The field's tensors, in storage order."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """JSON-able constructor arguments; ``type(self)(**settings)`` rebuilds the field from a checkpoint header."""

    @classmethod
    def every_parameter(cls) -> list[ParameterSpec]:
        """The parameters that it has at any settings; a preset may give rates for all of them."""
        return cls().parameters()

    def set_progress(self, progress: float) -> None:  # noqa: B027 - a hook most fields do not need
        """Receive the used fraction of the budget, 0..1, before every training step; e.g. to unlock SH bands."""

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        """Compute rows of children created inside their parents, which continue the parents' field.

        Args:
            params: this field's tensors, one row per child, gathered from the parents.
            old, new: the parents' and the children's geometry, one row per child.
        """
        return dict(params)

    def reductions(self) -> dict[str, tuple[int, ...]]:
        """Return settings that a fitted model can reduce, smaller values descending: ``{"degree": (2, 1, 0)}``."""
        return {}

    def reduce(self, params: Params, geometry: Geometry, name: str, value: int) -> tuple[Self, dict[str, Tensor]]:
        """Return the field and tensors closest to this one's with one of :meth:`reductions` applied.

        "means" is among the tensors where the primitives' centres (N, 3) change with it.
        """
        raise NotImplementedError(
            f"{type(self).__name__} names {name} in reductions() and does not know how to reduce it"
        )

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """List disjoint sets of numbers that single primitives can do without."""
        return ()

    def canonicalize(self, params: Params) -> dict[str, Tensor]:
        """Return equivalent tensors whose numbers lie close together, for quantised files.

        Images may change by rounding only; a second call changes no bit.
        """
        return dict(params)

    def script(self) -> str | None:
        """JavaScript that folds conditions into the closed form, for web pages (docs/plugin_reference.md); None: not
        shown there."""
        return None


def prunable_units_of_model(density: DensityField, colour: ColourField) -> dict[str, PrunableUnit]:
    """Return the units of both fields by name, e.g. ``density.neuron 0`` or ``colour.coefficient 1 +0, channel 2``."""
    found = {}
    for kind, own in (("density", density), ("colour", colour)):
        for piece in own.prunable_units():
            found[f"{kind}.{piece.name}"] = piece
    return found


def read_script(package: str, name: str) -> str:
    """Read a field's JavaScript beside its module, ``read_script(__package__, "density.js")``."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


class DensityField(Field):
    """How much light a point absorbs.

    ``exact_split``: children continue their parent's sigma inside their own support. Where a family is too small for
    that, such as Gaussians, they must hold their parent's mass, the integral of sigma over space.
    """

    exact_split: bool = True

    @abstractmethod
    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> LoweredDensity:
        """The frame's closed form."""

    @abstractmethod
    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        """Return sigma (M,), 1/scene unit, unclamped, of primitives ``prim`` (M,) at points ``x`` (M, 3)."""

    @abstractmethod
    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        """Rows whose density is ``factor`` (rows,) times as large everywhere (a clone in place halves both copies)."""

    def components(self, params: Params) -> dict[str, Tensor]:
        """Return name -> (N,) share, 0..1, of each primitive's extinction that comes from a source grid.

        For fields fitted to several grids (:attr:`neuprim.core.data.PointSamples.components`); images do not depend on
        them.
        """
        return {}

    def largest(self, params: Params, geometry: Geometry) -> Tensor | None:
        """Return (N,) upper bounds of sigma over all points and conditions, 1/scene unit; None if unknown."""
        return None

    def active_rows(self, params: Params, conditions: Conditions) -> Tensor | None:
        """Return (M,) ascending int64 rows of primitives that can absorb anything; None: all."""
        return None

    def move(self, params: Params, geometry: Geometry, conditions: Conditions) -> Geometry:
        """Return the ellipsoids under these conditions; differentiable."""
        return geometry

    def from_gaussians(self, alphas: Tensor) -> tuple[Tensor, Tensor]:
        """How fresh primitives look like Gaussians of opacities ``alphas`` (N,): standard deviations from
        middle to edge, and opacities through the middle, (N,) each. By default an ellipsoid of constant density.
        """
        return torch.full_like(alphas, math.sqrt(5.0)), alphas


class ColourField(Field):
    """What colour a primitive sends towards the camera."""

    channels: int

    def harmonics(self, params: Params, conditions: Conditions) -> tuple[Tensor, Tensor | None] | None:
        """Return (N, C) and (N, B, C) or None for :func:`neuprim.core.model.sh.sh_colors`, or None."""
        return None

    def isotropic(self, params: Params, conditions: Conditions) -> Tensor | None:
        """(N, C) the part of the colour, 0 or more, that depends on neither direction nor light: what voxels teach."""
        found = self.harmonics(params, conditions)
        return None if found is None else lowest_band_colors(found[0])

    @abstractmethod
    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> LoweredColour:
        """The frame's closed form."""

    def shade(
        self, geometry: Geometry, density: LoweredDensity, conditions: Conditions, settings: RenderSettings
    ) -> Shading | None:
        """What else the frame's colours are multiplied by; images for it are drawn with the frame's settings."""
        return None
