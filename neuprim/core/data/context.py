"""What a scene's loader gets beside its own settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from neuprim.core.compute.device import HOST

__all__ = ["SceneContext"]


@dataclass(frozen=True)
class SceneContext:
    """What a scene's loader gets beside its own settings.

    Attributes:
        seed: for generated scenes.
        cache_dir: where generated data may be kept between runs (keyed by everything that matters).
        progress: called with (text, fraction 0..1) during long work.
        device: what may compute the ground truth where a loader has to; data sets are on the processor either way.
    """

    seed: int
    cache_dir: Path
    progress: Callable[[str, float], None] = lambda text, fraction: None
    device: torch.device = HOST
