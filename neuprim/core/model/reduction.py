"""Models that do with less of something (:meth:`~neuprim.core.model.fields.Field.reductions`), and the words for it:
``density.neurons=0``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives

__all__ = ["KINDS", "validate_reduction", "reduce_fields", "reduction_names", "reduce_model"]

KINDS = ("density", "colour")
"""What words begin with."""


def reduction_names(density: DensityField, colour: ColourField) -> list[str]:
    """What fields can do with less of, as ``density.neurons``."""
    return [f"{kind}.{name}" for kind, own in zip(KINDS, (density, colour), strict=True) for name in own.reductions()]


def validate_reduction(density: DensityField, colour: ColourField, kind: str, name: str, value: Any) -> int:
    """The value, if it is one that the field of this kind can be reduced to.

    Raises:
        ConfigError: it is not, or the field has nothing of this name; names what there is.
    """
    own = density if kind == KINDS[0] else colour
    offered = own.reductions()
    if name not in offered:
        what = nearest(f"{kind}.{name}", reduction_names(density, colour)) or "; nothing of this model can be"
        raise ConfigError(f"{kind}.{name}: nothing that {type(own).__name__} can do with less of{what}")
    if isinstance(value, bool) or value not in offered[name]:
        raise ConfigError(
            f"{kind}.{name}={value}: expected {' or '.join(map(str, offered[name]))}, less than the model has"
        )
    return int(value)


def reduce_model(model: Primitives, kind: str, name: str, value: int) -> Primitives:
    """The model whose field of this kind has less of something, as close to the whole as it can be; detached where it
    changes."""
    own = model.density if kind == KINDS[0] else model.colour
    mine = {key: value.detach() for key, value in model.of(own).items()}
    field, fewer = own.reduce(mine, model.geometry, name, value)
    params = {key: value for key, value in model.params.items() if key not in mine} | fewer
    if isinstance(field, DensityField):
        return Primitives(field, model.colour, params)
    assert isinstance(field, ColourField), "a field is reduced to one of its kind"
    return Primitives(model.density, field, params)


def reduce_fields(density: DensityField, colour: ColourField, words: Sequence[str]) -> tuple[DensityField, ColourField]:
    """Fields that do with less, before there is a model.

    Args:
        words: ``model.reduced``, one after the other.

    Raises:
        ConfigError: a word is none, or something that the fields cannot do with less of.
    """
    for word in words:
        place, equals, text = word.partition("=")
        kind, dot, name = place.partition(".")
        if not equals or not dot or kind not in KINDS or not text.isdecimal():
            raise ConfigError(f"model.reduced={word}: expected density.NAME=COUNT or colour.NAME=COUNT")
        try:
            value = validate_reduction(density, colour, kind, name, int(text))
        except ConfigError as error:
            raise ConfigError(f"model.reduced={word}: {error}") from error
        none = torch.zeros(0, 3)
        empty = Geometry(none, none, torch.zeros(0, 4))
        own = density if kind == KINDS[0] else colour
        field, _ = own.reduce({spec.name: torch.zeros(0, *spec.shape) for spec in own.parameters()}, empty, name, value)
        density, colour = (field, colour) if kind == KINDS[0] else (density, field)  # type: ignore[assignment]
    return density, colour
