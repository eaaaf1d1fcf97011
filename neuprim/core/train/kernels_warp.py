# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Warp kernels for training steps on a GPU: Adam in two launches, and L1 + SSIM with its gradient in four.

In torch, a step of Adam takes about a hundred launches, longer than rendering a small frame. For the derivation of
SSIM's gradient see :mod:`neuprim.core.train.ssim_cpu`. Warp is imported with this module.
"""

import functools
import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import OPTIONS, array, launch_kernel, wp
from neuprim.core.train.ssim_cpu import SSIM_TAPS, SSIM_WINDOW

# ---------------------------------------------------------------- Adam

LAUNCH_PARAMETERS = 16

_POINTERS = wp.types.vector(length=LAUNCH_PARAMETERS, dtype=wp.uint64)
_LONGS = wp.types.vector(length=LAUNCH_PARAMETERS, dtype=wp.int64)

_FINITE_CODE = """
    return isfinite(reinterpret_cast<const float*>(grad)[i]) ? 1 : 0;
"""
_STEP_CODE = """
    const float g = reinterpret_cast<const float*>(grad)[i];
    float& m = reinterpret_cast<float*>(first)[i];
    float& v = reinterpret_cast<float*>(second)[i];
    m = beta1 * m + rest1 * g;
    v = beta2 * v + rest2 * g * g;
    reinterpret_cast<float*>(value)[i] -= step * m / (sqrtf(v) * slow + 1e-15f);
"""


@wp.func_native(_FINITE_CODE)
def _finite_gradient(grad: wp.uint64, i: wp.int64) -> int: ...


@wp.func_native(_STEP_CODE)
def _step_number(
    value: wp.uint64, grad: wp.uint64, first: wp.uint64, second: wp.uint64, i: wp.int64, step: float, slow: float,
    beta1: float, beta2: float, rest1: float, rest2: float,
): ...  # fmt: skip


@functools.cache
def adam_kernels() -> tuple[Any, Any]:
    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def check(grads: _POINTERS, ends: _LONGS, bad: wp.array(dtype=wp.int32)):
        """Set ``bad`` if a gradient is not finite; one thread per element. ``ends``: cumulative sizes of parameters."""
        n = wp.int64(wp.tid())
        k = int(0)
        begin = wp.int64(0)
        while n >= ends[k]:
            begin = ends[k]
            k += 1
        if _finite_gradient(grads[k], n - begin) == 0:
            bad[0] = 1  # whichever thread writes it

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def step_numbers(
        values: _POINTERS, grads: _POINTERS, firsts: _POINTERS, seconds: _POINTERS, ends: _LONGS, widths: _LONGS,
        rates: wp.array(dtype=float), first_rate: int,
        beta1: float, beta2: float, rest1: float, rest2: float, log1: float, log2: float, age: wp.array(dtype=wp.int64),
        bad: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """Take an Adam step unless ``bad`` is set; one thread per element.

        ``widths``: elements per row; ``rest1``, ``rest2``: 1 - beta, rounded once; ``log1``, ``log2``: logarithms of
        the betas; ``age``: steps of each row before this one; ``first_rate``: place of the first rate in ``rates``.
        """
        n = wp.int64(wp.tid())
        if bad[0] == 0:
            k = int(0)
            begin = wp.int64(0)
            while n >= ends[k]:
                begin = ends[k]
                k += 1
            i = n - begin
            t = float(age[int(i / widths[k])]) + 1.0
            step = rates[first_rate + k] / (1.0 - wp.exp(log1 * t))
            slow = wp.sqrt(1.0 / (1.0 - wp.exp(log2 * t)))
            if t * log2 > -0.25:  # the difference would cancel: 1 - exp(x) = -x (1 + x/2 (1 + x/3 (1 + x/4 (1 + x/5))))
                x = t * log2
                slow = wp.sqrt(1.0 / (-x * (1.0 + x * 0.5 * (1.0 + x / 3.0 * (1.0 + x * 0.25 * (1.0 + x * 0.2))))))
            _step_number(values[k], grads[k], firsts[k], seconds[k], i, step, slow, beta1, beta2, rest1, rest2)

    return check, step_numbers


def adam_rows(
    values: Sequence[Tensor], grads: Sequence[Tensor], firsts: Sequence[Tensor], seconds: Sequence[Tensor],
    rates: Tensor, age: Tensor, betas: tuple[float, float], refused: Tensor,
) -> None:  # fmt: skip
    """Take one Adam step in place, unless ``refused`` is set; set it and change nothing if a gradient is not finite.

    Args:
        values, grads, firsts, seconds: (N, ...) float32, none empty; all but ``grads`` contiguous.
        rates: (P,) float32, one rate per parameter.
        age: (N,) int64, steps of each row before this one; grows by 1.
        refused: (1,) int32.
    """
    device = age.device
    check, step_numbers = adam_kernels()
    grads = [g.contiguous() for g in grads]
    groups = []
    for at in range(0, len(values), LAUNCH_PARAMETERS):
        some = slice(at, at + LAUNCH_PARAMETERS)
        ends = list(itertools.accumulate(value.numel() for value in values[some]))
        total, spare = ends[-1], LAUNCH_PARAMETERS - len(ends)
        pointers = [
            _POINTERS(*[x.data_ptr() for x in group[some]], *[0] * spare) for group in (values, grads, firsts, seconds)
        ]
        widths = _LONGS(*[value[0].numel() for value in values[some]], *[1] * spare)
        groups.append((total, pointers, _LONGS(*ends, *[total + 1] * spare), widths, at))
    flag = array(refused, wp.int32)
    for total, pointers, ends_, _, _ in groups:
        launch_kernel(check, total, (pointers[1], ends_, flag), device)
    constants = (*betas, *(1 - beta for beta in betas), *map(math.log, betas), array(age, wp.int64), flag)
    for total, pointers, ends_, widths, at in groups:
        own = (array(rates, wp.float32), at)
        launch_kernel(step_numbers, total, (*pointers, ends_, widths, *own, *constants), device)
    age += refused == 0


# ---------------------------------------------------------------- L1 + SSIM

_Window = wp.types.vector(length=SSIM_TAPS, dtype=wp.float32)
_vec5 = wp.types.vector(length=5, dtype=wp.float32)
_C1, _C2 = wp.constant(0.01**2), wp.constant(0.03**2)


@functools.cache
def ssim_loss_kernels() -> tuple[Any, Any, Any, Any]:
    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def along_rows(
        a: wp.array3d(dtype=float), b: wp.array3d(dtype=float), window: _Window, out: wp.array3d(dtype=_vec5)
    ):
        """Blur (x, y, xx, yy, xy) of images x and y along pixel rows, to (H, W - 10, C)."""
        y, x, c = wp.tid()
        total = _vec5()
        for k in range(SSIM_TAPS):
            p = a[y, x + k, c]
            q = b[y, x + k, c]
            w = window[k]
            total[0] += w * p
            total[1] += w * q
            total[2] += w * p * p
            total[3] += w * q * q
            total[4] += w * p * q
        out[y, x, c] = total

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def compare(
        rows: wp.array3d(dtype=_vec5), window: _Window, S: wp.array3d(dtype=float), maps: wp.array3d(dtype=wp.vec3)
    ):
        """Compute SSIM, (H - 10, W - 10, C), and its derivatives with respect to the window means of x, x^2 and x y."""
        y, x, c = wp.tid()
        total = _vec5()
        for k in range(SSIM_TAPS):
            total += window[k] * rows[y + k, x, c]
        a = total[0]
        b = total[1]
        A = 2.0 * a * b + _C1
        B = 2.0 * (total[4] - a * b) + _C2
        iC = 1.0 / (a * a + b * b + _C1)
        iD = 1.0 / (total[2] - a * a + total[3] - b * b + _C2)
        s = A * B * iC * iD
        S[y, x, c] = s
        maps[y, x, c] = wp.vec3(2.0 * b * (B - A) * iC * iD - 2.0 * a * s * (iC - iD), -s * iD, 2.0 * A * iC * iD)

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def back_along_columns(maps: wp.array3d(dtype=wp.vec3), window: _Window, out: wp.array3d(dtype=wp.vec3)):
        """Apply the adjoint of the blur along columns, to (H, W - 10, C)."""
        y, x, c = wp.tid()
        total = wp.vec3()
        for k in range(SSIM_TAPS):
            at = y - k
            if at >= 0 and at < maps.shape[0]:
                total += window[k] * maps[at, x, c]
        out[y, x, c] = total

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def gradient(
        a: wp.array3d(dtype=float), b: wp.array3d(dtype=float), columns: wp.array3d(dtype=wp.vec3), window: _Window,
        by_l1: float, by_ssim: float,
        difference: wp.array3d(dtype=float), grad: wp.array3d(dtype=float),
    ):  # fmt: skip
        """Write |a - b| and dloss/da, applying the adjoint of the blur along rows.

        ``by_l1``: weight of L1 / (pixels x channels); ``by_ssim``: weight of SSIM / (windows x channels).
        """
        y, x, c = wp.tid()
        total = wp.vec3()
        for k in range(SSIM_TAPS):
            at = x - k
            if at >= 0 and at < columns.shape[1]:
                total += window[k] * columns[y, at, c]
        p = a[y, x, c]
        q = b[y, x, c]
        d = p - q
        difference[y, x, c] = wp.abs(d)
        sign = float(0.0)
        if d > 0.0:
            sign = 1.0
        if d < 0.0:
            sign = -1.0
        grad[y, x, c] = by_l1 * sign - by_ssim * (total[0] + 2.0 * p * total[1] + q * total[2])

    return along_rows, compare, back_along_columns, gradient


def ssim_loss_with_gradient(rendered: Tensor, truth: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """Return (mean absolute difference, mean SSIM) as (2,) float64, and the (H, W, C) gradient of the loss.

    The loss is (1 - weight) L1 + weight (1 - SSIM).

    Args:
        rendered, truth: (H, W, C) float32, at least 11 x 11 pixels, on the same device.
    """
    a, b = rendered.contiguous(), truth.contiguous()
    (H, W, C), device = a.shape, a.device
    h, w = H - SSIM_TAPS + 1, W - SSIM_TAPS + 1

    shapes = ((H, w, C, 5), (h, w, C), (h, w, C, 3), (H, w, C, 3), (H, W, C), (H, W, C))
    rows, S, maps, columns, difference, grad = (
        torch.empty(shape, dtype=torch.float32, device=device) for shape in shapes
    )
    window = _Window(*SSIM_WINDOW)
    first, second = array(a, wp.float32), array(b, wp.float32)
    along_rows, compare, back_along_columns, gradient = ssim_loss_kernels()
    launch_kernel(along_rows, (H, w, C), (first, second, window, array(rows, _vec5)), device)
    launch_kernel(compare, (h, w, C), (array(rows, _vec5), window, array(S, wp.float32), array(maps, wp.vec3)), device)
    launch_kernel(back_along_columns, (H, w, C), (array(maps, wp.vec3), window, array(columns, wp.vec3)), device)
    by_l1, by_ssim = (1 - weight) / a.numel(), weight / S.numel()
    launch_kernel(
        gradient, (H, W, C),
        (first, second, array(columns, wp.vec3), window, by_l1, by_ssim, array(difference, wp.float32),
            array(grad, wp.float32)), device,
    )  # fmt: skip
    return torch.stack([difference.mean(dtype=torch.float64), S.mean(dtype=torch.float64)]), grad
