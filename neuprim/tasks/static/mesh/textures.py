"""Textures as surfaces show them: decoded to linear light, filtered bilinearly, from a smaller copy where a pixel
covers many texels."""

from __future__ import annotations

import io
import warnings
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from neuprim.core.errors import DataError
from neuprim.core.io.exr import MAX_PIXELS
from neuprim.core.io.images import srgb_to_linear
from neuprim.tasks.static.mesh.files import MAX_TEXELS

__all__ = ["Texture", "decode"]

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")
"""What Pillow may decode: it knows formats that run other programs."""

_LINEAR: NDArray[np.float32] = srgb_to_linear(torch.arange(256) / 255.0).numpy()
_ROWS = 256


class Texture:
    """One image and its copies of half, a quarter, ... of its size.

    Args:
        pixels: (H, W, 4) uint8, sRGB with straight alpha.
        wrap: "repeat", "clamp" or "mirror", along u and v.
    """

    def __init__(self, pixels: NDArray[np.uint8], wrap: tuple[str, str] = ("repeat", "repeat")) -> None:
        self.wrap = wrap
        self.levels: list[NDArray] = [pixels]
        while max(self.levels[-1].shape[:2]) > 1:
            self.levels.append(_halved(self.levels[-1]))

    @property
    def texels(self) -> int:
        """Of the image itself."""
        return self.levels[0].shape[0] * self.levels[0].shape[1]

    def look_up(self, uv: NDArray[np.float32], blur: NDArray[np.float32]) -> NDArray[np.float32]:
        """(M, 4) linear RGB and alpha.

        Args:
            uv: (M, 2), v upward; (0, 0) is the lower left corner of the image.
            blur: (M,) texels of the image, along an axis, that one ray stands for.
        """
        level = np.clip(np.round(np.log2(np.maximum(blur, 1.0))), 0, len(self.levels) - 1).astype(np.intp)
        found = np.empty((len(uv), 4), dtype=np.float32)
        for index in np.unique(level):
            mine = np.flatnonzero(level == index)
            found[mine] = self._bilinear(self.levels[index], uv[mine])
        return found

    def _bilinear(self, image: NDArray, uv: NDArray[np.float32]) -> NDArray[np.float32]:
        height, width = image.shape[:2]
        x, y = uv[:, 0].astype(np.float64) * width - 0.5, (1.0 - uv[:, 1].astype(np.float64)) * height - 0.5
        left, top = np.floor(x), np.floor(y)
        across, down = (x - left).astype(np.float32)[:, None], (y - top).astype(np.float32)[:, None]
        x0, x1 = (_wrapped(left + i, width, self.wrap[0]) for i in (0, 1))
        y0, y1 = (_wrapped(top + i, height, self.wrap[1]) for i in (0, 1))
        upper = (1 - across) * _linear(image[y0, x0]) + across * _linear(image[y0, x1])
        lower = (1 - across) * _linear(image[y1, x0]) + across * _linear(image[y1, x1])
        mixed: NDArray[np.float32] = (1 - down) * upper + down * lower
        return mixed


def _wrapped(index: NDArray[np.float64], size: int, wrap: str) -> NDArray[np.intp]:
    if wrap == "clamp":
        return np.clip(index, 0, size - 1).astype(np.intp)
    if wrap == "mirror":
        folded = np.mod(index, 2 * size)
        return np.minimum(folded, 2 * size - 1 - folded).astype(np.intp)
    return np.minimum(np.mod(index, size), size - 1).astype(np.intp)


def _linear(pixels: NDArray) -> NDArray[np.float32]:
    """(..., 4) float32 linear values of uint8 sRGB ones; floats are linear already."""
    if pixels.dtype != np.uint8:
        return pixels.astype(np.float32)
    values = np.empty(pixels.shape, np.float32)
    values[..., :3] = _LINEAR[pixels[..., :3]]
    values[..., 3] = pixels[..., 3] / np.float32(255)
    return values


def _halved(image: NDArray) -> NDArray[np.float16]:
    """Means of 2 x 2 pixels, in linear light; the last row or column of an odd size counts twice."""
    height, width = image.shape[:2]
    half = np.empty(((height + 1) // 2, (width + 1) // 2, 4), np.float16)
    for top in range(0, len(half), _ROWS):
        rows = np.minimum(np.arange(2 * top, min(2 * (top + _ROWS), 2 * len(half))), height - 1)
        columns = np.minimum(np.arange(2 * half.shape[1]), width - 1)
        part = _linear(image[rows][:, columns])
        half[top : top + _ROWS] = part.reshape(len(rows) // 2, 2, half.shape[1], 2, 4).mean(axis=(1, 3))
    return half


def decode(path: Path, name: str, data: bytes, left: int = MAX_TEXELS) -> NDArray[np.uint8]:
    """(H, W, 4) sRGB with straight alpha, of the encoded bytes of an image.

    Args:
        path: of the model, for messages.
        name: of the image.
        left: how many pixels it may have, of those of all textures.

    Raises:
        DataError: damaged, of another format, or too large.
    """
    where = f"{path}: texture {name[:80]!r}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                size = image.width * image.height
                if size > min(MAX_PIXELS, left):
                    most = (
                        f"{MAX_PIXELS} are accepted"
                        if size > MAX_PIXELS
                        else f"{MAX_TEXELS} of all textures are accepted"
                    )
                    raise DataError(f"{where} has {image.width}x{image.height} pixels; at most {most}")
                deep = image.mode.startswith("I")  # 16 bits of grey, which Pillow would cut off at 255
                plain = (
                    Image.fromarray((np.asarray(image, np.int64) >> 8).clip(0, 255).astype(np.uint8)) if deep else image
                )
                return np.array(plain.convert("RGBA"))
    except (DataError, MemoryError):
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise DataError(f"{where} claims more than {MAX_PIXELS} pixels; expected fewer") from None
    except Exception as error:  # Pillow's decoders raise OSError, SyntaxError, ValueError, struct.error, ...
        said = " ".join(str(error).split())[:120]
        raise DataError(
            f"{where} cannot be decoded ({said}); expected {', '.join(FORMATS[:-1])} or {FORMATS[-1]}"
        ) from None
