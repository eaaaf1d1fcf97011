"""Built-in losses that any task may use, as ``train.loss=NAME``; registered like anybody's."""

from __future__ import annotations

from neuprim.core.extensions import LossExtension
from neuprim.core.task import API_VERSION
from neuprim.core.train.losses import photometric

__all__ = ["PHOTOMETRIC"]

PHOTOMETRIC = LossExtension(API_VERSION, "photometric", "(1 - w) L1 + w (1 - SSIM), w = train.ssim_weight", photometric)
