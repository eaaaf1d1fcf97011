"""Pictures for report pages: error maps, the worst region of each held-out view, and conversion to ``data:``
addresses."""

from __future__ import annotations

import base64
import io
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from neuprim.core.io import images
from neuprim.core.metrics import comparable_images

ERROR_SCALE = 0.2  # error at the bright end of :func:`error_map` and of the report's colour bar

_INLINE_LIMIT = 400_000
"""Bytes up to which a picture is embedded unchanged; larger pictures are compressed as WebP of quality 90."""

_SIDE_SHARE, MIN_SIDE = 0.25, 16  # side of a region over the shorter side of its image, and in pixels
MAX_REGIONS = 60  # largest number of views whose regions are kept: those with the worst regions
_STEPS = 8  # candidate positions per length of a region's side


def error_map(rendered: Tensor, truth: Tensor, scale: float = ERROR_SCALE) -> NDArray[np.uint8]:
    """Colour the error of a view on a fixed scale, so that maps of different views and runs can be compared.

    The error of a pixel is the mean absolute difference over channels. The colour map is matplotlib's perceptually
    uniform "inferno", linear from 0 (black) to ``scale`` (pale yellow). Larger errors are drawn as ``scale``.

    Args:
        rendered, truth: (H, W, C) float images in the same colour space.

    Returns:
        (H, W, 3) uint8.
    """
    first, second = comparable_images(rendered, truth)
    error = (first - second).abs().mean(-1).numpy()
    return _error_map_colors()[np.rint(np.clip(error / scale, 0.0, 1.0) * 255.0).astype(np.intp)]


def color_bar(stops: int = 13) -> str:
    """Return a CSS gradient with ``stops`` colours of the error map, from zero error on the left to the largest."""
    rows = _error_map_colors()[np.linspace(0, 255, stops).round().astype(np.intp)]
    return "linear-gradient(to right, " + ", ".join("#{:02x}{:02x}{:02x}".format(*row) for row in rows.tolist()) + ")"


def _error_map_colors() -> NDArray[np.uint8]:
    from matplotlib import colormaps  # slow to import, and only reports need it

    return np.asarray(colormaps["inferno"](np.arange(256), bytes=True))[:, :3]


@dataclass(frozen=True)
class InlinedPicture:
    """A picture as a ``data:`` address, and its size in pixels."""

    url: str
    width: int
    height: int


def inline_picture(source: Path | Tensor) -> InlinedPicture | None:
    """Return a picture file or (H, W, 3) image as a ``data:`` address with its size; None for a damaged file."""
    if isinstance(source, Tensor):
        buffer = io.BytesIO()
        Image.fromarray(images.to_uint8(source).numpy()).save(buffer, "PNG")
        content = buffer.getvalue()
    else:
        content = source.read_bytes()
    try:
        with Image.open(io.BytesIO(content)) as image:
            image.load()
            kind = f"image/{(image.format or 'png').lower()}"
            if len(content) > _INLINE_LIMIT and getattr(image, "n_frames", 1) == 1:
                buffer = io.BytesIO()
                image.convert("RGB").save(buffer, "WEBP", quality=90, method=4)
                content, kind = buffer.getvalue(), "image/webp"
            return InlinedPicture(f"data:{kind};base64,{base64.b64encode(content).decode('ascii')}", *image.size)
    except (UnidentifiedImageError, OSError, SyntaxError):
        return None


# ---------------------------------------------------------------- worst regions


@dataclass(frozen=True)
class Region:
    """A square region of a view, in pixels from the upper left corner, and its PSNR in dB (may be infinite)."""

    view: str
    x: int
    y: int
    side: int
    psnr: float

    def of(self, image: Tensor) -> Tensor:
        """Cut the region out of an (H, W, C) image: (side, side, C)."""
        return image[self.y : self.y + self.side, self.x : self.x + self.side]


def worst_region(view: str, rendered: Tensor, truth: Tensor) -> Region:
    """Return the square region with the largest mean squared error.

    The side of the square is a quarter of the image's shorter side, but at least 16 pixels if the image is that large.

    Args:
        rendered, truth: (H, W, C) images in the same colour space.
    """
    height, width = truth.shape[:2]
    side = min(max(round(_SIDE_SHARE * min(height, width)), MIN_SIDE), height, width)
    sums = F.pad((rendered - truth).square().mean(-1).double().cumsum(0).cumsum(1), (1, 0, 1, 0))
    stride = max(side // _STEPS, 1)
    right = sums[:, side:] - sums[:, :-side]
    means = (right[side:] - right[:-side])[::stride, ::stride] / side**2
    row, column = divmod(int(means.argmax()), means.shape[1])
    mse = float(means[row, column])
    return Region(view, column * stride, row * stride, side, -10 * math.log10(mse) if mse > 0 else math.inf)


class WorstRegions:
    """Collector of the worst region of each view. It stores the worst :data:`MAX_REGIONS` and writes pictures of them.

    Args:
        display: function that converts a linear or multi-channel image to the displayed image.
    """

    def __init__(self, display: Callable[[Tensor], Tensor]) -> None:
        self._display = display
        self._found: list[tuple[Region, Tensor]] = []

    def add_view(self, name: str, rendered: Tensor, truth: Tensor) -> None:
        """Find the worst region of a view and store the region, unless the view has no error."""
        region = worst_region(name, rendered, truth)
        if not math.isfinite(region.psnr):
            return
        first, second = region.of(truth), region.of(rendered)
        shown = [images.to_uint8(self._display(x)) for x in (first, second)]
        self._found.append((region, torch.cat([*shown, torch.from_numpy(error_map(second, first))], dim=1)))
        self._found.sort(key=lambda found: found[0].psnr)
        del self._found[MAX_REGIONS:]

    def write(self, folder: Path) -> list[tuple[Region, Path]]:
        """Write ``worst_000.png``, ... (truth, render, error side by side), worst first. Return regions and paths."""
        written = []
        for place, (region, picture) in enumerate(self._found):
            path = folder / f"worst_{place:03d}.png"
            images.write_png(path, picture)
            written.append((region, path))
        return written
