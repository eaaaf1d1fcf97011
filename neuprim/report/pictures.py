"""Error maps, and pictures written into the page itself."""

from __future__ import annotations

import base64
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from neuprim.core.errors import ConfigError
from neuprim.core.metrics import comparable_images

ERROR_SCALE = 0.2  # error at the bright end of :func:`error_map` and of the report's colour bar

_INLINE_LIMIT = 400_000
"""Bytes up to which a picture enters the page unchanged; larger ones are compressed as WebP of quality 90."""


def error_map(rendered: Tensor, truth: Tensor, scale: float = ERROR_SCALE) -> NDArray[np.uint8]:
    """Colour the error of a view on a fixed scale, so that maps of different views and runs compare.

    The mean absolute difference over channels runs linearly from 0 (black) to ``scale`` (pale yellow) through
    matplotlib's perceptually uniform "inferno"; larger errors are drawn as ``scale``.

    Args:
        rendered, truth: (H, W, C) float images in the same colour space.

    Returns:
        (H, W, 3) uint8.
    """
    if not scale > 0:
        raise ConfigError(f"scale of the error map must be positive, found {scale}")
    first, second = comparable_images(rendered, truth)
    error = (first - second).abs().mean(-1).numpy()
    return _error_map_colors()[np.rint(np.clip(error / scale, 0.0, 1.0) * 255.0).astype(np.intp)]


def color_bar(stops: int = 13) -> str:
    """Return a CSS gradient of the error map's colours, left to right."""
    rows = _error_map_colors()[np.linspace(0, 255, stops).round().astype(np.intp)]
    return "linear-gradient(to right, " + ", ".join("#{:02x}{:02x}{:02x}".format(*row) for row in rows.tolist()) + ")"


def _error_map_colors() -> NDArray[np.uint8]:
    from matplotlib import colormaps  # slow to import, and only reports need it

    return np.asarray(colormaps["inferno"](np.arange(256), bytes=True))[:, :3]


@dataclass(frozen=True)
class InlinedPicture:
    """A picture as a ``data:`` address, its size in pixels, and whether it was compressed on the way."""

    url: str
    width: int
    height: int
    compressed: bool


def inline_picture(path: Path) -> InlinedPicture | None:
    """Return a picture file for an ``img`` element; None if it is damaged, as an interrupted run may leave it."""
    content = path.read_bytes()
    try:
        with Image.open(io.BytesIO(content)) as image:
            image.load()
            kind, plain = f"image/{(image.format or 'png').lower()}", image.mode in ("L", "P", "RGB", "RGBA")
            compressed = len(content) > _INLINE_LIMIT and plain and getattr(image, "n_frames", 1) == 1
            if compressed:
                buffer, clear = io.BytesIO(), image.mode == "RGBA" or "transparency" in image.info
                image.convert("RGBA" if clear else "RGB").save(buffer, "WEBP", quality=90, method=4)
                content, kind = buffer.getvalue(), "image/webp"
            url = f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}"
            return InlinedPicture(url, *image.size, compressed)
    except (UnidentifiedImageError, OSError, SyntaxError):
        return None
