"""What a scene's loader gets beside its own settings."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from neuprim.core.cameras.world import World
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
        world: of the model that the scene is loaded for again, whose coordinates it keeps; None: the scene's own
        choice.
    """

    seed: int
    cache_dir: Path
    progress: Callable[[str, float], None] = lambda text, fraction: None
    device: torch.device = HOST
    world: World | None = None
