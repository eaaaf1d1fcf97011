"""Checks of the tensors that fields return; one-line errors name field, tensor, found and expected value.

The checks are needed because compiled kernels do not check bounds, and torch would broadcast wrong shapes. Valid
tensors are dense, float32 or float64 in any mix, and all on one device; strides do not matter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.errors import FormError, NonFiniteError
from neuprim.core.model.fields import (
    ColourField,
    Constant,
    Cosine,
    CustomColour,
    CustomDensity,
    DensityField,
    Field,
    RayNet,
    Shading,
)
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import InitContext, ParameterSpec
from neuprim.core.model.tensors import PrimitiveTensors, Sizes, primitive_tensor_fault

_DENSITIES: tuple[type[PrimitiveTensors], ...] = (Cosine, CustomDensity)
_COLOURS: tuple[type[PrimitiveTensors], ...] = (Constant, RayNet, CustomColour)


def _is_dense_primitive_tensor(value: Any) -> bool:
    kept = isinstance(value, Tensor) and (value.is_cpu or value.device.type in device.DEVICE_TYPES)
    return kept and value.layout is torch.strided


def _describe_model_tensor(value: Any) -> str:
    """Describe a value for messages: dtype, layout, shape and device of a tensor, the type of anything else."""
    if not isinstance(value, Tensor):
        return f"type {type(value).__name__}"
    layout = "" if value.layout is torch.strided else f" {value.layout}"
    return f"{value.dtype}{layout} {tuple(value.shape)} on {value.device}"


# ---------------------------------------------------------------- labels and checks


def model_field_label(kind: str, field: str | None) -> str:
    """Return a field's label for messages, ``"density field Waves"``, or ``"density"`` if ``field`` is None."""
    return kind if field is None else f"{kind} field {field}"


def model_method_label(field: Field, name: str) -> str:
    """Return the label of a field's method for messages, such as ``"density field Waves: on_split"``."""
    return (
        f"{model_field_label('density' if isinstance(field, DensityField) else 'colour', type(field).__name__)}: {name}"
    )


def check_geometry(geometry: Any, who: str, count: int | None = None) -> Sizes:
    """Return the sizes (such as N) that the ellipsoids' tensors share; raise FormError if these tensors do not fit.

    ``count`` is the expected number of ellipsoids, if known. ``who`` names the source of ``geometry`` in messages.
    """
    if not isinstance(geometry, Geometry):
        raise FormError(f"{who} has type {type(geometry).__name__}; expected Geometry")
    sizes: Sizes = {} if count is None else {"N": (count, "the geometry given")}
    fault = geometry.fault(sizes)
    if fault is not None:
        raise FormError(f"{who}: {fault}")
    return sizes


def check_lowered_density(density: Any, sizes: Sizes, field: str | None) -> None:
    """Raise :class:`FormError` unless the density in closed form fits the ``sizes`` from :func:`check_geometry`.
    ``field`` is the class name of the density field, for messages."""
    _check_lowered_form(model_field_label("density", field), density, _DENSITIES, sizes)


def check_lowered_colour(colour: Any, sizes: Sizes, field: str | None) -> None:
    """Raise :class:`FormError` unless the colour in closed form fits the ``sizes`` from :func:`check_geometry`.
    ``field`` is the class name of the colour field, for messages."""
    _check_lowered_form(model_field_label("colour", field), colour, _COLOURS, sizes)


def _check_lowered_form(who: str, form: Any, kinds: tuple[type[PrimitiveTensors], ...], sizes: Sizes) -> None:
    if not isinstance(form, kinds):
        names = ", ".join(k.__name__ for k in kinds[:-1])
        raise FormError(f"{who} lowered to {type(form).__name__}; expected {names} or {kinds[-1].__name__}")
    fault = form.fault(sizes)
    if fault is not None:
        raise FormError(f"{who} lowered to {type(form).__name__}: {fault}")


def check_lowered_channels(found: int, colour: ColourField) -> None:
    """Raise :class:`FormError` unless the closed form of a colour field has the declared number of channels.

    ``found`` is the number of channels in the closed form; ``colour.channels`` is the declared number.
    """
    if found != colour.channels:
        raise FormError(
            f"{model_method_label(colour, 'lower')} returned a colour of C={found}; "
            f"expected {colour.channels}, its attribute channels"
        )


def check_model_tensor_shape(name: str, value: Any, shape: tuple[int, ...], why: str = "") -> None:
    """Raise :class:`FormError` unless ``value`` is a tensor of this shape that a kernel can read."""
    fault = primitive_tensor_fault(value)
    if fault is None and value.shape != shape:
        fault = f"shape {tuple(value.shape)}; expected {shape}{why}"
    if fault is not None:
        raise FormError(f"{name} has {fault}")


def check_active_primitive_rows(rows: Any, model: int | None, who: str, length: int | None = None) -> None:
    """Raise :class:`FormError` unless ``rows`` are ascending int64 indices of primitives, (M,).

    All indices must be below ``model``, the number of primitives. M must be ``length``. None as ``model`` or ``length``
    skips this check.
    """
    found = None
    if not _is_dense_primitive_tensor(rows) or rows.dtype != torch.int64 or rows.dim() != 1:
        found = _describe_model_tensor(rows)
    elif length is not None and len(rows) != length:
        found = f"{len(rows)} rows for {length} primitives"
    elif len(rows):
        numbers = rows.numpy() if rows.is_cpu else rows  # numpy's overhead is a fraction of torch's
        fits = (numbers[0] >= 0) & (numbers[1:] > numbers[:-1]).all()
        if model is not None:
            fits = fits & (numbers[-1] < model)
        if not bool(fits):  # one wait for a GPU
            found = f"rows {rows[:8].tolist()}{' ...' if len(rows) > 8 else ''}"
    if found is not None:
        limit = "" if model is None else f" from 0 to {model - 1}"
        raise FormError(f"{who} {found}; expected ascending int64 rows (M,){limit}")


def check_primitive_field_result(value: Any, shape: tuple[int, ...], who: str) -> Tensor:
    """Return ``value``, a field method's result; raise FormError unless it is a dense real tensor of ``shape``."""
    if not _is_dense_primitive_tensor(value) or not value.is_floating_point():
        kinds = " or ".join(device.DEVICE_TYPES)
        raise FormError(
            f"{who} returned {_describe_model_tensor(value)}; expected a dense tensor of real numbers on the {kinds}"
        )
    if value.shape != shape:
        each = f"a row for each of the {shape[0]} that it was given"
        raise FormError(f"{who} returned shape {tuple(value.shape)}; expected {shape}, {each}")
    return value  # type: ignore[no-any-return]


def check_primitive_shading(found: Any, count: int, who: str) -> Shading:
    """Return the result of a field's ``shade``, with None replaced by an empty :class:`Shading`.

    Raises FormError unless the result fits ``count`` primitives.
    """
    if found is None:
        return Shading()
    if not isinstance(found, Shading):
        raise FormError(f"{who} returned type {type(found).__name__}; expected Shading or None")
    if found.primitives is not None:
        check_primitive_field_result(found.primitives, (count,), f"{who}: primitives")
    return found


def check_initial_primitive_tensor(spec: ParameterSpec, context: InitContext, who: str) -> Tensor:
    """Return the float32 start values (N, *shape) of a parameter, computed by the function ``spec.init``.

    Raises FormError if the function returns another type or shape.
    """
    value, shape = spec.init(context), (context.count, *spec.shape)
    if not isinstance(value, Tensor):
        raise FormError(f"{who}: {spec.name}: init returned type {type(value).__name__}; expected a torch tensor")
    if value.shape != shape:
        raise FormError(f"{who}: {spec.name}: init returned shape {tuple(value.shape)}; expected {shape}")
    return value.float().contiguous()


def check_primitive_tensors(found: Any, like: Mapping[str, Tensor], who: str) -> dict[str, Tensor]:
    """Return ``found``, the tensors that a field's method returned, as a dict.

    Raises FormError unless the names, shapes and dtypes are those in ``like``.
    """
    if not isinstance(found, Mapping):
        raise FormError(f"{who} returned type {type(found).__name__}; expected a dict of tensors by name")
    if set(found) != set(like):
        raise FormError(f"{who} returned tensors {sorted(map(str, found))}; expected {sorted(like)}")
    for name, wanted in like.items():
        fault = primitive_tensor_fault(found[name])
        if fault is None and found[name].shape != wanted.shape:
            fault = f"shape {tuple(found[name].shape)}; expected {tuple(wanted.shape)}"
        if fault is None and found[name].dtype != wanted.dtype:
            fault = f"dtype {found[name].dtype}; expected {wanted.dtype}"
        if fault is not None:
            raise FormError(f"{who}: {name} has {fault}")
    return dict(found)


def non_finite_primitive_error(tensors: Mapping[str, Tensor], row: int) -> NonFiniteError:
    """Return an error that says why primitive ``row`` cannot be rendered.

    The reason is a NaN or infinite value, a zero quaternion, or semi-axes beyond the range of float32.
    """
    for name, value in tensors.items():
        if not bool(torch.isfinite(value[row]).all()):
            return NonFiniteError(f"{name} of primitive {row} is not finite: {value[row].flatten()[:8].tolist()}")
    if not bool(tensors["quats"][row].any()):
        return NonFiniteError(f"quats of primitive {row} is zero; expected a non-zero quaternion")
    scale = tensors["log_scales"][row].tolist()
    return NonFiniteError(
        f"log_scales of primitive {row} is {scale}: the semi-axes or weights leave the range of float32"
    )


def check_primitive_colours_finite(tensors: Mapping[str, Tensor], named: Mapping[str, Tensor] | None = None) -> None:
    """Raise NonFiniteError if a colour in ``tensors`` is NaN or infinite; waits for a GPU.

    The kernels that check primitives do not read colours, so that colours need this check. ``named`` are all tensors of
    the frame; the message names the first tensor that is not finite.
    """
    total = sum(tensor.detach().sum(dtype=torch.float64) for tensor in tensors.values())
    if math.isfinite(total):  # one number, so that a GPU is waited for once
        return
    for value in tensors.values():
        bad = ~torch.isfinite(value).reshape(len(value), -1).all(dim=1)
        if bool(bad.any()):
            raise non_finite_primitive_error(tensors if named is None else named, int(bad.nonzero()[0]))
