"""Prunable units: groups of parameter elements, such as a neuron, that pruning can set to zero in single primitives.

Pruning decides for each primitive which units stay. A file stores a parameter NAME sparsely where that takes less
space, as two tensors. ``NAME|there``, uint8, has one bit per element, row by row and lowest bit first; 1 means that the
element is stored. ``NAME|numbers``, float32, holds the stored elements. All other elements are zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import CheckpointError
from neuprim.core.model.schema import ParameterSpec, Params

__all__ = ["PrunableUnit"]

Index = tuple[int | slice, ...]  # index into a parameter, behind the axis of the primitives


@dataclass(frozen=True)
class PrunableUnit:
    """A group of parameter elements of a field that pruning sets to zero together, such as one neuron."""

    name: str  # unique within the field, e.g. "neuron 2"
    places: Mapping[str, Index]  # parameter name -> index of the elements in a row
    group: str = ""  # label under which reports add up units, e.g. "band 2"; empty: the unit's name

    def of(self, params: Params) -> dict[str, Tensor]:
        """Return parameter name -> elements of this unit in all N primitives, an (N, ...) view of the parameter."""
        return {name: params[name][(slice(None), *place)] for name, place in self.places.items()}


def count_unit_numbers(unit: PrunableUnit, params: Params) -> int:
    """Return the number of parameter elements that a unit has in one primitive."""
    return sum(math.prod(value.shape[1:]) for value in unit.of(params).values())


def primitive_unit_removal_effect(unit: PrunableUnit, params: Params, gradients: Params) -> Tensor:
    """Return (N,) sums of value times gradient over the elements of a unit, one sum per primitive.

    ``gradients`` are the gradients of a loss. Minus the sum is the change of the loss, to first order, when the unit of
    this primitive becomes zero.
    """
    slopes = unit.of(gradients)
    parts = [_flat_primitive_rows(value.detach() * slopes[name]).sum(1) for name, value in unit.of(params).items()]
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def zero_units(units: Mapping[str, tuple[PrunableUnit, Tensor]], params: Params) -> dict[str, Tensor]:
    """Return the parameters after setting units of selected primitives to zero; changed tensors are copies.

    ``units`` maps a unit's name to a pair (unit, mask). The mask, (N,) bool, is True for the primitives in which the
    unit becomes zero.
    """
    changed = {name for unit, gone in units.values() if bool(gone.any()) for name in unit.places}
    found = {name: value.detach().clone() if name in changed else value for name, value in params.items()}
    for unit, gone in units.values():
        if bool(gone.any()):
            for name, place in unit.places.items():
                found[name][(gone.to(found[name].device), *place)] = 0
    return found


def primitives_with_unit(unit: PrunableUnit, params: Params) -> Tensor:
    """Return (N,) bool, True for primitives in which at least one element of the unit is not zero."""
    return torch.stack([_flat_primitive_rows(value.detach() != 0).any(1) for value in unit.of(params).values()]).any(0)


def _flat_primitive_rows(value: Tensor) -> Tensor:
    """Reshape an (N, ...) tensor to (N, elements per primitive); N may be 0."""
    return value.reshape(len(value), math.prod(value.shape[1:]))


_MASK, _NUMBERS = "|there", "|numbers"


def sparse_primitive_parameters(params: Params, specs: Sequence[ParameterSpec]) -> tuple[dict[str, Tensor], list[str]]:
    """Return the tensors to write to a model file, and the names of the parameters that are stored sparsely. A
    parameter in ``specs`` is stored sparsely (bit mask and non-zero elements) if that takes less space."""
    stored, sparse = dict(params), []
    for name in (spec.name for spec in specs):
        numbers = params[name].detach().cpu().contiguous().flatten()
        mask = numbers.view(torch.int32) != 0  # compare bits, so that -0 is stored
        if 4 * int(mask.sum()) + (len(mask) + 7) // 8 < 4 * len(mask):
            del stored[name]
            stored[name + _MASK] = torch.from_numpy(np.packbits(mask.numpy(), bitorder="little"))
            stored[name + _NUMBERS] = numbers[mask].contiguous()
            sparse.append(name)
    return stored, sparse


def dense_primitive_parameters(
    stored: Params, names: object, specs: Sequence[ParameterSpec], where: str
) -> dict[str, Tensor]:
    """Return dense parameters from tensors ``stored`` in a file: the inverse of :func:`sparse_primitive_parameters`.

    ``names`` are the parameters that are stored sparsely; ``where`` names the file in messages. Raises CheckpointError
    if tensors do not fit the ``specs`` or each other.
    """
    shapes = {spec.name: spec.shape for spec in specs}
    if not isinstance(names, list) or not all(isinstance(name, str) and name in shapes for name in names):
        raise CheckpointError(
            f"{where}: header field 'sparse' is {names!r}; "
            f"expected parameters of the model's fields: {', '.join(shapes)}"
        )
    means = stored.get("means")
    if means is None or means.dim() != 2:
        raise CheckpointError(f"{where}: no tensor 'means' (N, 3)")
    found = {name: value for name, value in stored.items() if not name.endswith((_MASK, _NUMBERS))}
    for name in names:
        size = len(means) * math.prod(shapes[name])
        bits = _check_stored_primitive_tensor(
            stored.get(name + _MASK), ((size + 7) // 8,), torch.uint8, f"{where}: {name + _MASK}"
        )
        mask = torch.from_numpy(np.unpackbits(bits.numpy(), count=size, bitorder="little").astype(bool))
        numbers = _check_stored_primitive_tensor(
            stored.get(name + _NUMBERS), (int(mask.sum()),), torch.float32, f"{where}: {name + _NUMBERS}"
        )
        if name in found:
            raise CheckpointError(
                f"{where}: {name} is stored twice, as {name} and as {name + _NUMBERS}; expected one of them"
            )
        found[name] = torch.zeros(size).masked_scatter_(mask, numbers).reshape(len(means), *shapes[name])
    extra = sorted(set(stored) - {*found, *(name + part for name in names for part in (_MASK, _NUMBERS))})
    if extra:
        raise CheckpointError(f"{where}: tensor {extra[0]!r} belongs to no parameter of the model")
    return found


def _check_stored_primitive_tensor(
    tensor: Tensor | None, shape: tuple[int, ...], dtype: torch.dtype, what: str
) -> Tensor:
    if tensor is None or tuple(tensor.shape) != shape or tensor.dtype != dtype:
        shown = "missing" if tensor is None else f"{tensor.dtype} {tuple(tensor.shape)}"
        raise CheckpointError(f"{what} is {shown}; expected {dtype} {shape}")
    return tensor
