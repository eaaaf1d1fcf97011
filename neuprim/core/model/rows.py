"""Rows of many tensors as one differentiable operation. Rows ascend, so that a gradient is written in one pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.operation import apply_autograd, needs_grad
from neuprim.core.compute.threads import parallel_for

_FEW = 4096  # below, without a gradient, torch is done before a kernel would have begun with the last tensor


def take_rows(tensors: Mapping[str, Tensor], rows: Tensor) -> dict[str, Tensor]:
    """Rows (M,) int64, ascending, of ``tensors`` (N, ...), float32 or float64; differentiable, once. Not checked."""
    if not device.on_numba(rows, *tensors.values()) or (len(rows) < _FEW and not needs_grad(*tensors.values())):
        return {name: value.index_select(0, rows) for name, value in tensors.items()}
    return dict(zip(tensors, apply_autograd(_Rows, rows, *tensors.values()), strict=True))


@exact_kernel
def _take(rows, whole, taken):  # type: ignore[no-untyped-def]
    for n in range(rows.shape[0]):
        for j in range(whole.shape[1]):
            taken[n, j] = whole[rows[n], j]


@exact_kernel
def _put(rows, taken, whole):  # type: ignore[no-untyped-def]
    """Writes every row of ``whole``: zeros where there is none of ``taken``."""
    row = 0
    for n in range(rows.shape[0]):
        while row < rows[n]:
            for j in range(whole.shape[1]):
                whole[row, j] = 0.0
            row += 1
        for j in range(whole.shape[1]):
            whole[row, j] = taken[n, j]
        row += 1
    whole[row:] = 0.0


def _each(kernel: Callable[..., None], rows: np.ndarray, pairs: list[tuple[np.ndarray, np.ndarray]]) -> None:
    """The kernel on each of ``pairs`` as tables, which are shared out among the threads."""
    tables = [tuple(x.reshape(len(x), -1) for x in pair) for pair in pairs if pair[0].size and pair[1].size]

    def share(start: int, stop: int) -> None:
        for source, target in tables[start:stop]:
            kernel(rows, source, target)

    parallel_for(share, len(tables), 1, 0)


class _Rows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rows: Tensor, *tensors: Tensor) -> tuple[Tensor, ...]:  # type: ignore[override]
        ctx.set_materialize_grads(False)
        ctx.rows, ctx.shapes = rows.numpy(), [x.shape for x in tensors]
        taken = [torch.empty((len(rows), *x.shape[1:]), dtype=x.dtype) for x in tensors]
        _each(
            _take, ctx.rows, [(x.detach().contiguous().numpy(), y.numpy()) for x, y in zip(tensors, taken, strict=True)]
        )
        return tuple(taken)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor | None) -> tuple[Tensor | None, ...]:  # type: ignore[override]
        made = [
            None if g is None else torch.empty(shape, dtype=g.dtype)
            for g, shape in zip(gradients, ctx.shapes, strict=True)
        ]
        known = [
            (g.contiguous(), whole)
            for g, whole in zip(gradients, made, strict=True)
            if g is not None and whole is not None
        ]
        for g, whole in known:
            if not g.numel():
                whole.zero_()  # nothing lives, or nothing is there
        _each(_put, ctx.rows, [(g.numpy(), whole.numpy()) for g, whole in known])
        return (None, *made)
