"""A model as sections of codes, and what training may use of the same: ``Primitives`` -> schemes -> codes -> bytes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compression.bits import BitTable
from neuprim.core.compression.columns import MOST_BITS, Columns, even_columns, fit_columns, keep_zero, spread_error
from neuprim.core.compression.order import morton
from neuprim.core.compression.rotations import LEAST_BITS, Rotations
from neuprim.core.compression.sections import COLUMNS, POSITIONS, ROTATIONS, Section, pack, pack_rows, pack_sparse
from neuprim.core.errors import CheckpointError, FormError
from neuprim.core.model.checks import method
from neuprim.core.model.fields import prunable_units_by_name
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import nonzero_rows

__all__ = [
    "Schemes",
    "Stored",
    "bits_in_words",
    "encode",
    "file_order",
    "folded",
    "rounded",
    "schemes",
    "schemes_within",
]

Schemes = dict[str, Columns | Rotations]
"""Parameter -> how its numbers are coded."""


@dataclass(frozen=True)
class Stored:
    """What a file has of a parameter: bits of a number, as text, and bytes."""

    bits: str
    size: int


_SPIKY = 12.0
"""Columns whose error is more times the usual one than this get twice the bits: a few of their numbers lie far from all
others."""

_LABEL = 16
"""Bits of a number that is not learned, at every level: it tells one thing from another, and half of it says
nothing."""

_WORTH_A_MASK = 0.02
"""Share of the primitives without a piece from which on a bit for each says so."""

_FINE = 50.0
"""Steps of a position in the median of the primitives' longest semi-axes, at least."""


def folded(model: Primitives) -> Primitives:
    """The same model in the numbers that are stored (:meth:`~neuprim.core.model.fields.Field.canonicalize`), detached and on
    the processor.

    Raises:
        CheckpointError: numbers that cannot be stored: not float32, not finite, or a quaternion of zeros.
        FormError: a field's own code returned something of another shape.
    """
    params = {name: value.detach().cpu() for name, value in model.params.items()}
    for field in (model.density, model.colour):
        own = {spec.name: params[spec.name] for spec in field.parameters()}
        found = field.canonicalize(own)
        wanted = {name: tuple(value.shape) for name, value in own.items()}
        if {name: tuple(value.shape) for name, value in found.items()} != wanted:
            raise FormError(
                f"{method(field, 'canonicalize')} returned tensors of other names or shapes; expected {wanted}"
            )
        params |= found
    for name, value in params.items():
        if value.dtype != torch.float32:
            raise CheckpointError(f"parameter {name} is {value.dtype}; only torch.float32 can be compressed")
        bad = ~torch.isfinite(value).reshape(len(value), math.prod(value.shape[1:])).all(1)
        if name == "quats":
            bad |= (value == 0).all(1)
        if bool(bad.any()):
            row = int(bad.nonzero()[0])
            raise CheckpointError(
                f"parameter {name} of primitive {row} is {value[row].flatten()[:8].tolist()}, which cannot be compressed"
            )
    return Primitives(model.density, model.colour, params)


def schemes(model: Primitives, table: BitTable) -> Schemes:
    """How a folded model's numbers are coded: ends from its own numbers, bits from the table and, where it leaves it
    open, from them."""
    found: Schemes = {}
    sparse = _sparse(model)
    for spec in model.specs:
        x, bits = model.params[spec.name].reshape(model.count, spec.size), table.of(spec.name, spec.shape)
        if spec.name == "quats":
            found[spec.name] = Rotations(bits[0])
        elif spec.fixed:
            found[spec.name] = fit_columns(x, [_LABEL] * spec.size, clips=(0.0,))
        elif spec.name == "means":
            found[spec.name] = _positions(model, x, bits[0], spec.name in table.exact)
        else:
            columns = fit_columns(x, bits)
            if spec.name not in table.exact and model.count:
                spiky = spread_error(x, columns) > _SPIKY
                if bool(spiky.any()):
                    columns = fit_columns(
                        x, [min(2 * b, 16) if more else b for b, more in zip(bits, spiky.tolist(), strict=True)]
                    )
            found[spec.name] = keep_zero(columns) if spec.name in sparse else columns
    return found


def schemes_within(model: Primitives, effects: Mapping[str, Tensor], error: float) -> Schemes:
    """How a folded model's numbers are coded so that each of them brings the same error, as little as that is: a step
    is as long as images allow.

    A number rounded to steps of length s is off by s^2 / 12 in the mean of squares. Of all ways to spend so many bits,
    those by which the last bit of every number is worth as much are the best (reverse water filling), and codes that no
    number has take next to no bytes.

    Args:
        effects: parameter -> (C,) mean squared change of what is looked at, when its numbers change by independent
        amounts of variance 1
            (:class:`~neuprim.core.train.sensitivity.Sensitivity`).
        error: mean squared change that the numbers of one column may bring together.
    """
    found: Schemes = {}
    sparse = _sparse(model)
    for spec in model.specs:
        x = model.params[spec.name].reshape(model.count, spec.size)
        own = (
            effects[spec.name].double().nan_to_num(nan=torch.inf, posinf=torch.inf)
        )  # what cannot be told is stored as finely as can be
        steps = (12.0 * error / own).sqrt()  # infinite where nothing changes
        if spec.name == "quats":
            turn = float((12.0 * 3.0 * error / own.sum()).sqrt())  # three numbers tell of four
            found[spec.name] = Rotations(
                min(max(round(math.log2(2**0.5 / turn + 2)), LEAST_BITS), 16) if turn > 0 else 16
            )
        elif spec.fixed:
            found[spec.name] = fit_columns(x, [_LABEL] * spec.size, clips=(0.0,))
        elif spec.name == "means":
            found[spec.name] = _even_positions(x, steps)
        else:
            zero = spec.name in sparse
            columns = even_columns(x, steps, 0.0 if zero else x.double().mean(0))
            found[spec.name] = keep_zero(columns) if zero else columns
    return found


def _even_positions(x: Tensor, steps: Tensor) -> Columns:
    """As :func:`even_columns`, with as many bits for each axis."""
    own = even_columns(x, steps, x.double().mean(0) if len(x) else 0.0)
    bits = int(own.bits.max())
    low = own.low.double()
    step = torch.where(own.high > own.low, (own.high.double() - low) / own.last, 0.0)
    return Columns(torch.full_like(own.bits, bits), own.low, (low + ((1 << bits) - 1) * step).float())


def _sparse(model: Primitives) -> set[str]:
    """Parameters of pieces that some primitives do without: these come back without them."""
    pieces = prunable_units_by_name(model.density, model.colour).values()
    return {name for piece in pieces if not bool(nonzero_rows(piece, model.params).all()) for name in piece.places}


def _positions(model: Primitives, x: Tensor, bits: int, exact: bool) -> Columns:
    """No position is clipped: what is far away stays there, and if need be costs everybody a bit more."""
    if model.count and not exact:
        width = (x.amax(0) - x.amin(0)).double().max()
        size = model.params["log_scales"].double().amax(1).exp().median()
        while bits < MOST_BITS and width / (2**bits - 1) * _FINE > size:
            bits += 1
    return fit_columns(x, [bits] * 3, clips=(0.0,))


def file_order(model: Primitives, made: Schemes) -> Tensor:
    """(N,) int64 rows of a folded model as they follow each other in a file: along a Z curve through the positions'
    codes."""
    places = made["means"]
    assert isinstance(places, Columns)
    return torch.from_numpy(
        np.argsort(morton(places.codes(model.params["means"]).numpy(), int(places.bits[0])), kind="stable")
    )


def encode(model: Primitives, made: Schemes) -> list[Section]:
    """The sections of a folded model, in the order of the file."""
    order = file_order(model, made)
    codes = {
        spec.name: made[spec.name].codes(model.params[spec.name].reshape(model.count, spec.size)[order])
        for spec in model.specs
    }
    masks, whose = _masks(model, made, codes)
    sections = [pack_rows(masks)] if masks else []
    for spec in model.specs:
        scheme, own = made[spec.name], codes[spec.name].numpy()
        if spec.name in whose:
            assert isinstance(scheme, Columns)
            sections.append(pack_sparse(spec.name, spec.shape, scheme, own, whose[spec.name], masks))
            continue
        coding = ROTATIONS if isinstance(scheme, Rotations) else POSITIONS if spec.name == "means" else COLUMNS
        sections.append(pack(spec.name, spec.shape, scheme, own, coding))
    return sections


def _masks(
    model: Primitives, made: Schemes, codes: Mapping[str, Tensor]
) -> tuple[list[np.ndarray], dict[str, list[int]]]:
    """Who has which piece, of pieces that come back as zeros for some primitives, and of their parameters the number of
    each column's mask.

    One bit then says what would else be the most frequent code of every column of the piece.
    """
    shapes = {spec.name: spec.shape for spec in model.specs}
    zero = {
        n: (s.values(codes[n]) == 0).reshape(model.count, *shapes[n])
        for n, s in made.items()
        if isinstance(s, Columns) and n != "means"
    }
    masks: list[np.ndarray] = []
    whose: dict[str, Tensor] = {}
    for piece in prunable_units_by_name(model.density, model.colour).values():
        if not model.count or not set(piece.places) <= zero.keys():
            continue
        parts = [
            zero[name][(slice(None), *place)].reshape(model.count, -1).all(1) for name, place in piece.places.items()
        ]
        without = torch.stack(parts).all(0)
        if float(without.double().mean()) < _WORTH_A_MASK:
            continue
        masks.append((~without).numpy())
        for name, place in piece.places.items():
            whose.setdefault(name, torch.zeros(shapes[name], dtype=torch.int64))[place] = len(masks)
    return masks, {name: of.flatten().tolist() for name, of in whose.items()}


def rounded(params: Mapping[str, Tensor], made: Schemes) -> dict[str, Tensor]:
    """Tensors as they would come back, row by row, with the gradients of the tensors themselves (straight through).

    For training that knows what will be stored: the schemes are fixed meanwhile, and numbers beyond a column's ends
    come back as the end.
    """
    return {
        name: made[name].rounded(x.reshape(len(x), math.prod(x.shape[1:]))).reshape(x.shape)
        for name, x in params.items()
    }


def bits_in_words(scheme: Columns | Rotations) -> str:
    """``"7"``, ``"6 to 8"`` of several columns."""
    bits = sorted({scheme.bits} if isinstance(scheme, Rotations) else set(scheme.bits.tolist()))
    return " to ".join(map(str, bits if len(bits) < 2 else (bits[0], bits[-1])))
