"""Prunable units: numbers that a primitive can do without, such as a neuron; files store pruned parameters sparsely.

Pruning decides per primitive which units stay. Where it is smaller, a file has two tensors of a parameter:
``NAME|there``,
uint8, one bit per number, row by row and lowest bit first, and ``NAME|numbers``, float32, those whose bit is set.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.model.schema import Params

Index = tuple[int | slice, ...]  # index into a parameter, behind the axis of the primitives


@dataclass(frozen=True)
class PrunableUnit:
    """Numbers of a field that are removed together."""

    name: str  # unique within the field, e.g. "neuron 2"
    places: Mapping[str, Index]  # parameter -> index of the numbers
    group: str = ""  # units that are reported together, e.g. "band 2"; empty: the name

    def of(self, params: Params) -> dict[str, Tensor]:
        """Return views of the numbers, (N, ...) each."""
        return {name: params[name][(slice(None), *place)] for name, place in self.places.items()}


def count_numbers(unit: PrunableUnit, params: Params) -> int:
    """Count the numbers of a unit in one primitive."""
    return sum(math.prod(value.shape[1:]) for value in unit.of(params).values())


def removal_effect(unit: PrunableUnit, params: Params, gradients: Params) -> Tensor:
    """Return (N,) first-order changes, when the unit becomes zero, of the sum whose gradients are given."""
    slopes = unit.of(gradients)
    parts = [_flatten(value.detach() * slopes[name]).sum(1) for name, value in unit.of(params).items()]
    total = parts[0]
    for part in parts[1:]:
        total = total + part
    return total


def zero_units(units: Mapping[str, tuple[PrunableUnit, Tensor]], params: Params) -> dict[str, Tensor]:
    """Copy the parameters with units, name -> (unit, (N,) bool of primitives that lose it), set to zero."""
    changed = {name for unit, gone in units.values() if bool(gone.any()) for name in unit.places}
    found = {name: value.detach().clone() if name in changed else value for name, value in params.items()}
    for unit, gone in units.values():
        if bool(gone.any()):
            for name, place in unit.places.items():
                found[name][(gone.to(found[name].device), *place)] = 0
    return found


def nonzero_rows(unit: PrunableUnit, params: Params) -> Tensor:
    """Return (N,) bool of the primitives for which some number of the unit is not zero."""
    return torch.stack([_flatten(value.detach() != 0).any(1) for value in unit.of(params).values()]).any(0)


def _flatten(value: Tensor) -> Tensor:
    """(N, numbers of a primitive), also for N = 0."""
    return value.reshape(len(value), math.prod(value.shape[1:]))
