"""What ranks that train one model must have in common before the first step."""

from __future__ import annotations

import hashlib
from typing import Any

from neuprim.core.train.restoring import names_of
from neuprim.core.train.trainer import Trainer

__all__ = ["beginning"]


def beginning(trainer: Trainer) -> dict[str, Any]:
    """Name -> what two ranks compare, in short texts and numbers."""
    views = trainer.dataset.train
    if trainer.settings.shard:  # before they are: a rank is not to have the moments of all
        tensors = {
            **{name: value.detach() for name, value in trainer.model.params.items()},
            "generator": trainer.generator.get_state(),
        }
    else:
        tensors, _ = trainer.state()
    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        digest.update(
            f"{name} {value.dtype} {tuple(value.shape)}".encode() + value.contiguous().cpu().numpy().tobytes()
        )
    settings = hashlib.sha256(repr((trainer.settings, trainer.renderer)).encode())
    pixels = hashlib.sha256(views.pixels(0).rgb.numpy().tobytes())
    return {
        "steps done": trainer.step,
        "training views": f"{len(views)} ({names_of(views)})",
        "pixels of the first view": pixels.hexdigest()[:16],
        "settings": settings.hexdigest()[:16],
        "state": digest.hexdigest()[:16],
    }
