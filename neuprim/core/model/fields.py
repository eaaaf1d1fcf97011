"""Density and colour fields: a field defines parameters of the primitives, and *lowers* them to a closed form.

To lower means to apply the conditions of a frame, such as time or light, and to return one of a few closed forms
(:mod:`neuprim.core.model.forms`). The renderer knows only these forms, so the renderer does not depend on tasks.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, replace
from importlib import resources
from typing import TYPE_CHECKING, Any, Self

import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.cameras.world import World
from neuprim.core.model.forms import (
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

__all__ = ["ColourField", "ConditionSpec", "Conditions", "DensityField", "Field", "read_script"]
__all__ += ["Constant", "Cosine", "CustomColour", "CustomDensity", "LoweredColour", "LoweredDensity", "RayNet"]
__all__ += ["Shade", "Shading"]

Conditions = Mapping[str, Tensor]
"""Map from the name of a condition to the condition's value in one frame, e.g. ``{"time": tensor(0.5)}``."""


@dataclass(frozen=True)
class ConditionSpec:
    """A condition of a task: an input of every frame besides its camera, such as the time.

    Commands have a flag ``--NAME`` for each condition.

    Attributes:
        name: name of the flag, and the key in a frame's conditions.
        range: lowest and highest value of every element. Values outside the range give a warning, or an error if
            ``strict``; values that are not finite give an error.
        parse: function that converts the text of ``--NAME TEXT`` to one tensor of ``shape`` per frame; raises
            :class:`~neuprim.core.errors.ConfigError`. If the condition is one number, neuprim splits a list and calls
            ``parse`` for each item. If ``parse`` refuses a range, neuprim expands the range itself.
        sweep: a text of ``--NAME`` that animates the condition, for commands in reports; empty for none.
        in_frames: function (text, count) that returns the text of the same animation with ``count`` frames. It returns
            None if the text states a number of frames already.
        place: function used instead of ``parse`` if the condition is a position. It converts (text in world
            coordinates, world) to positions in scene units.
        of_scene: function (scene settings) that returns whether the views of a scene have the condition.
    """

    name: str
    shape: tuple[int, ...]  # shape of the value, () for a number
    unit: str  # unit of the value, for help texts
    range: tuple[float, float]
    parse: Callable[[str], list[Tensor]]
    strict: bool = False  # whether values outside the range are refused
    sweep: str = ""
    in_frames: Callable[[str, int], str | None] = lambda text, count: None
    place: Callable[[str, World], list[Tensor]] | None = None
    of_scene: Callable[[Mapping[str, Any]], bool] = lambda scene: True

    def within(self, world: World) -> ConditionSpec:
        """Return this condition with a ``parse`` that converts positions from ``world`` coordinates to scene units."""
        place = self.place
        return self if place is None else replace(self, parse=lambda text: place(text, world))

    def given(self, value: Tensor, world: World) -> Tensor:
        """Convert ``value`` to the form that users write: float64 world coordinates of a position; else unchanged."""
        return value if self.place is None else world.world_points(value)


# ---------------------------------------------------------------- fields


class Field(ABC):
    """Base class of density and colour fields, which define parameters of each primitive and their meaning."""

    init_settings: tuple[str, ...] = ()  # keys under model.init that the field's start values depend on

    stage: Hashable | None = None
    """State of the field, besides the arguments, that changes what ``lower`` computes, e.g. the number of SH bands.

    While the stage stays the same, training may record a step as a CUDA graph and replay it. None forbids recording. A
    field with a stage must compute with torch operations on the device only, and never wait for the device. Its
    ``lower`` must return zero density for primitives that ``active_rows`` leaves out.
    """

    @abstractmethod
    def parameters(self) -> list[ParameterSpec]:
        """Return the specification of each parameter of this field, in the order of storage."""

    @abstractmethod
    def settings(self) -> dict[str, Any]:
        """Return the constructor's arguments, as values for JSON; ``type(self)(**settings)`` rebuilds the field."""

    @classmethod
    def every_parameter(cls) -> list[ParameterSpec]:
        """Return all parameters that the field can have under any settings.

        Presets may set learning rates for all these parameters.
        """
        return cls().parameters()

    def set_progress(self, progress: float) -> None:  # noqa: B027 - a hook most fields do not need
        """Set the used fraction 0..1 of the training budget; called before every training step.

        A field can use the fraction to activate spherical-harmonics (SH) bands gradually.
        """

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        """Return the parameters of new primitives (children) that replace a split primitive (parent).

        Children lie inside their parent. The field keeps density or colour inside a child unchanged as far as possible.

        Args:
            params: this field's tensors of the parents, one row per child.
            old: geometry of the parents, one row per child.
            new: geometry of the children.
        """
        return dict(params)

    def reductions(self) -> dict[str, tuple[int, ...]]:
        """Return setting name -> smaller values that are possible after training, e.g. ``{"degree": (2, 1, 0)}``."""
        return {}

    def reduce(self, params: Params, geometry: Geometry, name: str, value: int) -> tuple[Self, dict[str, Tensor]]:
        """Return a field whose setting ``name`` has the smaller ``value``, and the parameters that fit best.

        ``name`` and ``value`` are from :meth:`reductions`. The parameters include "means" (N, 3) if the centres of the
        primitives change.
        """
        raise NotImplementedError(
            f"{type(self).__name__}: reductions() lists {name!r}, but the class has no method reduce(); define it"
        )

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Return disjoint groups of parameter elements, such as neurons.

        Pruning may set all elements of a group to zero in any primitive.
        """
        return ()

    def canonicalize(self, params: Params) -> dict[str, Tensor]:
        """Return equivalent parameters whose values span smaller ranges, for quantised files.

        Images may change by rounding only. Applying the method to its own result changes no bit.
        """
        return dict(params)

    def script(self) -> str | None:
        """Return the JavaScript that lowers the field on web pages (docs/plugin_reference.md); None: web pages cannot
        show the field."""
        return None


def prunable_units_of_model(density: DensityField, colour: ColourField) -> dict[str, PrunableUnit]:
    """Return the prunable units of two fields by name: ``density.neuron 0``, ``colour.coefficient 1 +0, channel 2``."""
    found = {}
    for kind, own in (("density", density), ("colour", colour)):
        for piece in own.prunable_units():
            found[f"{kind}.{piece.name}"] = piece
    return found


def read_script(package: str, name: str) -> str:
    """Return a field's JavaScript from a file beside its module: ``read_script(__package__, "density.js")``."""
    return resources.files(package).joinpath(name).read_text(encoding="utf-8")


CHANNEL = "channel_"
"""Prefix of a channel's name where parameters, or components of samples, also have names."""


class DensityField(Field):
    """Base class of density fields: the extinction sigma inside each primitive, 1/scene unit.

    Attributes:
        exact_split: whether the children of a split primitive have their parent's sigma inside their own ellipsoids. If
            False, as for Gaussians, the two children together must have the parent's integral of sigma over space.
    """

    exact_split: bool = True

    @abstractmethod
    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> LoweredDensity:
        """Return the closed form of the density under the conditions of one frame."""

    @abstractmethod
    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        """Return sigma (M,), 1/scene unit, not clamped at 0, of primitives ``prim`` (M,) at one point ``x`` (M, 3)
        each."""

    @abstractmethod
    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        """Return parameters with which the density of each primitive is multiplied by ``factor`` (N,)."""

    def components(self, params: Params) -> dict[str, Tensor]:
        """Return grid name -> (N,) fraction 0..1 of each primitive's extinction that comes from this voxel grid.

        Only fields fitted to several voxel grids have components (:attr:`neuprim.core.data.PointSamples.components`).
        Images do not depend on the fractions.
        """
        return {}

    def channels(self, params: Params) -> dict[str, Tensor]:
        """Return channel name -> (N, C) values of each primitive, e.g. its temperature (C = 1) or velocity (C = 3).

        A channel is a grid of the training data besides the extinction. Images do not depend on channels.
        """
        return {}

    def largest(self, params: Params, geometry: Geometry) -> Tensor | None:
        """Return an (N,) upper bound of each primitive's sigma, 1/scene unit, over all points and conditions.

        None if no bound is known.
        """
        return None

    def active_rows(self, params: Params, conditions: Conditions) -> Tensor | None:
        """Return ascending int64 indices (M,) of the primitives with non-zero extinction, or None for all."""
        return None

    def move(self, params: Params, geometry: Geometry, conditions: Conditions) -> Geometry:
        """Return the ellipsoids under the conditions of a frame, e.g. moved to another place; differentiable."""
        return geometry

    def from_gaussians(self, alphas: Tensor) -> tuple[Tensor, Tensor]:
        """Return the (N,) sizes and opacities of primitives that replace Gaussians with the opacities ``alphas`` (N,).

        A size is the distance from centre to edge in standard deviations of the Gaussian. An opacity holds for a ray
        through the centre. The default implementation suits a constant density.
        """
        return torch.full_like(alphas, math.sqrt(5.0)), alphas


class ColourField(Field):
    """Base class of colour fields: the colour that each primitive sends to the camera."""

    channels: int  # number of channels of the images

    def harmonics(self, params: Params, conditions: Conditions) -> tuple[Tensor, Tensor | None] | None:
        """Return the spherical-harmonics coefficients of the colours, ``dc`` (N, C) and ``rest`` as for
        :func:`~neuprim.core.model.sh.sh_colors`; None for fields whose colours are no spherical harmonics."""
        return None

    def isotropic(self, params: Params, conditions: Conditions) -> Tensor | None:
        """Return the (N, C) part of the colours, at least 0, that depends on neither view direction nor light.

        None if the field has no such part.
        """
        found = self.harmonics(params, conditions)
        return None if found is None else lowest_band_colors(found[0])

    def scattering(self, params: Params) -> Tensor | None:
        """Return the (N, C) radiance that primitives scatter per unit of irradiance from a light.

        None if the field does not separate scattered light from the rest of the colour.
        """
        return None

    @abstractmethod
    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> LoweredColour:
        """Return the closed form of the colour for one camera, under the conditions of one frame."""

    def shade(
        self,
        geometry: Geometry,
        density: LoweredDensity,
        camera: AnyCamera,
        conditions: Conditions,
        settings: RenderSettings,
    ) -> Shading | None:
        """Return additional factors on the colours of a frame, such as shadows, or None for no factors."""
        return None
