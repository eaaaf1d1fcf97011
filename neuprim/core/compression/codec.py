"""Quantize models: encode them as the sections of a ``.neuprim`` file, and simulate quantization in training.

A quantizer converts numbers to integer codes of a few bits. A section of the file holds the codes of one parameter.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compression.quantizers import (
    MAX_BITS,
    MIN_BITS,
    BitTable,
    ColumnQuantizer,
    RotationQuantizer,
    columns_of_step,
    fit_columns,
    relative_quantizer_error,
    snap_to_zero,
)
from neuprim.core.compression.sections import (
    COLUMNS,
    POSITIONS,
    ROTATIONS,
    CompressedSection,
    morton_encode,
    pack_codec_masks,
    pack_section,
    pack_sparse_columns,
)
from neuprim.core.errors import CheckpointError, FormError
from neuprim.core.model.checks import model_method_label
from neuprim.core.model.fields import prunable_units_of_model
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import primitives_with_unit

Quantizers = dict[str, ColumnQuantizer | RotationQuantizer]  # parameter -> its quantizer


@dataclass(frozen=True)
class StoredSize:
    """Size of a parameter in a file: ``bits`` per number, as text such as "7", and ``size`` in bytes."""

    bits: str
    size: int


_UNSEEN_BITS = 8
"""Bits of a column that the images do not show when the file is written. Other results, such as exported grids, may
depend on it."""

_SPIKY = 12.0  # A column whose error is this many times the usual one has outliers and gets twice the bits

_LABEL = 16  # bits of a number that is not learned, such as a label, at every level

_MIN_MASKED = 0.02  # A unit that is zero in a smaller share of the primitives gets no bit mask

_POSITION_STEPS = 50.0  # smallest number of position steps in the median of the primitives' longest semi-axes


def canonical_model(model: Primitives) -> Primitives:
    """Return an equivalent model whose parameters have the canonical form that files store; detached, on the CPU.

    Raises CheckpointError for values that a file cannot store, FormError if a field returns invalid parameters.
    """
    params = {name: value.detach().cpu() for name, value in model.params.items()}
    for field in (model.density, model.colour):
        own = {spec.name: params[spec.name] for spec in field.parameters()}
        found = field.canonicalize(own)
        wanted = {name: tuple(value.shape) for name, value in own.items()}
        if {name: tuple(value.shape) for name, value in found.items()} != wanted:
            raise FormError(
                f"{model_method_label(field, 'canonicalize')} returned tensors of other names or shapes; "
                f"expected {wanted}"
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
            values = value[row].flatten()[:8].tolist()
            raise CheckpointError(f"parameter {name} of primitive {row} is {values}, which cannot be compressed")
    return Primitives(model.density, model.colour, params)


def fit_quantizers(model: Primitives, table: BitTable) -> Quantizers:
    """Return a quantizer for each parameter of a canonical model: ranges fit the values, bits are from ``table``.

    A column is one number of every primitive. Columns with outliers, and positions with too long steps, get more bits
    than in ``table``, unless the parameter is in ``table.exact``.
    """
    found: Quantizers = {}
    sparse = _sparse_quantized_parameters(model)
    for spec in model.specs:
        x, bits = model.params[spec.name].reshape(model.count, spec.size), table.of(spec.name, spec.shape)
        if spec.name == "quats":
            found[spec.name] = RotationQuantizer(bits[0])
        elif spec.fixed:
            found[spec.name] = fit_columns(x, [_LABEL] * spec.size, clips=(0.0,))
        elif spec.name == "means":
            found[spec.name] = _fit_position_quantizer(model, x, bits[0], spec.name in table.exact)
        else:
            columns = fit_columns(x, bits)
            if spec.name not in table.exact and model.count:
                spiky = relative_quantizer_error(x, columns) > _SPIKY
                if bool(spiky.any()):
                    columns = fit_columns(
                        x, [min(2 * b, 16) if more else b for b, more in zip(bits, spiky.tolist(), strict=True)]
                    )
            found[spec.name] = snap_to_zero(columns) if spec.name in sparse else columns
    return found


def fit_quantizers_to_error(model: Primitives, effects: Mapping[str, Tensor], error: float) -> Quantizers:
    """Return quantizers that make every column (one stored number of all primitives) add the same image error.

    Rounding to steps of length s has a mean squared error of s^2 / 12. If all columns add the same error, the file
    needs the fewest bits in total (reverse water filling).

    Args:
        model: from :func:`canonical_model`.
        effects: parameter -> (C,) image MSE per MSE of each column
            (:class:`~neuprim.core.train.sensitivity.Sensitivity`).
        error: image MSE that each column may add.
    """
    found: Quantizers = {}
    sparse = _sparse_quantized_parameters(model)
    for spec in model.specs:
        x = model.params[spec.name].reshape(model.count, spec.size)
        # An unknown effect counts as infinite: the column is stored as finely as possible.
        own = effects[spec.name].double().nan_to_num(nan=torch.inf, posinf=torch.inf)
        steps = (12.0 * error / own).sqrt()
        if model.count:  # channels, for example, change no image; infinite steps store columns of equal numbers
            span = (x.amax(0) - x.amin(0)).double()
            steps = torch.where((own == 0) & (span > 0), span / (2**_UNSEEN_BITS - 1), steps)
        if spec.name == "quats":
            turn = float((12.0 * 3.0 * error / own.sum()).sqrt())  # three of four components are stored
            found[spec.name] = RotationQuantizer(
                min(max(round(math.log2(2**0.5 / turn + 2)), MIN_BITS), 16) if turn > 0 else 16
            )
        elif spec.fixed:
            found[spec.name] = fit_columns(x, [_LABEL] * spec.size, clips=(0.0,))
        elif spec.name == "means":
            found[spec.name] = _even_position_quantizer(x, steps)
        else:
            zero = spec.name in sparse
            columns = columns_of_step(x, steps, 0.0 if zero else x.double().mean(0))
            found[spec.name] = snap_to_zero(columns) if zero else columns
    return found


def _even_position_quantizer(x: Tensor, steps: Tensor) -> ColumnQuantizer:
    """Return a quantizer of positions ``x`` (N, 3) like :func:`columns_of_step`, but with equal bits for all axes."""
    own = columns_of_step(x, steps, x.double().mean(0) if len(x) else 0.0)
    bits = int(own.bits.max())
    low = own.low.double()
    step = torch.where(own.high > own.low, (own.high.double() - low) / own.last, 0.0)
    return ColumnQuantizer(torch.full_like(own.bits, bits), own.low, (low + ((1 << bits) - 1) * step).float())


def _sparse_quantized_parameters(model: Primitives) -> set[str]:
    """Return the names of parameters in which pruning set units (such as neurons) of some primitives to zero.

    The quantizers of these parameters must decode zeros exactly.
    """
    pieces = prunable_units_of_model(model.density, model.colour).values()
    return {
        name for piece in pieces if not bool(primitives_with_unit(piece, model.params).all()) for name in piece.places
    }


def _fit_position_quantizer(model: Primitives, x: Tensor, bits: int, exact: bool) -> ColumnQuantizer:
    """Return a quantizer whose range contains all positions ``x`` (N, 3).

    Unless ``exact``, ``bits`` is raised, up to 20, until a step is at most 1/50 of the primitives' median longest
    semi-axis.
    """
    if model.count and not exact:
        width = (x.amax(0) - x.amin(0)).double().max()
        size = model.params["log_scales"].double().amax(1).exp().median()
        while bits < MAX_BITS and width / (2**bits - 1) * _POSITION_STEPS > size:
            bits += 1
    return fit_columns(x, [bits] * 3, clips=(0.0,))


def storage_order(model: Primitives, made: Quantizers) -> Tensor:
    """Return the (N,) int64 order of primitives in a file: along a Z curve through positions quantized by ``made``."""
    places = made["means"]
    assert isinstance(places, ColumnQuantizer)
    return torch.from_numpy(
        np.argsort(morton_encode(places.codes(model.params["means"]).numpy(), int(places.bits[0])), kind="stable")
    )


def encode_sections(model: Primitives, made: Quantizers) -> list[CompressedSection]:
    """Encode a canonical model with the quantizers ``made``; return the sections in file order."""
    order = storage_order(model, made)
    codes = {
        spec.name: made[spec.name].codes(model.params[spec.name].reshape(model.count, spec.size)[order])
        for spec in model.specs
    }
    masks, mask_of = _sparse_column_masks(model, made, codes)
    sections = [pack_codec_masks(masks)] if masks else []
    for spec in model.specs:
        scheme, own = made[spec.name], codes[spec.name].numpy()
        if spec.name in mask_of:
            assert isinstance(scheme, ColumnQuantizer)
            sections.append(pack_sparse_columns(spec.name, spec.shape, scheme, own, mask_of[spec.name], masks))
            continue
        coding = ROTATIONS if isinstance(scheme, RotationQuantizer) else POSITIONS if spec.name == "means" else COLUMNS
        sections.append(pack_section(spec.name, spec.shape, scheme, own, coding))
    return sections


def _sparse_column_masks(
    model: Primitives, made: Quantizers, codes: Mapping[str, Tensor]
) -> tuple[list[np.ndarray], dict[str, list[int]]]:
    """Return masks of the primitives in which a prunable unit is not zero, and the mask number of each column.

    Masks are (N,) bool. Only units that are zero in at least 2 % of the primitives have a mask. The mask numbers are
    lists by parameter name; they count from 1, and 0 means no mask.
    """
    shapes = {spec.name: spec.shape for spec in model.specs}
    zero = {
        n: (s.values(codes[n]) == 0).reshape(model.count, *shapes[n])
        for n, s in made.items()
        if isinstance(s, ColumnQuantizer) and n != "means"
    }
    masks: list[np.ndarray] = []
    mask_of: dict[str, Tensor] = {}
    for piece in prunable_units_of_model(model.density, model.colour).values():
        if not model.count or not set(piece.places) <= zero.keys():
            continue
        parts = [
            zero[name][(slice(None), *place)].reshape(model.count, -1).all(1) for name, place in piece.places.items()
        ]
        without = torch.stack(parts).all(0)
        if float(without.double().mean()) < _MIN_MASKED:
            continue
        masks.append((~without).numpy())
        for name, place in piece.places.items():
            mask_of.setdefault(name, torch.zeros(shapes[name], dtype=torch.int64))[place] = len(masks)
    return masks, {name: of.flatten().tolist() for name, of in mask_of.items()}


def fake_quantize(params: Mapping[str, Tensor], made: Quantizers) -> dict[str, Tensor]:
    """Quantize and dequantize parameters, with straight-through gradients.

    Values outside the range of their quantizer are clamped.
    """
    return {
        name: made[name].fake_quantize(x.reshape(len(x), math.prod(x.shape[1:]))).reshape(x.shape)
        for name, x in params.items()
    }


def format_quantizer_bits(scheme: ColumnQuantizer | RotationQuantizer) -> str:
    """Return the bits of a quantizer as text: ``"7"``, or ``"6 to 8"`` if columns differ."""
    bits = sorted({scheme.bits} if isinstance(scheme, RotationQuantizer) else set(scheme.bits.tolist()))
    return " to ".join(map(str, bits if len(bits) < 2 else (bits[0], bits[-1])))
