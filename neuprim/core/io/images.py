"""Image files at the edge: PNG, JPEG, WebP and OpenEXR in; PNG, OpenEXR, WebP and GIF out; the sRGB transfer curve.

PNG, JPEG and WebP hold display-referred sRGB values with *straight* alpha; OpenEXR holds linear light with
*premultiplied* alpha.
Nothing here converts between the two silently. What 8-bit RGB or RGBA holds without loss is read as such (grey,
palettes); all else is refused by name. Colour profiles and EXIF orientation are not applied, as in COLMAP and in the
loaders of the data sets read here.

Every failure is a :class:`~neuprim.core.errors.DataError` that names the file, what was found and what was expected.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import torch
from PIL import Image
from torch import Tensor

from neuprim.core.errors import DataError
from neuprim.core.io.exr import check_finite, write_exr, write_layers
from neuprim.core.io.files import writing
from neuprim.core.io.pictures import (
    MAX_PIXELS,
    check_pixels,
    decode,
    enough_memory,
    open_picture,
    orientation_of,
    rgb_mode,
)

__all__ = [
    "MAX_PIXELS",
    "ImageInfo",
    "exr_channels",
    "image_info",
    "linear_to_srgb",
    "pillow_image",
    "read_image",
    "read_mask",
    "save_animation",
    "srgb_to_linear",
    "to_uint8",
    "write_animation",
    "write_exr",
    "write_layers",
    "write_png",
    "write_webp",
]

_MAX_FLOATS = 16 * MAX_PIXELS
"""Most channel values in one OpenEXR file, as all of its channels are decoded together."""

_EXR = b"\x76\x2f\x31\x01"


@dataclass(frozen=True)
class ImageInfo:
    """What a file's header says.

    Attributes:
        width, height: pixels.
        channels: 3 (RGB) or 4 (RGBA), or as many as were asked for by name.
        linear: True for OpenEXR (linear light, premultiplied alpha), False for PNG, JPEG and WebP (sRGB, straight
        alpha). orientation: EXIF's, 1 to 8; pixels are read as they are stored whatever it says.
    """

    width: int
    height: int
    channels: int
    linear: bool
    orientation: int = 1


# ---------------------------------------------------------------- reading


def image_info(path: Path, channels: Sequence[str] | None = None) -> ImageInfo:
    """Size and channels of an image from its header alone; ``channels`` as of :func:`read_image`.

    Raises:
        DataError: missing, empty, not PNG/JPEG/WebP/OpenEXR, nothing that 8-bit RGB(A) or float RGB(A) holds, without a
        channel that was
            asked for, or larger than :data:`MAX_PIXELS`.
    """
    if _is_exr(path, channels is not None):
        names, width, height = _exr_layout(path, channels)
        return ImageInfo(width, height, len(names), True)
    with enough_memory(path), open_picture(path) as image:
        return ImageInfo(image.width, image.height, len(rgb_mode(path, image)), False, orientation_of(image))


def exr_channels(path: Path) -> tuple[str, ...]:
    """Names of all channels of an OpenEXR file, in the file's own order, which is that of the alphabet.

    Raises:
        DataError: missing, empty, damaged, another format, or larger than :data:`MAX_PIXELS`.
    """
    _is_exr(path, named=True)
    return tuple(_exr_header(path)[0])


def read_image(path: Path, size: tuple[int, int] | None = None, channels: Sequence[str] | None = None) -> Tensor:
    """(H, W, 3 or 4) pixels as stored: uint8 sRGB with straight alpha (PNG, JPEG, WebP), or linear premultiplied float
    (OpenEXR).

    Grey and palette images come as RGB, or RGBA where they have alpha. OpenEXR values come as float16 or float32, as in
    the file, and are never clamped.

    Args:
        size: expected (width, height); any other is an error.
        channels: names of the channels C of an OpenEXR file to read in their stead, in this order, as (H, W, C).

    Raises:
        DataError: as :func:`image_info`; also for truncated or corrupt data, a wrong size, NaN or infinite values.
    """
    with enough_memory(path):
        if _is_exr(path, channels is not None):
            names, width, height = _exr_layout(path, channels)
            _check_size(path, width, height, size)
            return _read_exr(path, names, width, height)
        with open_picture(path) as image:
            mode = rgb_mode(path, image)
            _check_size(path, image.width, image.height, size)
            return torch.from_numpy(decode(path, image, mode))


def read_mask(path: Path, size: tuple[int, int] | None = None) -> Tensor:
    """(H, W) bool from an 8-bit PNG, JPEG or WebP: True where any colour channel is not zero.

    An alpha channel, if there is one, is ignored.

    Raises:
        DataError: as :func:`read_image`.
    """
    with enough_memory(path), open_picture(path) as image:
        rgb_mode(path, image)
        _check_size(path, image.width, image.height, size)
        return torch.from_numpy(decode(path, image, "RGB").any(axis=-1))


def _check_size(path: Path, width: int, height: int, size: tuple[int, int] | None) -> None:
    if size is not None and (width, height) != tuple(size):
        raise DataError(f"{path}: image is {width}x{height}; expected {size[0]}x{size[1]}")


def _is_exr(path: Path, named: bool = False) -> bool:
    try:
        with open(path, "rb") as file:
            head = file.read(8)
    except FileNotFoundError:
        raise DataError(f"{path}: file not found; expected an image") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}); expected an image") from None
    if not head:
        raise DataError(f"{path}: file is empty; expected an image")
    if named and head[:4] != _EXR:
        raise DataError(f"{path}: not an OpenEXR file; expected one, as channels have names in no other")
    return head[:4] == _EXR


def _exr_header(path: Path) -> tuple[dict[str, Any], int, int]:
    """Channels by name, width and height."""
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            parts = len(file.parts)
            header = dict(file.parts[0].header)  # the file's own is emptied when it closes
            low, high, full_low, full_high = (
                [int(v) for v in c] for w in ("dataWindow", "displayWindow") for c in header[w]
            )
            channels = {c.name: c for c in header["channels"]}
            flat = header.get("type", OpenEXR.scanlineimage) in (OpenEXR.scanlineimage, OpenEXR.tiledimage)
    except Exception as error:  # also KeyError and UnicodeDecodeError, from damaged attributes
        raise DataError(f"{path}: OpenEXR header is truncated or corrupt ({type(error).__name__}: {error})") from None
    if parts != 1 or not flat:
        raise DataError(
            f"{path}: OpenEXR file has {parts} parts of type {header.get('type')}; expected 1 part of flat scan lines or tiles"
        )
    if (low, high) != (full_low, full_high):
        raise DataError(
            f"{path}: OpenEXR data window {low}..{high} is not its display window {full_low}..{full_high}; expected equal windows"
        )
    width, height = high[0] - low[0] + 1, high[1] - low[1] + 1
    check_pixels(path, width, height)
    if width * height * len(channels) > _MAX_FLOATS:
        raise DataError(
            f"{path}: header claims {len(channels)} channels of {width}x{height} pixels; at most {_MAX_FLOATS} values are accepted"
        )
    return channels, width, height


def _exr_layout(path: Path, wanted: Sequence[str] | None = None) -> tuple[list[str], int, int]:
    """Names of the wanted channels, or of R, G, B(, A), width and height, from the header."""
    channels, width, height = _exr_header(path)
    names, expected = list(wanted or ()), ", ".join(wanted or ())
    if wanted is None:
        layers = [
            name[:-1]
            for name in channels
            if name.endswith("R") and {name[:-1] + "G", name[:-1] + "B"} <= channels.keys()
        ]
        layers = [""] if "" in layers else layers
        names = [layers[0] + c for c in "RGBA" if layers[0] + c in channels] if len(layers) == 1 else []
        expected = "R, G, B and optionally A, of one layer"
    if not names or not set(names) <= channels.keys():
        raise DataError(
            f"{path}: OpenEXR channels are {', '.join(channels) or 'none'}; expected {expected or 'some to be asked for'}"
        )
    if any(channels[n].xSampling != 1 or channels[n].ySampling != 1 for n in names):
        raise DataError(f"{path}: OpenEXR colour channels are subsampled; expected one value per pixel")
    return names, width, height


def _read_exr(path: Path, names: list[str], width: int, height: int) -> Tensor:
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = [np.array(file.channels()[name].pixels) for name in names]
    except MemoryError:
        raise
    except Exception as error:
        raise DataError(
            f"{path}: OpenEXR data is truncated or corrupt ({error}); expected a complete {width}x{height} image"
        ) from None
    if any(p.dtype not in (np.float16, np.float32) for p in planes):
        raise DataError(
            f"{path}: OpenEXR colour channels are {', '.join(str(p.dtype) for p in planes)}; expected half or float"
        )
    if any(p.shape != (height, width) for p in planes):
        raise DataError(
            f"{path}: OpenEXR data is {planes[0].shape[1]}x{planes[0].shape[0]}; expected {width}x{height} as in its header"
        )
    pixels = np.stack(planes, axis=-1)
    check_finite(path, pixels)
    return torch.from_numpy(pixels)


# ---------------------------------------------------------------- writing


def to_uint8(image: Tensor) -> Tensor:
    """Display-referred values 0..1 of any shape as uint8, rounded and clamped; uint8 is returned as it is.

    Raises:
        DataError: NaN values, which have no place on the scale.
    """
    if image.dtype == torch.uint8:
        return image
    if torch.isnan(image).any():
        raise DataError("image has NaN values; expected numbers to write as 8 bit")
    return (image.detach().float().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def pillow_image(path: Path, image: Tensor) -> Image.Image:
    """(H, W, 3 or 4) sRGB values as Pillow's image of 8 bits; ``path`` is for messages. Raises DataError: wrong shape,
    NaN values."""
    if image.ndim != 3 or image.shape[-1] not in (3, 4) or 0 in image.shape:
        raise DataError(f"{path}: image to write has shape {tuple(image.shape)}; expected (H, W, 3) or (H, W, 4)")
    try:
        return Image.fromarray(to_uint8(image).cpu().contiguous().numpy())
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def _save(path: Path, image: Image.Image, kind: str, **options: Any) -> None:
    with writing(path) as temporary:
        image.save(temporary, format=kind, **options)


def write_png(path: Path, image: Tensor) -> None:
    """Write (H, W, 3 or 4) sRGB values, float 0..1 (clamped, rounded) or uint8, with straight alpha; atomic.

    Raises:
        DataError: wrong shape, NaN values, or the file cannot be written.
    """
    _save(path, pillow_image(path, image), "PNG")


def write_webp(path: Path, image: Tensor, quality: int = 90, lossless: bool = False) -> None:
    """Write (H, W, 3 or 4) sRGB values as a still WebP; arguments and errors as :func:`write_png`; atomic."""
    _save(path, pillow_image(path, image), "WEBP", quality=quality, lossless=lossless)


def write_animation(path: Path, frames: Sequence[Tensor], fps: float, quality: int = 80) -> None:
    """Write (H, W, 3 or 4) sRGB frames as an endless animation; the suffix ``.webp`` or ``.gif`` picks the format;
    atomic.

    GIF keeps 256 colours a frame and whole hundredths of a second, so its rate is the nearest it can hold.

    Raises:
        DataError: no frames, frames of different shapes, an unknown suffix, a rate that is not positive, or as
        :func:`write_png`.
    """
    if not frames or not 0.0 < fps < float("inf"):
        raise DataError(
            f"{path}: {len(frames)} frames at {fps} frames per second; expected at least one frame and a positive rate"
        )
    shapes = sorted({tuple(f.shape) for f in frames})
    if len(shapes) != 1:
        raise DataError(f"{path}: frames have shapes {shapes}; expected one shape")
    images = [pillow_image(path, f) for f in frames]
    save_animation(path, images[0], fps, quality, images[1:])


def save_animation(
    path: Path, first: Image.Image, fps: float, quality: int = 80, rest: Sequence[Image.Image] = ()
) -> None:
    """Write Pillow's images, each with all of its own frames, as :func:`write_animation` does."""
    kind = {".webp": "WEBP", ".gif": "GIF"}.get(path.suffix.lower())
    if kind is None:
        raise DataError(f"{path}: unknown animation format {path.suffix!r}; expected .webp or .gif")
    options: dict[str, Any] = {"quality": quality} if kind == "WEBP" else {"disposal": 2}
    duration = max(1, round(1000.0 / fps)) if kind == "WEBP" else 10 * max(1, round(100.0 / fps))
    _save(path, first, kind, save_all=True, append_images=list(rest), duration=duration, loop=0, **options)


# ---------------------------------------------------------------- transfer curve


def srgb_to_linear(values: Tensor) -> Tensor:
    """IEC 61966-2-1 display-referred values to linear light, any shape; differentiable, not clamped (odd below 0 by its
    linear part)."""
    curve = ((values.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(values <= 0.04045, values / 12.92, curve)


def linear_to_srgb(values: Tensor) -> Tensor:
    """Linear light to IEC 61966-2-1 display-referred values, any shape; differentiable, not clamped; finite gradient at
    0."""
    curve = 1.055 * values.clamp_min(0.0031308) ** (1.0 / 2.4) - 0.055
    return torch.where(values <= 0.0031308, values * 12.92, curve)
