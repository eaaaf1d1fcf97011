"""Model files without what is zero, as pruning leaves it (:mod:`neuprim.core.model.pieces`).

A parameter is stored as two tensors, if that is less: ``NAME|there``, uint8, a bit for each of its numbers, row by row
and the lowest bit first, and ``NAME|numbers``, float32, those whose bit is set. Tensors in memory are whole. Earlier
files name pieces instead, see :func:`of_pieces`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import CheckpointError
from neuprim.core.model.pieces import Piece
from neuprim.core.model.schema import ParameterSpec, Params

__all__ = ["of_pieces", "split_off", "whole"]

_THERE, _NUMBERS = "|there", "|numbers"
_ROWS = "rows|"


def split_off(params: Params, specs: Sequence[ParameterSpec]) -> tuple[dict[str, Tensor], list[str]]:
    """Tensors as a file holds them, and the names of the parameters without their zeros; ``specs`` are those of the
    fields."""
    stored, sparse = dict(params), []
    for name in (spec.name for spec in specs):
        value = params[name]
        numbers = value.detach().cpu().contiguous().flatten()
        there = numbers.view(torch.int32) != 0  # by its bits: a zero below zero is there
        if 4 * int(there.sum()) + (len(there) + 7) // 8 < 4 * len(there):
            del stored[name]
            stored[name + _THERE] = torch.from_numpy(np.packbits(there.numpy(), bitorder="little"))
            stored[name + _NUMBERS] = numbers[there].contiguous()
            sparse.append(name)
    return stored, sparse


def whole(stored: Params, names: object, specs: Sequence[ParameterSpec], where: str) -> dict[str, Tensor]:
    """The tensors of a model from those of its file.

    Args:
        names: of the parameters without their zeros, as the file's header has them.
        specs: of the fields' parameters.
        where: the file, for messages.

    Raises:
        CheckpointError: they do not fit the model's fields or each other.
    """
    shapes = {spec.name: spec.shape for spec in specs}
    if not isinstance(names, list) or not all(isinstance(name, str) and name in shapes for name in names):
        raise CheckpointError(
            f"{where}: header field 'sparse' is {names!r}; expected parameters of the model's fields: {', '.join(shapes)}"
        )
    count = _count(stored, where)
    found = {name: value for name, value in stored.items() if not name.endswith((_THERE, _NUMBERS))}
    for name in names:
        size = count * math.prod(shapes[name])
        there = _bits(stored.get(name + _THERE), size, f"{where}: {name + _THERE}")
        numbers = _expected(stored.get(name + _NUMBERS), (int(there.sum()),), f"{where}: {name + _NUMBERS}")
        if name in found:
            raise CheckpointError(
                f"{where}: {name} is there twice, as {name} and as {name + _NUMBERS}; expected one of them"
            )
        found[name] = torch.zeros(size).masked_scatter_(there, numbers).reshape(count, *shapes[name])
    _no_more(stored, {*found, *(name + part for name in names for part in (_THERE, _NUMBERS))}, where, "no parameter")
    return found


def of_pieces(
    stored: Params, names: object, specs: Sequence[ParameterSpec], pieces: Mapping[str, Piece], where: str
) -> dict[str, Tensor]:
    """The same of a file of earlier, in which a piece was ``NAME|KIND.PIECE`` with the rows that have it, by
    ``rows|KIND.PIECE``, a bit for each primitive.

    Args:
        names: of the pieces that are stored apart.
        pieces: name -> piece, those of earlier included.

    Raises:
        CheckpointError: they do not fit the model's fields or each other.
    """
    if not isinstance(names, list) or not all(isinstance(name, str) and name in pieces for name in names):
        raise CheckpointError(
            f"{where}: header field 'apart' is {names!r}; expected pieces of the model's fields: {', '.join(pieces)}"
        )
    count, shapes = _count(stored, where), {spec.name: spec.shape for spec in specs}
    found = {name: value for name, value in stored.items() if "|" not in name}
    taken = set(found)
    for name in names:
        has = _bits(stored.get(_ROWS + name), count, f"{where}: {_ROWS + name}")
        taken.add(_ROWS + name)
        for parameter, place in pieces[name].places.items():
            key = f"{parameter}|{name}"
            if key not in stored and parameter in stored:
                continue  # some of a piece's parameters may be whole
            target = found.setdefault(parameter, torch.zeros(count, *shapes[parameter]))
            wanted = (int(has.sum()), *target[(slice(None), *place)].shape[1:])
            target[(has, *place)] = _expected(stored.get(key), wanted, f"{where}: {key}")
            taken.add(key)
    _no_more(stored, taken, where, "no piece")
    return found


def _count(stored: Params, where: str) -> int:
    means = stored.get("means")
    if means is None or means.dim() != 2:
        raise CheckpointError(f"{where}: no tensor 'means' (N, 3)")
    return len(means)


def _expected(part: Tensor | None, shape: tuple[int, ...], what: str) -> Tensor:
    if part is None or tuple(part.shape) != shape or part.dtype != torch.float32:
        shown = "missing" if part is None else f"{part.dtype} {tuple(part.shape)}"
        raise CheckpointError(f"{what} is {shown}; expected torch.float32 {shape}")
    return part


def _no_more(stored: Params, taken: set[str], where: str, to: str) -> None:
    extra = sorted(set(stored) - taken)
    if extra:
        raise CheckpointError(f"{where}: tensor {extra[0]!r} belongs to {to}")


def _bits(bits: Tensor | None, count: int, what: str) -> Tensor:
    if bits is None or bits.dtype != torch.uint8 or tuple(bits.shape) != ((count + 7) // 8,):
        shown = "missing" if bits is None else f"{bits.dtype} {tuple(bits.shape)}"
        raise CheckpointError(f"{what} is {shown}; expected torch.uint8 ({(count + 7) // 8},)")
    return torch.from_numpy(np.unpackbits(bits.numpy(), count=count, bitorder="little").astype(bool))
