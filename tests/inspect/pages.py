"""What a page of ``neuprim inspect`` holds, read back."""

from __future__ import annotations

import base64
import json
import re
import zlib
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["array", "layers_of"]


def layers_of(page: Path) -> dict[str, Any]:
    """The data of a page: frames with their layers and arrays."""
    found = re.search(
        r'<script id="data" type="application/json">(.*?)</script>', page.read_text(encoding="utf-8"), re.DOTALL
    )
    assert found
    data: dict[str, Any] = json.loads(found[1])
    return data


def array(frame: dict[str, Any], place: int, kind: str) -> np.ndarray:
    """One of a frame's arrays, flat."""
    return np.frombuffer(zlib.decompress(base64.b64decode(frame["arrays"][place])), kind)
