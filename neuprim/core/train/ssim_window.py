"""The window of SSIM for kernels in numba and Warp: 11 taps of a Gaussian of 1.5 pixels, as kornia has it."""

from __future__ import annotations

import numpy as np

__all__ = ["SSIM_TAPS", "SSIM_WINDOW"]

SSIM_TAPS = 11
_x = np.arange(SSIM_TAPS) - 5.0
SSIM_WINDOW: list[float] = (np.exp(-(_x**2) / (2 * 1.5**2)) / np.exp(-(_x**2) / (2 * 1.5**2)).sum()).tolist()
