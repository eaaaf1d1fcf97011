"""Model files without what is zero, as pruning leaves it (:mod:`neuprim.core.model.prunable`).

A parameter is stored as two tensors, if that is less: ``NAME|there``, uint8, a bit for each of its numbers, row by row
and the lowest bit first, and ``NAME|numbers``, float32, those whose bit is set. Tensors in memory are whole.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import CheckpointError
from neuprim.core.model.schema import ParameterSpec, Params

__all__ = ["load_sparse", "store_sparse"]

_THERE, _NUMBERS = "|there", "|numbers"


def store_sparse(params: Params, specs: Sequence[ParameterSpec]) -> tuple[dict[str, Tensor], list[str]]:
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


def load_sparse(stored: Params, names: object, specs: Sequence[ParameterSpec], where: str) -> dict[str, Tensor]:
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
