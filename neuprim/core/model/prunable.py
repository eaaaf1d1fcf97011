"""Parts of a primitive's fields that it may do without: a coefficient of its colour, a neuron of its density, a wave in
time.

A piece names numbers that mean nothing once they are zero, as few as can go by themselves. Pruning decides for every
primitive which pieces it keeps; files leave out what is zero (:mod:`neuprim.core.model.sparse_storage`), and compressed files
have next to nothing to say about it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.model.schema import Params

__all__ = ["PrunableUnit", "count_numbers", "nonzero_rows", "removal_effect", "zero_units"]

Place = tuple[int | slice, ...]
"""Where in a parameter's own shape, behind the axis of the primitives."""


@dataclass(frozen=True)
class PrunableUnit:
    """Numbers of a field that go together.

    Attributes:
        name: unique within the field, e.g. "neuron 2".
        places: parameter -> where its numbers are.
        group: what people are told of it together with others, e.g. "band 2"; empty: its name.
    """

    name: str
    places: Mapping[str, Place]
    group: str = ""

    def of(self, params: Params) -> dict[str, Tensor]:
        """Views of the numbers, (N, ...) each."""
        return {name: params[name][(slice(None), *place)] for name, place in self.places.items()}


def count_numbers(piece: PrunableUnit, params: Params) -> int:
    """How many numbers of one primitive the piece is."""
    return sum(math.prod(value.shape[1:]) for value in piece.of(params).values())


def removal_effect(piece: PrunableUnit, params: Params, gradients: Params) -> Tensor:
    """(N,) by how much a sum over pixels, whose gradients these are, changes when each primitive's piece is zero, to
    first order."""
    total: Tensor | None = None
    slopes = piece.of(gradients)
    for name, value in piece.of(params).items():
        part = _flat(value.detach() * slopes[name]).sum(1)
        total = part if total is None else total + part
    assert total is not None, "a piece has numbers"
    return total


def zero_units(pieces: Mapping[str, tuple[PrunableUnit, Tensor]], params: Params) -> dict[str, Tensor]:
    """Copies of the parameters in which pieces are zero.

    Args:
        pieces: name -> (piece, (N,) bool of the primitives that do without it).
    """
    names = {name for piece, gone in pieces.values() if bool(gone.any()) for name in piece.places}
    found = {name: value.detach().clone() if name in names else value for name, value in params.items()}
    for piece, gone in pieces.values():
        if bool(gone.any()):
            for name, place in piece.places.items():
                found[name][(gone.to(found[name].device), *place)] = 0
    return found


def nonzero_rows(piece: PrunableUnit, params: Params) -> Tensor:
    """(N,) bool of the primitives of whose piece some number is not zero."""
    return torch.stack([_flat(value.detach() != 0).any(1) for value in piece.of(params).values()]).any(0)


def _flat(value: Tensor) -> Tensor:
    """(N, numbers of a primitive), also of no primitives."""
    return value.reshape(len(value), math.prod(value.shape[1:]))
