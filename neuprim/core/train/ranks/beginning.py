"""What ranks that train one model must have in common before the first step."""

from __future__ import annotations

import hashlib
from typing import Any

from neuprim.core.train.trainer import Trainer

__all__ = ["beginning"]


def beginning(trainer: Trainer) -> dict[str, Any]:
    """Name -> what two ranks compare, in short texts and numbers."""
    tensors, header = trainer.state()
    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {tuple(value.shape)}".encode() + value.contiguous().numpy().tobytes())
    settings = hashlib.sha256(repr((trainer.settings, trainer.renderer)).encode())
    views = trainer.dataset.train
    pixels = hashlib.sha256(views.pixels(0).rgb.numpy().tobytes())
    return {
        "steps done": header["step"],
        "training views": f"{header['views']} ({header['names']})",
        "pixels of the first view": pixels.hexdigest()[:16],
        "settings": settings.hexdigest()[:16],
        "state": digest.hexdigest()[:16],
    }
