# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Adam over all parameters of a model in two launches on a GPU: one checks that gradients are finite, one steps.

In torch code a step is a hundred launches, which take longer than a small frame. Warp is imported with this module.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import OPTIONS, array, launch, wp

TOGETHER = 16
"""Parameters of a launch."""

_POINTERS = wp.types.vector(length=TOGETHER, dtype=wp.uint64)
_LONGS = wp.types.vector(length=TOGETHER, dtype=wp.int64)
_FLOATS = wp.types.vector(length=TOGETHER, dtype=wp.float32)

_FINITE = """
    return isfinite(reinterpret_cast<const float*>(grad)[i]) ? 1 : 0;
"""
_MOVE = """
    const float g = reinterpret_cast<const float*>(grad)[i];
    float& m = reinterpret_cast<float*>(first)[i];
    float& v = reinterpret_cast<float*>(second)[i];
    m = beta1 * m + rest1 * g;
    v = beta2 * v + rest2 * g * g;
    reinterpret_cast<float*>(value)[i] -= step * m / (sqrtf(v) * slow + 1e-15f);
"""


@wp.func_native(_FINITE)
def _finite(grad: wp.uint64, i: wp.int64) -> int: ...


@wp.func_native(_MOVE)
def _move(
    value: wp.uint64, grad: wp.uint64, first: wp.uint64, second: wp.uint64, i: wp.int64, step: float, slow: float,
    beta1: float, beta2: float, rest1: float, rest2: float,
): ...  # fmt: skip


@functools.cache
def _kernels() -> tuple[Any, Any]:
    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def check(grads: _POINTERS, ends: _LONGS, bad: wp.array(dtype=wp.int32)):
        """A thread a number; ``ends``: of the parameters, one after the other."""
        n = wp.int64(wp.tid())
        k = int(0)
        begin = wp.int64(0)
        while n >= ends[k]:
            begin = ends[k]
            k += 1
        if _finite(grads[k], n - begin) == 0:
            bad[0] = 1  # whichever thread writes it

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def move(
        values: _POINTERS, grads: _POINTERS, firsts: _POINTERS, seconds: _POINTERS, ends: _LONGS, widths: _LONGS,
        rates: _FLOATS,
        beta1: float, beta2: float, rest1: float, rest2: float, log1: float, log2: float, age: wp.array(dtype=wp.int64),
        bad: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """``widths``: numbers per row; ``rest1``, ``rest2``: 1 - beta, rounded once; ``log1``, ``log2``: logarithms of
        the betas; ``age``: steps of each row, this one included."""
        n = wp.int64(wp.tid())
        if bad[0] == 0:
            k = int(0)
            begin = wp.int64(0)
            while n >= ends[k]:
                begin = ends[k]
                k += 1
            i = n - begin
            t = float(age[int(i / widths[k])])
            step = rates[k] / (1.0 - wp.exp(log1 * t))
            slow = wp.sqrt(1.0 / (1.0 - wp.exp(log2 * t)))
            if t * log2 > -0.25:  # the difference would cancel: 1 - exp(x) = -x (1 + x/2 (1 + x/3 (1 + x/4 (1 + x/5))))
                x = t * log2
                slow = wp.sqrt(1.0 / (-x * (1.0 + x * 0.5 * (1.0 + x / 3.0 * (1.0 + x * 0.25 * (1.0 + x * 0.2))))))
            _move(values[k], grads[k], firsts[k], seconds[k], i, step, slow, beta1, beta2, rest1, rest2)

    return check, move


def adam_rows(
    values: Sequence[Tensor], grads: Sequence[Tensor], firsts: Sequence[Tensor], seconds: Sequence[Tensor],
    rates: Sequence[float],
    age: Tensor, betas: tuple[float, float],
) -> bool:  # fmt: skip
    """Take one step in place; returns whether all gradients were finite, and if not nothing has changed. The host waits
    for the device once.

    Args:
        values, grads, firsts, seconds: (N, ...) float32, none empty; all but ``grads`` contiguous.
        age: (N,) int64, this step included.
    """
    device = age.device
    bad = torch.zeros(1, dtype=torch.int32, device=device)
    check, move = _kernels()
    grads = [g.contiguous() for g in grads]
    groups = []
    for at in range(0, len(values), TOGETHER):
        some = slice(at, at + TOGETHER)
        ends = list(itertools.accumulate(value.numel() for value in values[some]))
        total, spare = ends[-1], TOGETHER - len(ends)
        pointers = [
            _POINTERS(*[x.data_ptr() for x in group[some]], *[0] * spare) for group in (values, grads, firsts, seconds)
        ]
        widths = _LONGS(*[value[0].numel() for value in values[some]], *[1] * spare)
        own_rates = _FLOATS(*rates[some], *[0.0] * spare)
        groups.append((total, pointers, _LONGS(*ends, *[total + 1] * spare), widths, own_rates))
    flag = array(bad, wp.int32)
    for total, pointers, ends_, _, _ in groups:
        launch(check, total, (pointers[1], ends_, flag), device)
    constants = (*betas, *(1 - beta for beta in betas), *map(math.log, betas), array(age, wp.int64), flag)
    for total, pointers, ends_, widths, own_rates in groups:
        launch(move, total, (*pointers, ends_, widths, own_rates, *constants), device)
    return int(bad) == 0
