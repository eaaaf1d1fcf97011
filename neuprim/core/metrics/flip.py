"""FLIP, the perceptual difference of two images flipped between (Andersson et al. 2020), by ``neuprim[flip]``."""

from __future__ import annotations

from importlib.util import find_spec

import numpy as np
from torch import Tensor

from neuprim.core.errors import BackendUnavailable
from neuprim.core.metrics import matched

PIXELS_PER_DEGREE = 67.0  # the authors' default: a 0.7 m wide screen of 3840 pixels at 0.7 m


def flip_available() -> bool:
    """Whether the package ``flip-evaluator`` is installed."""
    return find_spec("flip_evaluator") is not None


def flip(rendered: Tensor, truth: Tensor) -> float:
    """Mean LDR-FLIP of two (H, W, 3) display-referred sRGB images, clamped to 0..1: 0 for equal ones to 1."""
    try:
        from flip_evaluator import evaluate
    except ImportError as error:
        raise BackendUnavailable(
            f"FLIP needs the package flip-evaluator ({error}); pip install 'neuprim[flip]'"
        ) from error
    first, second = (
        np.ascontiguousarray(x.clamp(0.0, 1.0).numpy(), dtype=np.float32) for x in matched(rendered, truth)
    )
    return float(evaluate(second, first, "LDR", applyMagma=False, parameters={"ppd": PIXELS_PER_DEGREE})[1])
