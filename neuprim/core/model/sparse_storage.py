"""Sparse storage of pruned parameters in model files.

Where it is smaller, a parameter is stored as two tensors: ``NAME|there``, uint8, one bit per number, row by row and
lowest bit first, and ``NAME|numbers``, float32, the numbers whose bit is set. Tensors in memory are dense.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import CheckpointError
from neuprim.core.model.schema import ParameterSpec, Params

_MASK, _NUMBERS = "|there", "|numbers"


def store_sparse(params: Params, specs: Sequence[ParameterSpec]) -> tuple[dict[str, Tensor], list[str]]:
    """Return the tensors of a file and the names of sparse parameters; ``specs`` are those of the fields."""
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


def load_sparse(stored: Params, names: object, specs: Sequence[ParameterSpec], where: str) -> dict[str, Tensor]:
    """Return the dense tensors of a model file with sparse parameters ``names``; ``where``: the file, for messages.

    Raises CheckpointError where the tensors do not fit the fields or each other.
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
        bits = _check(stored.get(name + _MASK), ((size + 7) // 8,), torch.uint8, f"{where}: {name + _MASK}")
        mask = torch.from_numpy(np.unpackbits(bits.numpy(), count=size, bitorder="little").astype(bool))
        numbers = _check(stored.get(name + _NUMBERS), (int(mask.sum()),), torch.float32, f"{where}: {name + _NUMBERS}")
        if name in found:
            raise CheckpointError(
                f"{where}: {name} is there twice, as {name} and as {name + _NUMBERS}; expected one of them"
            )
        found[name] = torch.zeros(size).masked_scatter_(mask, numbers).reshape(len(means), *shapes[name])
    extra = sorted(set(stored) - {*found, *(name + part for name in names for part in (_MASK, _NUMBERS))})
    if extra:
        raise CheckpointError(f"{where}: tensor {extra[0]!r} belongs to no parameter")
    return found


def _check(tensor: Tensor | None, shape: tuple[int, ...], dtype: torch.dtype, what: str) -> Tensor:
    if tensor is None or tuple(tensor.shape) != shape or tensor.dtype != dtype:
        shown = "missing" if tensor is None else f"{tensor.dtype} {tuple(tensor.shape)}"
        raise CheckpointError(f"{what} is {shown}; expected {dtype} {shape}")
    return tensor
