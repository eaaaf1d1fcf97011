"""The window of SSIM on a card: 11 taps of a Gaussian of 1.5 pixels, as kornia has it."""

from __future__ import annotations

import numpy as np

__all__ = ["TAPS", "WINDOW"]

TAPS = 11
_x = np.arange(TAPS) - 5.0
WINDOW: list[float] = (np.exp(-(_x**2) / (2 * 1.5**2)) / np.exp(-(_x**2) / (2 * 1.5**2)).sum()).tolist()
