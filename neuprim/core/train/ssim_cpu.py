"""L1 + SSIM with its analytic gradient, fused and separable, on all cores (a conv2d SSIM costs 100 times as much on a CPU).

SSIM over an 11-tap Gaussian window (sigma 1.5), valid windows only. With window means a = E[x], b = E[y],
A = 2ab + c1, B = 2(E[xy] - ab) + c2, C = a^2 + b^2 + c1, D = E[xx] - a^2 + E[yy] - b^2 + c2: SSIM = AB/(CD). Its derivatives
with respect to E[x], E[xx] and E[xy] are spread back with the adjoint of the same blur.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.render.cpu.compile import inline, kernel
from neuprim.core.render.cpu.threads import parallel_for

__all__ = ["photometric_fused"]

f = np.float32
_TAPS = 11
_x = np.arange(_TAPS) - 5.0
_WINDOW = (np.exp(-(_x**2) / (2 * 1.5**2)) / np.exp(-(_x**2) / (2 * 1.5**2)).sum()).astype(np.float32)
_ROWS = 16  # rows per band; fixed, so that sums do not depend on the number of threads
_BLOCK = 512  # floats of a row at a time, so that scratch arrays lie at constant offsets
_EX, _EY, _EXX, _EYY, _EXY = 0, _BLOCK, 2 * _BLOCK, 3 * _BLOCK, 4 * _BLOCK
_C1, _C2 = f(0.01**2), f(0.03**2)


@inline
def _add_scaled(out, x, w):  # type: ignore[no-untyped-def]
    for j in range(out.shape[0]):
        out[j] += w * x[j]


@inline
def _add_product(out, x, y, w):  # type: ignore[no-untyped-def]
    for j in range(out.shape[0]):
        out[j] += w * x[j] * y[j]


@inline
def _derivatives(s, n, scale):  # type: ignore[no-untyped-def]
    """In place on blocks E[x], E[y], E[xx], E[yy], E[xy]: derivatives of scale x SSIM for E[x], E[xx], E[xy]; returns the sum of SSIM."""
    total = f(0)
    for j in range(n):
        a, b = s[_EX + j], s[_EY + j]
        A = f(2) * a * b + _C1
        B = f(2) * (s[_EXY + j] - a * b) + _C2
        C = a * a + b * b + _C1
        D = s[_EXX + j] - a * a + s[_EYY + j] - b * b + _C2
        iC, iD = f(1) / C, f(1) / D
        S = A * B * iC * iD
        total += S
        s[_EX + j] = (f(2) * b * (B - A) * iC * iD - f(2) * a * S * (iC - iD)) * scale
        s[_EXX + j] = -S * iD * scale
        s[_EXY + j] = f(2) * A * iC * iD * scale
    return total


@kernel
def _similarity(start, stop, x, y, channels, grad_mean, grad_xx, grad_xy):  # type: ignore[no-untyped-def]
    """Window rows start:stop: derivative maps of the mean SSIM; returns the sum of SSIM over them."""
    n = x.shape[1]
    m = n - (_TAPS - 1) * channels
    scale = f(1) / f((x.shape[0] - _TAPS + 1) * m)
    v = np.zeros((5, n), np.float32)
    s = np.zeros(5 * _BLOCK, np.float32)
    total = 0.0
    for r in range(start, stop):
        v[:] = f(0)
        for k in range(_TAPS):  # vertical blur first: long contiguous rows
            w, xr, yr = _WINDOW[k], x[r + k], y[r + k]
            _add_scaled(v[0], xr, w)
            _add_scaled(v[1], yr, w)
            _add_product(v[2], xr, xr, w)
            _add_product(v[3], yr, yr, w)
            _add_product(v[4], xr, yr, w)
        for j0 in range(0, m, _BLOCK):
            size = min(_BLOCK, m - j0)
            s[:] = f(0)
            for q in range(5):
                for k in range(_TAPS):
                    at = j0 + k * channels
                    _add_scaled(s[q * _BLOCK : q * _BLOCK + size], v[q, at : at + size], _WINDOW[k])
            total += _derivatives(s, size, scale)
            grad_mean[r, j0 : j0 + size] = s[_EX : _EX + size]
            grad_xx[r, j0 : j0 + size] = s[_EXX : _EXX + size]
            grad_xy[r, j0 : j0 + size] = s[_EXY : _EXY + size]
    return total


@inline
def _finish_row(gr, h0, xr, yr, h1, h2, l1_share, weight):  # type: ignore[no-untyped-def]
    """gr = L1 and SSIM gradient of one image row; returns the sum of |x - y|."""
    for j in range(gr.shape[0]):
        gr[j] = f(2) * xr[j] * h1[j]
    for j in range(gr.shape[0]):
        gr[j] += yr[j] * h2[j]
    for j in range(gr.shape[0]):
        gr[j] = -weight * (gr[j] + h0[j])
    line = f(0)
    for j in range(gr.shape[0]):
        d = xr[j] - yr[j]
        line += abs(d)
        gr[j] += l1_share if d > f(0) else (-l1_share if d < f(0) else f(0))
    return line


@kernel
def _spread(start, stop, x, y, channels, grad_mean, grad_xx, grad_xy, weight, grad):  # type: ignore[no-untyped-def]
    """Image rows start:stop of d loss / d x; returns the sum of |x - y|."""
    n, m, windows = x.shape[1], grad_mean.shape[1], grad_mean.shape[0]
    v = np.zeros((3, m), np.float32)
    h = np.zeros((3, n), np.float32)
    l1_share = (f(1) - weight) / f(x.shape[0] * n)
    total = 0.0
    for i in range(start, stop):
        v[:] = f(0)
        for k in range(max(0, i - windows + 1), min(_TAPS, i + 1)):
            w, r = _WINDOW[k], i - k
            _add_scaled(v[0], grad_mean[r], w)
            _add_scaled(v[1], grad_xx[r], w)
            _add_scaled(v[2], grad_xy[r], w)
        h[:] = f(0)
        for q in range(3):
            for k in range(_TAPS):
                _add_scaled(h[q, k * channels : k * channels + m], v[q], _WINDOW[k])
        total += _finish_row(grad[i], h[0], x[i], y[i], h[1], h[2], l1_share, weight)
    return total


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rendered: Tensor, truth: Tensor, weight: float, parts: dict[str, float]) -> Tensor:
        H, W, C = rendered.shape
        x = np.ascontiguousarray(rendered.detach().numpy()).reshape(H, W * C)
        y = np.ascontiguousarray(truth.detach().numpy()).reshape(H, W * C)
        windows, m = H - _TAPS + 1, (W - _TAPS + 1) * C
        maps = [np.empty((windows, m), np.float32) for _ in range(3)]
        similarity = sum(parallel_for(_similarity, windows, _ROWS, 0, x, y, C, *maps)) / (windows * m)
        grad = np.empty((H, W * C), np.float32)
        l1 = sum(parallel_for(_spread, H, _ROWS, 0, x, y, C, *maps, np.float32(weight), grad)) / x.size
        parts["l1"], parts["ssim"] = float(l1), float(similarity)
        ctx.save_for_backward(torch.from_numpy(grad).reshape(H, W, C))
        return torch.tensor((1 - weight) * l1 + weight * (1 - similarity), dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        (grad,) = ctx.saved_tensors
        return grad * g, None, None, None


def photometric_fused(rendered: Tensor, truth: Tensor, ssim_weight: float) -> tuple[Tensor, dict[str, float]]:
    """Same value and gradient as :func:`~neuprim.core.train.losses.photometric_reference`, float32 CPU images of at least 11 x 11."""
    parts: dict[str, float] = {}
    loss: Tensor = _Photometric.apply(rendered, truth, ssim_weight, parts)
    return loss, parts
