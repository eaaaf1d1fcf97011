"""What the generated scenes' settings have in common: the images' size, and a key for the cache."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict
from typing import Annotated, Any

from neuprim.core.validation import Range

__all__ = ["ImageSize", "Supersampling", "settings_key"]

ImageSize = Annotated[int, Range(8, 4096)]
"""Width and height in pixels."""

Supersampling = Annotated[int, Range(1, 16)]
"""Rays per pixel along each axis."""


def settings_key(settings: Any, version: int) -> str:
    """A short hash of every field of a settings dataclass and the generator's version."""
    text = json.dumps({"version": version, **asdict(settings)}, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]
