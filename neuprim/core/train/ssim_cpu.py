"""L1 + SSIM loss of two images x and y, and its analytic gradient with respect to x, on all CPU cores.

SSIM uses an 11 x 11 Gaussian window (sigma 1.5), computed as two blurs of 11 taps. Only windows inside the image count.
With the window means a = E[x] and b = E[y], SSIM is AB/(CD). A = 2ab + c1, B = 2(E[xy] - ab) + c2, C = a^2 + b^2 + c1
and D = E[xx] - a^2 + E[yy] - b^2 + c2, with c1 = 0.01^2 and c2 = 0.03^2. The adjoint of the blur turns SSIM's
derivatives with respect to E[x], E[xx] and E[xy] into a gradient per pixel. Where both images are equal, as in an empty
background, SSIM is 1 and the gradient 0. So the kernels skip columns at the left and right if both images are equal
there in all rows of a window.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute.kernels import exact_kernel, inline, kernel
from neuprim.core.compute.threads import parallel_for

SSIM_TAPS = 11
_offsets = np.arange(SSIM_TAPS) - 5.0
_gaussian = np.exp(-(_offsets**2) / (2 * 1.5**2))
SSIM_WINDOW: list[float] = (_gaussian / _gaussian.sum()).tolist()
"""Weights of the SSIM window along one axis: 11 taps of a Gaussian with sigma 1.5 pixels, as in kornia."""

f = np.float32
index = np.uint64  # an unsigned index cannot count from the end, which lets LLVM vectorise
_WINDOW = np.array(SSIM_WINDOW, np.float32)
_ROWS = 16  # rows per band; fixed, so that sums do not depend on the number of threads
_BLOCK = 512  # outputs of a row at a time, so that scratch arrays lie at constant offsets in the nearest cache
_WIDE = 1024  # the same with the window's reach of 10 pixels; bounds the channels at 51
_EX, _EY, _EXX, _EYY, _EXY = 0, _BLOCK, 2 * _BLOCK, 3 * _BLOCK, 4 * _BLOCK
_C1, _C2 = f(0.01**2), f(0.03**2)


@inline
def _vertical_loss_moments(V, x, y, at, pitch, count):  # type: ignore[no-untyped-def]
    """Blur x, y, x^2, y^2 and xy vertically, over 11 rows of the flat images ``x`` and ``y``, with sums in registers.

    Result j of ``count`` begins at position ``at`` + j; ``pitch`` is the length of a row. ``V`` gets five blocks of
    results, ``_WIDE`` numbers apart.
    """
    for j in range(count):
        s0, s1, s2, s3, s4 = f(0), f(0), f(0), f(0), f(0)
        for k in range(SSIM_TAPS):
            i = index(at + k * pitch + j)
            w, a, b = _WINDOW[k], x[i], y[i]
            wa, wb = w * a, w * b
            s0 += wa
            s1 += wb
            s2 += wa * a
            s3 += wb * b
            s4 += wa * b
        V[j], V[_WIDE + j], V[2 * _WIDE + j], V[3 * _WIDE + j], V[4 * _WIDE + j] = s0, s1, s2, s3, s4


@inline
def _blur_loss_columns(V, g, at, pitch, count):  # type: ignore[no-untyped-def]
    """Fill V[:count] with the vertical blur of the flat map ``g`` from position ``at``; ``pitch`` numbers per row."""
    for j in range(count):
        s = f(0)
        for k in range(SSIM_TAPS):
            s += _WINDOW[k] * g[index(at + k * pitch + j)]
        V[j] = s


@inline
def _blur_loss_rows(out, V, step, count):  # type: ignore[no-untyped-def]
    """Fill out[:count] with the horizontal blur of ``V``, in which neighbouring pixels are ``step`` numbers apart."""
    for j in range(count):
        s = f(0)
        for k in range(SSIM_TAPS):
            s += _WINDOW[k] * V[index(j + k * step)]
        out[j] = s


@inline
def _ssim_loss_derivatives(s, n, scale):  # type: ignore[no-untyped-def]
    """Replace window means by the derivatives of scale x SSIM with respect to the means; return the sum of SSIM.

    ``s`` has five blocks: E[x], E[y], E[xx], E[yy] and E[xy]. The function uses the first ``n`` numbers of each block,
    and replaces the numbers of E[x], E[xx] and E[xy].
    """
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


@exact_kernel
def _find_unequal_columns(start, stop, x, y, height, unequal):  # type: ignore[no-untyped-def]
    """Set unequal[i], for image rows i in start:stop, to the column range [first, end) where images differ.

    ``x`` and ``y`` are flat images with ``height`` rows; a column is one channel of one pixel. A row that is equal in
    both images gets first > end.
    """
    n = x.shape[0] // height
    for i in range(start, stop):
        first, end = 0, n
        while first < n and x[i * n + first] == y[i * n + first]:
            first += 1
        while end > first and x[i * n + end - 1] == y[i * n + end - 1]:
            end -= 1
        unequal[i, 0], unequal[i, 1] = (first, end) if end > first else (n, 0)


@inline
def _widest_columns(unequal, start, stop, before, after, most):  # type: ignore[no-untyped-def]
    """Return one range [first, end) of columns that contains all differences of the two images in rows start:stop.

    ``unequal`` has the range of each row, from :func:`_find_unequal_columns`. The returned range begins ``before``
    columns earlier and ends ``after`` columns later, within [0, most). If nothing differs, the range is empty (end is
    first); in images narrower than 20 pixels, it may contain columns.
    """
    first, end = most, np.int64(0)
    for i in range(start, stop):
        first, end = min(first, unequal[i, 0] - before), max(end, unequal[i, 1] + after)
    first = max(first, 0)
    return first, max(min(end, most), first)


@kernel
def _ssim_loss_maps(start, stop, x, y, height, channels, unequal, maps):  # type: ignore[no-untyped-def]
    """Write derivatives of the mean SSIM for window rows start:stop; return the sum of SSIM over these rows.

    ``x`` and ``y`` are flat images of (height, width, channels). ``unequal`` comes from :func:`_find_unequal_columns`.
    The three planes of ``maps`` get the derivatives with respect to E[x], E[xx] and E[xy]. A plane has one derivative
    per window and channel, and a border of zeros, 10 windows wide, on every side.
    """
    n = x.shape[0] // height
    reach = (SSIM_TAPS - 1) * channels
    m = n - reach
    scale = f(1) / f((height - SSIM_TAPS + 1) * m)
    V = np.zeros(5 * _WIDE, np.float32)
    s = np.zeros(5 * _BLOCK, np.float32)
    total = 0.0
    for r in range(start, stop):
        first, end = _widest_columns(unequal, r, r + SSIM_TAPS, reach, 0, m)
        total += m - (end - first)
        for q in range(3):
            row = maps[q, r + SSIM_TAPS - 1]
            row[: reach + first] = f(0)
            row[reach + end :] = f(0)
        for j0 in range(first, end, _BLOCK):
            size = min(_BLOCK, end - j0)
            _vertical_loss_moments(V, x, y, r * n + j0, n, size + reach)
            for q in range(5):
                _blur_loss_rows(s[q * _BLOCK :], V[q * _WIDE :], channels, size)
            total += _ssim_loss_derivatives(s, size, scale)
            for q, block in enumerate((_EX, _EXX, _EXY)):
                row = maps[q, r + SSIM_TAPS - 1]
                row[reach + j0 : reach + j0 + size] = s[block : block + size]
    return total


@inline
def _loss_gradient(gr, x, y, s, n, l1_share, weight):  # type: ignore[no-untyped-def]
    """Write the gradient of the loss with respect to ``x`` into ``gr``, for ``n`` numbers; return the sum of |x - y|.

    ``s`` has the three derivative maps of SSIM after the adjoint blur, one block per map. ``l1_share`` is the gradient
    of the L1 loss where x > y, ``weight`` the weight of SSIM in the loss.
    """
    line = f(0)
    for j in range(n):
        a, b = x[j], y[j]
        d = a - b
        line += abs(d)
        sign = l1_share if d > f(0) else (-l1_share if d < f(0) else f(0))
        gr[j] = sign - weight * (s[j] + f(2) * a * s[_BLOCK + j] + b * s[2 * _BLOCK + j])
    return line


@kernel
def _spread_loss_gradient(start, stop, x, y, height, channels, unequal, maps, weight, grad):  # type: ignore[no-untyped-def]
    """Write rows start:stop of the gradient d loss / d x into ``grad``; return the sum of |x - y|.

    The adjoint of the SSIM blur distributes the derivatives in ``maps`` over the pixels of each window. ``weight`` is
    the weight of SSIM in the loss.
    """
    n = x.shape[0] // height
    pitch = maps.shape[2]
    reach = (SSIM_TAPS - 1) * channels
    V = np.zeros(_WIDE, np.float32)
    s = np.zeros(3 * _BLOCK, np.float32)
    l1_share = (f(1) - weight) / f(x.shape[0])
    total = 0.0
    for i in range(start, stop):
        low, high = max(i - SSIM_TAPS + 1, 0), min(i + SSIM_TAPS, height)
        first, end = _widest_columns(unequal, low, high, reach, reach, n)
        grad[i * n : i * n + first] = f(0)
        grad[i * n + end : (i + 1) * n] = f(0)
        for j0 in range(first, end, _BLOCK):
            size = min(_BLOCK, end - j0)
            for q in range(3):
                _blur_loss_columns(
                    V, maps[q].reshape(-1), i * pitch + j0, pitch, size + reach
                )  # the window is symmetric
                _blur_loss_rows(s[q * _BLOCK :], V, channels, size)
            at = i * n + j0
            total += _loss_gradient(grad[at:], x[at:], y[at:], s, size, l1_share, weight)
    return total


_buffers = threading.local()


def _bordered_loss_maps(rows: int, columns: int) -> Any:
    """Return memory for three maps (3, rows, columns) with a zero border; a thread reuses it while sizes are equal."""
    maps = getattr(_buffers, "maps", None)
    if maps is None or maps.shape != (3, rows, columns):
        maps = _buffers.maps = np.zeros((3, rows, columns), np.float32)
    return maps


def ssim_loss_with_gradient(rendered: Tensor, truth: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """Return (mean absolute difference, mean SSIM) as (2,) float64, and the (H, W, C) gradient of the loss.

    The loss is (1 - weight) L1 + weight (1 - SSIM). The gradient is with respect to ``rendered``.

    Args:
        rendered, truth: (H, W, C) float32, at least 11 x 11 pixels, at most 51 channels.
    """
    H, W, C = rendered.shape
    x, y = (np.ascontiguousarray(image.numpy()).reshape(-1) for image in (rendered, truth))
    windows, m = H - SSIM_TAPS + 1, (W - SSIM_TAPS + 1) * C
    maps, unequal = _bordered_loss_maps(windows + 20, m + 20 * C), np.empty((H, 2), np.int64)
    parallel_for(_find_unequal_columns, H, _ROWS, 0, x, y, H, unequal)
    ssim = sum(parallel_for(_ssim_loss_maps, windows, _ROWS, 0, x, y, H, C, unequal, maps)) / (windows * m)
    work, grad = (H, _ROWS, 0, x, y, H, C, unequal, maps, np.float32(weight)), np.empty(x.size, np.float32)
    l1 = sum(parallel_for(_spread_loss_gradient, *work, grad)) / x.size
    return torch.tensor([l1, ssim], dtype=torch.float64), torch.from_numpy(grad).reshape(H, W, C)
