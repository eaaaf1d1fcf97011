# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""L1 + SSIM with its analytic gradient in four launches on a GPU: the twin of :mod:`neuprim.core.train.ssim_cpu`, see
there for the derivation.

Blurs are separable: a thread a number, eleven taps along a row, then along a column, and back again for the gradient.
Warp is imported with this module.
"""

import functools
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import OPTIONS, array, launch, wp
from neuprim.core.train.ssim_cpu import SSIM_TAPS, SSIM_WINDOW

_Window = wp.types.vector(length=SSIM_TAPS, dtype=wp.float32)
_vec5 = wp.types.vector(length=5, dtype=wp.float32)
_C1, _C2 = wp.constant(0.01**2), wp.constant(0.03**2)


@functools.cache
def _kernels() -> tuple[Any, Any, Any, Any]:
    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def along_rows(
        a: wp.array3d(dtype=float), b: wp.array3d(dtype=float), window: _Window, out: wp.array3d(dtype=_vec5)
    ):
        """(x, y, xx, yy, xy) blurred along rows of pixels; (H, W - 10, C)."""
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
        """SSIM of every window, (H - 10, W - 10, C), and its derivatives by the means of x, of x^2 and of x y."""
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
        """The adjoint of blurring along columns; (H, W - 10, C)."""
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
        """``by_l1``, ``by_ssim``: weights over numbers of pixels and of windows."""
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


def similarity(rendered: Tensor, truth: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """Means of the absolute difference and of SSIM, (2,) float64, and (H, W, C) the gradient of (1 - weight) L1 +
    weight (1 - SSIM).

    Args:
        rendered, truth: (H, W, C) float32 of at least 11 x 11 pixels, on one device.
    """
    a, b = rendered.contiguous(), truth.contiguous()
    (H, W, C), device = a.shape, a.device
    h, w = H - SSIM_TAPS + 1, W - SSIM_TAPS + 1

    shapes = ((H, w, C, 5), (h, w, C), (h, w, C, 3), (H, w, C, 3), (H, W, C), (H, W, C))
    rows, S, maps, columns, difference, grad = (
        torch.empty(shape, dtype=torch.float32, device=device) for shape in shapes
    )
    window = _window()
    first, second = array(a, wp.float32), array(b, wp.float32)
    along_rows, compare, back_along_columns, gradient = _kernels()
    launch(along_rows, (H, w, C), (first, second, window, array(rows, _vec5)), device)
    launch(compare, (h, w, C), (array(rows, _vec5), window, array(S, wp.float32), array(maps, wp.vec3)), device)
    launch(back_along_columns, (H, w, C), (array(maps, wp.vec3), window, array(columns, wp.vec3)), device)
    by_l1, by_ssim = (1 - weight) / a.numel(), weight / S.numel()
    launch(
        gradient, (H, W, C),
        (first, second, array(columns, wp.vec3), window, by_l1, by_ssim, array(difference, wp.float32),
            array(grad, wp.float32)), device,
    )  # fmt: skip
    return torch.stack([difference.mean(dtype=torch.float64), S.mean(dtype=torch.float64)]), grad


@functools.cache
def _window() -> Any:
    return _Window(*SSIM_WINDOW)
