"""Compiled CPU kernels for the SSIM and squared error of two images: float64, all cores, no copies of images."""

from __future__ import annotations

from typing import Any

import numpy as np
from torch import Tensor

from neuprim.core.compute.kernels import exact_kernel, inline, kernel
from neuprim.core.compute.threads import parallel_for

SSIM_WINDOW = 11  # taps of the Gaussian window per axis (Wang et al. 2004)

SSIM_SIGMA = 1.5  # standard deviation of that window in pixels

index = np.uint64  # an unsigned index cannot count from the end, which lets LLVM vectorise
_TAPS = np.exp(-((np.arange(SSIM_WINDOW) - SSIM_WINDOW // 2) ** 2) / (2 * SSIM_SIGMA**2))
_TAPS /= _TAPS.sum()
_ROWS = 16  # rows per band; fixed, so that sums do not depend on the number of threads
_BLOCK = 512  # windows of a row at a time, so that moments stay in the nearest cache
_PIXELS = 1 << 15  # pixels whose errors are summed at a time


@inline
def _blur_moments_down(moments, x, y, at, pitch, count):  # type: ignore[no-untyped-def]
    """Fill ``moments`` (5, at least ``count``) with the blurred x, y, x^2, y^2 and xy of two flattened images x and y.

    The function does only the vertical half of the Gaussian blur, over 11 rows of ``pitch`` values. The first value is
    at the index ``at``.
    """
    for j in range(count):
        s0, s1, s2, s3, s4 = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(SSIM_WINDOW):
            i = index(at + k * pitch + j)
            a, b = x[i], y[i]
            wa, wb = _TAPS[k] * a, _TAPS[k] * b
            s0 += wa
            s1 += wb
            s2 += wa * a
            s3 += wb * b
            s4 += wa * b
        moments[0, j], moments[1, j], moments[2, j], moments[3, j], moments[4, j] = s0, s1, s2, s3, s4


@inline
def _blur_across(out, row, channels, count):  # type: ignore[no-untyped-def]
    """Fill ``out`` with the horizontal half of the Gaussian blur of ``row``; a pixel has ``channels`` values."""
    for j in range(count):
        s = 0.0
        for k in range(SSIM_WINDOW):
            s += _TAPS[k] * row[index(j + k * channels)]
        out[j] = s


@inline
def _sum_ssim_of_moments(s, count, c1, c2):  # type: ignore[no-untyped-def]
    """Return the sum of SSIM over ``count`` windows, from their means ``s`` (5, count) of x, y, x^2, y^2 and xy."""
    total = 0.0
    for j in range(count):
        a, b = s[0, j], s[1, j]
        ab, squares = a * b, a * a + b * b
        top = (2.0 * ab + c1) * (2.0 * (s[4, j] - ab) + c2)
        total += top / ((squares + c1) * (s[2, j] + s[3, j] - squares + c2))
    return total


@kernel
def _sum_ssim_of_rows(start, stop, x, y, height, channels, c1, c2):  # type: ignore[no-untyped-def]
    """Return the sum of SSIM over the 11 x 11 windows whose top row is in start:stop.

    x and y are flattened images (height, width, channels). With ``peak``, the largest possible value, c1 is (0.01
    peak)^2 and c2 is (0.03 peak)^2.
    """
    pitch = x.shape[0] // height
    reach = (SSIM_WINDOW - 1) * channels
    windows = pitch - reach
    columns, moments = np.zeros((5, _BLOCK + reach)), np.zeros((5, _BLOCK))
    total = 0.0
    for r in range(start, stop):
        for first in range(0, windows, _BLOCK):
            count = min(_BLOCK, windows - first)
            _blur_moments_down(columns, x, y, r * pitch + first, pitch, count + reach)
            for q in range(5):
                _blur_across(moments[q], columns[q], channels, count)
            total += _sum_ssim_of_moments(moments, count, c1, c2)
    return total


def mean_ssim(first: Tensor, second: Tensor, peak: float) -> float:
    """Return the mean SSIM over channels and over the positions where an 11 x 11 window lies inside the images.

    With window means E: SSIM = (2 E[x]E[y] + c1) (2 cov + c2) / ((E[x]^2 + E[y]^2 + c1) (var x + var y + c2)). With the
    largest possible value ``peak``, c1 = (0.01 peak)^2 and c2 = (0.03 peak)^2.

    Args:
        first, second: (H, W, C) float32 or float64, of at least 11 x 11 pixels.
    """
    height, width, channels = first.shape
    x, y = _flat_values(first), _flat_values(second)
    rows, columns = height - SSIM_WINDOW + 1, width - SSIM_WINDOW + 1
    constants = (0.01 * peak) ** 2, (0.03 * peak) ** 2
    sums = parallel_for(_sum_ssim_of_rows, rows, _ROWS, 0, x, y, height, channels, *constants)
    return float(sum(sums)) / (rows * columns * channels)


@exact_kernel
def _sum_squares_of_pixels(start, stop, x, y, counted, channels):  # type: ignore[no-untyped-def]
    """Return the sum of squared differences of flattened images x and y over the pixels start:stop.

    Only pixels where ``counted`` is True count; an empty ``counted`` selects all pixels.
    """
    total = 0.0
    for pixel in range(start, stop):
        if counted.size == 0 or counted[pixel]:
            for i in range(pixel * channels, (pixel + 1) * channels):
                difference = np.float64(x[i]) - np.float64(y[i])
                total += difference * difference
    return total


def sum_squared_errors(first: Tensor, second: Tensor, mask: Tensor | None) -> float:
    """Return the sum of squared differences of two (H, W, C) images, float32 or float64.

    Only pixels where the (H, W) bool ``mask`` is True count; None selects all pixels.
    """
    channels, count = first.shape[-1], first.shape[0] * first.shape[1]
    counted = np.empty(0, np.bool_) if mask is None else _flat_values(mask)
    images = _flat_values(first), _flat_values(second)
    return float(sum(parallel_for(_sum_squares_of_pixels, count, _PIXELS, 0, *images, counted, channels)))


def _flat_values(image: Tensor) -> Any:
    return image.contiguous().numpy().reshape(-1)
