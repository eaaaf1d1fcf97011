# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Warp kernels for training steps on a GPU: Adam, and the L1 + SSIM loss with its gradient.

Adam takes two launches per parameter, the loss four launches. :mod:`neuprim.core.train.ssim_cpu` derives the gradient
of SSIM. Importing this module imports Warp.
"""

import functools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import OPTIONS, Floats, Ints, Longs, array, launch_kernel, wp
from neuprim.core.train.ssim_cpu import SSIM_TAPS, SSIM_WINDOW

# ---------------------------------------------------------------- Adam


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def check_adam_gradient(grad: Floats, refused: Ints):
    """Set the flag ``refused`` if a number in ``grad`` is NaN or infinite; one thread per number."""
    if not wp.isfinite(grad[wp.tid()]):
        refused[0] = 1  # whichever thread writes it


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def take_adam_step(
    value: Floats, grad: Floats, first: Floats, second: Floats, width: int, rates: Floats, parameter: int,
    beta1: float, beta2: float, rest1: float, rest2: float, log1: float, log2: float, age: Longs, refused: Ints,
):  # fmt: skip
    """Take an Adam step in place unless the flag ``refused`` is set; one thread per number of ``value``.

    ``first`` and ``second`` are Adam's moments. A row (the numbers of one primitive) has ``width`` numbers; ``age``
    counts the steps of each row before this one. The learning rate is ``rates[parameter]``. ``rest1`` and ``rest2`` are
    1 - ``beta1`` and 1 - ``beta2``, rounded once. ``log1`` and ``log2`` are the logarithms of ``beta1`` and ``beta2``.
    """
    i = wp.tid()
    if refused[0] == 0:
        t = float(age[i // width]) + 1.0
        step = rates[parameter] / (1.0 - wp.exp(log1 * t))
        slow = wp.sqrt(1.0 / (1.0 - wp.exp(log2 * t)))
        if t * log2 > -0.25:  # the difference would cancel: 1 - exp(x) = -x (1 + x/2 (1 + x/3 (1 + x/4 (1 + x/5))))
            x = t * log2
            slow = wp.sqrt(1.0 / (-x * (1.0 + x * 0.5 * (1.0 + x / 3.0 * (1.0 + x * 0.25 * (1.0 + x * 0.2))))))
        g = grad[i]
        m = beta1 * first[i] + rest1 * g
        v = beta2 * second[i] + rest2 * g * g
        first[i] = m
        second[i] = v
        value[i] -= step * m / (wp.sqrt(v) * slow + 1e-15)


def adam_rows(
    values: Sequence[Tensor], grads: Sequence[Tensor], firsts: Sequence[Tensor], seconds: Sequence[Tensor],
    rates: Tensor, age: Tensor, betas: tuple[float, float], refused: Tensor,
) -> None:  # fmt: skip
    """Take one Adam step in place, unless the flag ``refused`` is set. If a gradient is not finite, only set the flag.

    Args:
        values, grads, firsts, seconds: lists of P float32 tensors (N, ...), none empty, contiguous except ``grads``.
            ``firsts`` and ``seconds`` are Adam's moments.
        rates: (P,) float32, the learning rates.
        age: (N,) int64, number of steps of each row (primitive) before this step; grows by 1 unless ``refused`` is set.
        betas: decays of the first and of the second moment.
        refused: (1,) int32 flag.
    """
    device, flag = age.device, array(refused, wp.int32)
    flat = [tuple(array(x.contiguous().view(-1), wp.float32) for x in each) for each in zip(
        values, grads, firsts, seconds, strict=True)]  # fmt: skip
    for value, (_, grad, _, _) in zip(values, flat, strict=True):
        launch_kernel(check_adam_gradient, value.numel(), (grad, flag), device)
    constants = (*betas, *(1 - beta for beta in betas), *map(math.log, betas), array(age, wp.int64), flag)
    for at, (value, arrays) in enumerate(zip(values, flat, strict=True)):
        own = (value[0].numel(), array(rates, wp.float32), at)
        launch_kernel(take_adam_step, value.numel(), (*arrays, *own, *constants), device)
    age += refused == 0


# ---------------------------------------------------------------- L1 + SSIM

_Window = wp.types.vector(length=SSIM_TAPS, dtype=wp.float32)
_vec5 = wp.types.vector(length=5, dtype=wp.float32)
_C1, _C2 = wp.constant(0.01**2), wp.constant(0.03**2)


@functools.cache
def ssim_loss_kernels() -> tuple[Any, Any, Any, Any]:
    """Return the kernels of :func:`ssim_loss_with_gradient` in launch order, one thread per number of the output."""

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def along_rows(
        a: wp.array3d(dtype=float), b: wp.array3d(dtype=float), window: _Window, out: wp.array3d(dtype=_vec5)
    ):
        """Blur a, b, a^2, b^2 and ab of images a and b (H, W, C) horizontally, into ``out`` (H, W - 10, C)."""
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
        """Blur ``rows`` vertically and compute the SSIM of the images a and b from it, into ``S`` (H - 10, W - 10, C).

        ``rows`` is the result of ``along_rows``. ``maps`` gets the derivatives of SSIM with respect to the window means
        of a, a^2 and ab.
        """
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
        """Apply the adjoint of the vertical blur to ``maps`` (H - 10, W - 10, C), into ``out`` (H, W - 10, C)."""
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
        """Write |a - b| into ``difference``, and the gradient of the loss with respect to ``a`` into ``grad``.

        ``columns`` has the derivatives of SSIM after the adjoint of the vertical blur; this kernel applies the adjoint
        of the horizontal blur. ``by_l1`` is the weight of L1 over (pixels x channels), ``by_ssim`` the weight of SSIM
        over (windows x channels).
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

    The loss is (1 - weight) L1 + weight (1 - SSIM). The gradient is with respect to ``rendered``.

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
