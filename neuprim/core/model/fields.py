"""The two interfaces of the design: a density field and a colour field; the closed forms they lower to are in
:mod:`neuprim.core.model.forms`.

A *field* owns some per-primitive parameters. Before a frame is drawn it *lowers*: conditions such as time or light are
folded into one of a few closed forms that the renderer knows. The renderer never sees a task.
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

from neuprim.core.cameras.projections import AnyCamera
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

if TYPE_CHECKING:
    from neuprim.core.settings import RenderSettings

Conditions = Mapping[str, Tensor]
"""Condition name ("time", "light", a plugin's "wavelength") -> value for one frame."""


@dataclass(frozen=True)
class ConditionSpec:
    """A quantity a frame depends on besides its camera; command-line flags derive from these.

    Attributes:
        name: of the flag, and the key in a frame's conditions.
        range: lowest and highest value of every element. Numbers that are not finite are refused by every command; for
        numbers beyond
            the range there is a warning.
        parse: the text of ``--NAME TEXT`` -> one tensor of ``shape`` per frame of an animation; raises
            :class:`~neuprim.core.errors.ConfigError`. Where ``shape`` is ``()`` it is asked for each element of a list
            ``A,B,C``, and need not know ranges ``A:B:COUNT`` (:mod:`neuprim.core.conditions`).
        strict: whether numbers beyond the range are refused, a data set's among them.
        sweep: a text of ``--NAME TEXT`` that animates the condition, for the commands a report offers; empty: none.
        in_frames: (text, count) -> the text that means the same in so many frames, where the text does not say itself
        how many; None
            where it does. So an animation without a length takes that of another one beside it. Not asked about ranges
            of numbers.
        place: for conditions that are positions: ``parse`` of a text whose numbers are in the world of the user's
        files, (text, world) ->
            values in scene units; see :meth:`within`.
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

    def within(self, world: World) -> ConditionSpec:
        """The condition of a model whose scene lies in ``world``: positions that users write are in the coordinates of
        their files."""
        place = self.place
        return self if place is None or world.identity else replace(self, parse=lambda text: place(text, world))

    def given(self, value: Tensor, world: World) -> Tensor:
        """A value as users write and read it: float64 world coordinates of a position."""
        return value if self.place is None else world.world_points(value)


# ---------------------------------------------------------------- fields


class Field(ABC):
    """Per-primitive parameters with a meaning. Subclasses are final: no field inherits from another.

    ``init_settings`` names the keys of ``model.init`` that the field's initialisers read.
    """

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
        """Compute rows of children created inside their parents.

        Args:
            params: this field's tensors, one row per child, gathered from the parents.
            old: the parents' geometry, one row per child.
            new: the children's geometry.

        Returns:
            tensors of the same shapes, such that each child continues its parent's field inside its own support.
        """
        return dict(params)

    def reductions(self) -> dict[str, tuple[int, ...]]:
        """Return settings that a fitted model can reduce, with the smaller values in descending order, e.g.
        ``{"degree": (2, 1, 0)}``."""
        return {}

    def reduce(self, params: Params, geometry: Geometry, name: str, value: int) -> tuple[Self, dict[str, Tensor]]:
        """Reduce one of :meth:`reductions`: the field and tensors closest to this one's without more training.

        Args:
            params, geometry: of all primitives.
            name, value: a setting, and one of the values that it can have.

        Returns:
            the field, and its tensors by name; with "means" among them where the primitives' centres (N, 3) change with
            it, as they do where a density moves them.
        """
        raise NotImplementedError(
            f"{type(self).__name__} names {name} in reductions() and does not know how to reduce it"
        )

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """List disjoint sets of numbers that single primitives can do without."""
        return ()

    def canonicalize(self, params: Params) -> dict[str, Tensor]:
        """Return equivalent tensors whose numbers lie close together, for quantised files.

        Where several tensors describe the same field, as with the sign of a cosine's argument, choose one of them.
        Images may change by rounding only; a second call changes no bit.
        """
        return dict(params)

    def script(self) -> str | None:
        """JavaScript that folds conditions into the field's closed form as :meth:`DensityField.lower` and
        :meth:`ColourField.lower` do, for pages that draw the model in a browser; docs/plugins.md says what it must
        evaluate to. None: such pages cannot show the field.
        """
        return None


def prunable_units_by_name(density: DensityField, colour: ColourField) -> dict[str, PrunableUnit]:
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

    ``exact_split`` says that children continue their parent's sigma inside their own support (see :meth:`on_split`). A
    family of densities that is too small for that, such as Gaussians, sets it to False; its children must then hold
    their parent's mass, the integral of sigma over space.
    """

    exact_split: bool = True

    @abstractmethod
    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> LoweredDensity:
        """The frame's closed form."""

    @abstractmethod
    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        """Return sigma (M,), 1/scene unit, unclamped, of primitives ``prim`` (M,) at points ``x`` (M, 3) inside
        them."""

    @abstractmethod
    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        """Rows whose density is ``factor`` (rows,) times as large everywhere (a clone in place halves both copies)."""

    def components(self, params: Params) -> dict[str, Tensor]:
        """Return name -> (N,) share, 0..1, of each primitive's extinction that comes from the source grid of that name.

        Only fields fitted to data in which several grids make the extinction have any
        (:attr:`neuprim.core.data.PointSamples.components`).
        Images do not depend on them.
        """
        return {}

    def largest(self, params: Params, geometry: Geometry) -> Tensor | None:
        """Return (N,) upper bounds of sigma over all points and conditions, 1/scene unit; None if unknown."""
        return None

    def active_rows(self, params: Params, conditions: Conditions) -> Tensor | None:
        """Return (M,) ascending int64 rows of active primitives, which can absorb anything under these conditions.

        Inactive primitives are left out before anything else is computed. None: all are active.
        """
        return None

    def move(self, params: Params, geometry: Geometry, conditions: Conditions) -> Geometry:
        """Return the ellipsoids under these conditions; differentiable."""
        return geometry

    def from_gaussians(self, alphas: Tensor) -> tuple[Tensor, Tensor]:
        """How fresh primitives look like Gaussians of opacities ``alphas`` (N,), 0..1: (N,) standard deviations from
        the middle to the edge of the support, and (N,) opacities through the middle. By default those of an ellipsoid
        of constant density with the same covariance.
        """
        return torch.full_like(alphas, math.sqrt(5.0)), alphas

    def divide(self, params: Params, geometry: Geometry) -> tuple[Tensor, dict[str, Tensor], Geometry] | None:
        """Split along a condition instead of in space, for densities that are active in a part of its range.

        Args:
            params: this field's tensors, one row per parent (P rows).
            geometry: the parents'.

        Returns:
            (P,) bool of the parents that are better divided this way; this field's tensors and the geometry of 2 P
            rows, all first halves then all second halves (rows of other parents are ignored). None: never.
        """
        return None


class ColourField(Field):
    """What colour a primitive sends towards the camera."""

    channels: int

    def harmonics(self, params: Params, conditions: Conditions) -> tuple[Tensor, Tensor | None] | None:
        """The colour as :func:`neuprim.core.model.colours.sh.colors` takes it under these conditions, for fields that
        are that: zero-order coefficients (N, C) and those of the higher bands (N, B, C) or None. None for other fields.
        """
        return None

    @abstractmethod
    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> LoweredColour:
        """The frame's closed form."""

    def shade(
        self, geometry: Geometry, density: LoweredDensity, conditions: Conditions, settings: RenderSettings
    ) -> Shading | None:
        """What else the frame's colours are multiplied by. Images drawn for it take their backend and threads from
        ``settings``, those of the frame.
        """
        return None
