"""The model: ellipsoids and the parameters of a density field and a colour field, one row per primitive."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.compute import device
from neuprim.core.errors import ConfigError, FormError, NonFiniteError, nearest
from neuprim.core.model.checks import (
    check_active_primitive_rows,
    check_geometry,
    check_initial_primitive_tensor,
    check_lowered_channels,
    check_lowered_colour,
    check_lowered_density,
    check_model_tensor_shape,
    check_primitive_field_result,
    check_primitive_shading,
    model_field_label,
    model_method_label,
    non_finite_primitive_error,
)
from neuprim.core.model.fields import ColourField, Conditions, DensityField, LoweredColour, LoweredDensity, Shade
from neuprim.core.model.geometry import GEOMETRY_SPECS, Geometry, PrimitiveChords
from neuprim.core.model.schema import InitContext, ParameterSpec
from neuprim.core.model.tensors import Sizes, function_fault
from neuprim.core.settings import RenderSettings

__all__ = ["ActivePrimitives", "LoweredPrimitives", "Primitives"]


@dataclass(frozen=True)
class LoweredPrimitives:
    """The renderer's input for one frame: ellipsoids with their density and colour in closed form.

    Closed forms are formulas of :mod:`neuprim.core.model.forms`. Each formula is valid for one frame, because the
    fields have already applied the frame's conditions, such as the time.
    """

    geometry: Geometry
    density: LoweredDensity
    colour: LoweredColour
    rows: Tensor | None = None  # (M,) int64 rows of these primitives in the model; None for all
    shade: Shade | None = None  # factor on each pixel, see ColourField.shade
    fields: tuple[str, str] | None = None  # class names of the fields, for messages

    def check(self, viewmat: Any = None, background: Any = None) -> None:
        """Raise FormError for tensors of wrong type, shape or device.

        Also check ``viewmat`` (4, 4) and ``background`` (C,).
        """
        density, colour = self.fields or (None, None)
        sizes = check_geometry(self.geometry, "geometry")
        check_lowered_density(self.density, sizes, density)
        check_lowered_colour(self.colour, sizes, colour)
        if self.rows is not None:
            check_active_primitive_rows(self.rows, None, "LoweredPrimitives.rows holds", sizes["N"][0])
        self.check_frame(viewmat, background)

    def check_finite(self) -> None:
        """Raise NonFiniteError for the first primitive that cannot be rendered.

        Such a primitive has a NaN or infinite value, a zero quaternion, or semi-axes beyond the range of float32. The
        kernels of the backends make the same check while they prepare a frame.
        """
        g = self.geometry
        if not g.count:
            return
        tensors = {"means": g.means, "log_scales": g.log_scales, "quats": g.quats}
        tensors |= self.density.tensors() | self.colour.tensors()
        with torch.no_grad():
            logs = g.log_scales.double()
            top = logs.amax(dim=-1)
            bad = (g.quats == 0).all(dim=-1) | (top.exp() > torch.finfo(torch.float32).max) | (top.exp() == 0)
            bad |= ((logs - top[:, None]).exp() == 0).any(dim=-1)
            for value in tensors.values():
                if value.numel():
                    bad |= ~torch.isfinite(value.reshape(g.count, -1)).all(dim=1)
            if bool(bad.any()):
                raise non_finite_primitive_error(tensors, int(bad.nonzero()[0]))

    def check_frame(self, viewmat: Any, background: Any) -> None:
        """Raise FormError if ``shade``, ``background`` (C,), ``viewmat`` (4, 4) or the devices of tensors are invalid.

        :meth:`Primitives.lower` checks everything else.
        """
        if self.shade is not None and (fault := function_fault(self.shade)) is not None:
            raise FormError(f"{self.owner('colour')}: shade has {fault} or None")
        if background is not None:
            channels = self.colour.channels
            check_model_tensor_shape(
                "background", background, (channels,), f", as {self.source('colour')} has C={channels}"
            )
        if viewmat is not None:
            check_model_tensor_shape("viewmat", viewmat, (4, 4))
        self._check_devices(viewmat)

    def _check_devices(self, viewmat: Tensor | None) -> None:
        where = self.geometry.means.device
        if viewmat is not None and not viewmat.is_cpu and viewmat.device != where:
            raise FormError(f"viewmat has device {viewmat.device}; expected {where}, the device of means, or cpu")
        for kind, form in (("density", self.density), ("colour", self.colour), ("geometry", self.geometry)):
            for name, value in form.tensors().items():
                if value.device != where:
                    who = kind if kind == "geometry" else self.source("density" if kind == "density" else "colour")
                    raise FormError(f"{who}: {name} has device {value.device}; expected {where}, the device of means")

    @property
    def kind(self) -> str:
        """Kind of device of the tensors: "cpu" or "cuda"."""
        return self.geometry.means.device.type

    @property
    def movable(self) -> bool:
        """Whether :meth:`to` can move the tensors to another device; False if density or colour is custom code."""
        return self.density.movable and self.colour.movable

    def to(self, device: torch.device) -> LoweredPrimitives:
        """Return a copy on another device, without ``rows`` and ``shade``; differentiable. Needs :attr:`movable`."""
        return LoweredPrimitives(
            self.geometry.to(device), self.density.to(device), self.colour.to(device), fields=self.fields
        )

    def owner(self, kind: Literal["density", "colour"]) -> str:
        """Return the label of the density or colour field for messages, such as ``"density field Waves"``."""
        return model_field_label(kind, None if self.fields is None else self.fields[kind == "colour"])

    def source(self, kind: Literal["density", "colour"]) -> str:
        """Return a label of field and closed form for messages, ``"density field Waves lowered to Cosine"``."""
        return f"{self.owner(kind)} lowered to {type(getattr(self, kind)).__name__}"

    def center_colors(self, position: Tensor) -> Tensor:
        """Return the (M, C) colours at the centres of the M primitives for a camera at ``position`` (3,)."""
        found = self.colour.at_primitive_centers(self.geometry, position)
        return check_primitive_field_result(
            found, (self.geometry.count, self.colour.channels), f"{self.source('colour')}: radiance"
        )

    def optical_depth(self, pairs: PrimitiveChords) -> Tensor:
        """Return the (M,) float64 optical depths of M chords: integrals of the extinction sigma, not clamped at 0."""
        found = self.density.optical_depth(pairs)
        return check_primitive_field_result(found, (len(pairs),), f"{self.source('density')}: line_integral").double()

    def chord_colours(self, pairs: PrimitiveChords) -> Tensor:
        """Return the (M, C) float64 colours that M chords send to the camera, one colour per chord."""
        found = self.colour.chord_colours(pairs)
        return check_primitive_field_result(
            found, (len(pairs), self.colour.channels), f"{self.source('colour')}: radiance"
        ).double()


@dataclass(frozen=True)
class ActivePrimitives:
    """The M active primitives of a frame, whose extinction is not zero under the frame's conditions."""

    field: DensityField
    conditions: Conditions
    rows: Tensor | None  # (M,) int64 rows of the model, ascending; None for all
    params: dict[str, Tensor]  # all parameters of these primitives
    own: dict[str, Tensor]  # parameters of the density field
    stored: Geometry  # ellipsoids as the model stores them
    geometry: Geometry  # ellipsoids under the conditions of the frame, e.g. moved

    def sigma(self, prim: Tensor, x: Tensor) -> Tensor:
        """Return the extinction sigma (P,), 1/scene unit, not clamped at 0, at the points ``x`` (P, 3).

        ``prim`` (P,) gives the primitive of each point, as an index into the active primitives.
        """
        found = self.field.density(self.own, self.stored, prim, x, self.conditions)
        return check_primitive_field_result(found, (len(prim),), model_method_label(self.field, "density"))


class Primitives:
    """A model: N primitives with a density field and a colour field.

    Attributes:
        density: the density field.
        colour: the colour field.
        specs: specifications of all parameters, geometry first.
        params: name -> (N, *shape) tensor, in the order of ``specs``. Other names and shapes are a ValueError.
    """

    def __init__(self, density: DensityField, colour: ColourField, params: Mapping[str, Tensor]) -> None:
        self.density, self.colour = density, colour
        own, painted = density.parameters(), colour.parameters()
        self.specs: tuple[ParameterSpec, ...] = (*GEOMETRY_SPECS, *own, *painted)
        self._names = tuple(s.name for s in own), tuple(s.name for s in painted)
        names = [s.name for s in self.specs]
        if len(set(names)) != len(names) or set(names) != set(params):
            raise ValueError(f"parameters {sorted(params)} do not match the specs {sorted(names)}")
        self.params: dict[str, Tensor] = {n: params[n] for n in names}
        if self.params["means"].dim() != 2:
            raise ValueError(f"parameter means has shape {tuple(self.params['means'].shape)}, expected (N, 3)")
        for spec in self.specs:
            found, expected = tuple(self.params[spec.name].shape), (self.count, *spec.shape)
            if found != expected:
                raise ValueError(f"parameter {spec.name} has shape {found}, expected {expected}")

    @classmethod
    def initialise(cls, density: DensityField, colour: ColourField, context: InitContext) -> Primitives:
        """Return a new model whose parameters have their start values; raise FormError if their shapes are wrong."""
        own = [("starting points", spec) for spec in GEOMETRY_SPECS]
        own += [
            (model_method_label(field, "parameters"), spec)
            for field in (density, colour)
            for spec in field.parameters()
        ]
        return cls(
            density, colour, {spec.name: check_initial_primitive_tensor(spec, context, who) for who, spec in own}
        )

    @property
    def count(self) -> int:
        return int(self.params["means"].shape[0])

    @property
    def device(self) -> torch.device:
        """Device of the tensors."""
        return self.params["means"].device

    @property
    def parameters_per_primitive(self) -> int:
        return sum(s.size for s in self.specs)

    @property
    def geometry(self) -> Geometry:
        return Geometry(self.params["means"], self.params["log_scales"], self.params["quats"])

    def of(self, field: DensityField | ColourField) -> dict[str, Tensor]:
        """Return parameter name -> tensor for the parameters of ``field``, the model's density or colour field."""
        return self._of(field, self.params)

    def _of(self, field: DensityField | ColourField, params: dict[str, Tensor]) -> dict[str, Tensor]:
        """Return the entries of ``params`` (name -> tensor, for the whole model) that belong to ``field``."""
        return {name: params[name] for name in self._names[field is self.colour]}

    def lower(
        self, camera: AnyCamera, conditions: Conditions, settings: RenderSettings | None = None, shaded: bool = True
    ) -> LoweredPrimitives:
        """Return the renderer's input for one frame: ellipsoids, density and colour in closed form; differentiable.

        The result has only the primitives with extinction in this frame. On a GPU, the result has all primitives if the
        density field has a :attr:`~neuprim.core.model.fields.Field.stage`.

        Args:
            settings: settings for images that the colour field itself renders, such as shadow maps; None: the defaults.
            shaded: whether to apply the factors (shadows) of :meth:`~neuprim.core.model.fields.ColourField.shade`.

        Raises:
            FormError: a field returned tensors of a wrong type, shape or device.
        """
        # a GPU renders primitives without extinction faster than it counts the others
        everything = self.density.stage is not None and device.on_warp(self.params["means"])
        active = self.active(conditions, everything=everything)
        geometry, (density, sizes) = (
            active.geometry,
            self._lower_density(active),
        )  # before the colour, which may render it
        own = self._of(self.colour, active.params)
        colour = self.colour.lower(own, geometry, camera, conditions)
        names = (type(self.density).__name__, type(self.colour).__name__)
        check_lowered_colour(colour, sizes, names[1])
        check_lowered_channels(sizes["C"][0], self.colour)
        found = None
        if shaded:
            found = self.colour.shade(geometry, density, camera, conditions, settings or RenderSettings())
        shading = check_primitive_shading(found, geometry.count, model_method_label(self.colour, "shade"))
        colour = colour.shaded(shading.primitives)
        return LoweredPrimitives(geometry, density, colour, active.rows, shading.pixels, names)

    def lower_density(self, conditions: Conditions) -> tuple[Geometry, LoweredDensity]:
        """Return ellipsoids, and density in closed form, of a frame's active primitives (those with extinction)."""
        active = self.active(conditions)
        return active.geometry, self._lower_density(active)[0]

    def _lower_density(self, active: ActivePrimitives) -> tuple[LoweredDensity, Sizes]:
        """Return the checked closed form of the density, and the sizes (such as N) of the density's tensors.

        Raises FormError for invalid tensors.
        """
        sizes = check_geometry(active.geometry, "geometry")
        try:
            density = self.density.lower(active.own, active.geometry, active.conditions)
        except FormError as error:  # from a sum of forms, which does not know the field
            raise FormError(f"{model_method_label(self.density, 'lower')}: {error}") from error
        check_lowered_density(density, sizes, type(self.density).__name__)
        return density, sizes

    def component(self, name: str) -> Primitives:
        """Return a model with only the extinction that comes from one voxel grid of the training data.

        ``name`` is the name of the grid. Raises KeyError if the density field does not know the grid.
        """
        own = {key: value.detach() for key, value in self.of(self.density).items()}
        scaled = self.density.scale_density(own, self.density.components(own)[name])
        return Primitives(self.density, self.colour, {**self.params, **scaled})

    @torch.no_grad()
    def limit(self, largest: float, when: Tensor | None = None) -> None:
        """Scale the densities of primitives in place, so that none exceeds the extinction ``largest``, 1/scene unit.

        Nothing changes if the density field knows no upper bound, or if ``when``, a (1,) bool on the device, is False.
        """
        own = self.of(self.density)
        found = self.density.largest(own, self.geometry)
        if found is None:
            return
        scaled = self.density.scale_density(own, (largest / found).clamp_max(1))
        for name, value in scaled.items():
            if value is not own[name]:
                own[name].copy_(value if when is None else torch.where(when, value, own[name]))

    def active(
        self, conditions: Conditions, dtype: torch.dtype | None = None, everything: bool = False
    ) -> ActivePrimitives:
        """Return a frame's active primitives, which have extinction; differentiable unless ``dtype`` is given.

        With ``dtype``, tensors are detached and converted. With ``everything``, the result has all primitives.
        """
        rows = None if everything else self.density.active_rows(self.of(self.density), conditions)
        params = self.params
        if rows is not None:
            from neuprim.core.model.rows import take_primitive_rows  # numba, loaded when first needed

            check_active_primitive_rows(rows, self.count, f"{model_method_label(self.density, 'active_rows')} returned")
            params = take_primitive_rows(params, rows)
        if dtype is not None:
            params = {name: value.detach().to(dtype) for name, value in params.items()}
            conditions = {name: value.to(dtype) for name, value in conditions.items()}
        own = self._of(self.density, params)
        stored = Geometry(params["means"], params["log_scales"], params["quats"])
        moved = self.density.move(own, stored, conditions)
        if moved is not stored:
            check_geometry(moved, model_method_label(self.density, "move"), stored.count)
        return ActivePrimitives(self.density, conditions, rows, params, own, stored, moved)

    def to(self, device: torch.device) -> Primitives:
        """Return a copy of the model on another device, without gradients; ``self`` if it is on ``device`` already."""
        if self.device == device:
            return self
        return Primitives(
            self.density, self.colour, {name: value.detach().to(device) for name, value in self.params.items()}
        )

    def rows(self, index: Tensor) -> dict[str, Tensor]:
        """Return parameter name -> detached copy of the values of the primitives ``index``, for all parameters."""
        return {name: value.detach()[index].clone() for name, value in self.params.items()}

    def check_finite(self, what: str = "parameter") -> None:
        """Raise :class:`NonFiniteError` naming the first parameter and primitive that is NaN or infinite."""
        for name, value in self.params.items():
            if value.numel() and not bool(torch.isfinite(value.detach().sum())):
                bad = ~torch.isfinite(value.detach()).reshape(self.count, -1).all(dim=1)
                if bool(bad.any()):
                    row = int(bad.nonzero()[0])
                    raise NonFiniteError(
                        f"{what} {name} of primitive {row} is not finite: {value.detach()[row].flatten()[:8].tolist()}"
                    )


KINDS = ("density", "colour")  # first parts of the names of reductions


def reduction_names(density: DensityField, colour: ColourField) -> list[str]:
    """List the settings of two fields that can be reduced after training, such as ``density.neurons``."""
    return [f"{kind}.{name}" for kind, own in zip(KINDS, (density, colour), strict=True) for name in own.reductions()]


def validate_reduction(density: DensityField, colour: ColourField, kind: str, name: str, value: Any) -> int:
    """Return ``value`` if a setting can be reduced to this value; otherwise raise ConfigError.

    ``kind`` selects the field, "density" or "colour"; ``name`` is the setting, e.g. "neurons".
    """
    field = density if kind == KINDS[0] else colour
    offered = field.reductions()
    if name not in offered:
        what = nearest(f"{kind}.{name}", reduction_names(density, colour)) or "; this model has none"
        raise ConfigError(
            f"{kind}.{name}: {type(field).__name__} has no setting of this name that can be reduced{what}"
        )
    if isinstance(value, bool) or value not in offered[name]:
        raise ConfigError(f"{kind}.{name}={value}: expected a reduced value: {' or '.join(map(str, offered[name]))}")
    return int(value)


def reduce_model(model: Primitives, kind: str, name: str, value: int) -> Primitives:
    """Return the model with a setting of one field, e.g. its number of neurons, reduced to ``value``.

    ``kind`` selects the field, "density" or "colour"; ``name`` is the setting. The field chooses new parameters
    that approximate the original field. Changed tensors are detached.
    """
    own = model.density if kind == KINDS[0] else model.colour
    tensors = {key: value.detach() for key, value in model.of(own).items()}
    field, reduced = own.reduce(tensors, model.geometry, name, value)
    params = {key: value for key, value in model.params.items() if key not in tensors} | reduced
    if isinstance(field, DensityField):
        return Primitives(field, model.colour, params)
    assert isinstance(field, ColourField), "a field is reduced to one of its kind"
    return Primitives(model.density, field, params)


def reduce_fields(
    density: DensityField, colour: ColourField, overrides: Sequence[str]
) -> tuple[DensityField, ColourField]:
    """Return both fields after applying the reductions ``overrides``, such as ``"density.neurons=4"``, in order.

    ``overrides`` is the setting ``model.reduced``. Only the fields change, because a model has no parameters yet.
    Raises ConfigError for an invalid text.
    """
    for word in overrides:
        key, equals, text = word.partition("=")
        kind, dot, name = key.partition(".")
        if not equals or not dot or kind not in KINDS or not text.isdecimal():
            raise ConfigError(f"model.reduced={word}: expected density.NAME=COUNT or colour.NAME=COUNT")
        try:
            value = validate_reduction(density, colour, kind, name, int(text))
        except ConfigError as error:
            raise ConfigError(f"model.reduced={word}: {error}") from error
        empty = Geometry(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0, 4))
        own = density if kind == KINDS[0] else colour
        tensors = {spec.name: torch.zeros(0, *spec.shape) for spec in own.parameters()}
        field, _ = own.reduce(tensors, empty, name, value)
        density, colour = (field, colour) if kind == KINDS[0] else (density, field)  # type: ignore[assignment]
    return density, colour
