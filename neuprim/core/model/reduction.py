"""Reduced models: fields with less of a setting, such as fewer neurons, written ``density.neurons=0``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives

KINDS = ("density", "colour")  # first parts of the names


def reduction_names(density: DensityField, colour: ColourField) -> list[str]:
    """List what fields can reduce, as ``density.neurons``."""
    return [f"{kind}.{name}" for kind, own in zip(KINDS, (density, colour), strict=True) for name in own.reductions()]


def validate_reduction(density: DensityField, colour: ColourField, kind: str, name: str, value: Any) -> int:
    """Return the value if the field of this kind can be reduced to it, or raise ConfigError."""
    field = density if kind == KINDS[0] else colour
    offered = field.reductions()
    if name not in offered:
        what = nearest(f"{kind}.{name}", reduction_names(density, colour)) or "; nothing of this model can be"
        raise ConfigError(f"{kind}.{name}: nothing that {type(field).__name__} can do with less of{what}")
    if isinstance(value, bool) or value not in offered[name]:
        raise ConfigError(
            f"{kind}.{name}={value}: expected {' or '.join(map(str, offered[name]))}, less than the model has"
        )
    return int(value)


def reduce_model(model: Primitives, kind: str, name: str, value: int) -> Primitives:
    """Return the model with one field reduced, as close to the original as possible; what changes is detached."""
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
    """Reduce fields before there is a model, by the overrides of ``model.reduced``, one after the other."""
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
