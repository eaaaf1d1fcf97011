"""Read and write OpenEXR files with any named channels. Files are written atomically.

Channels without a prefix are the image (R, G, B and premultiplied A). A prefix and a dot name a layer, e.g.
``depth.Z``.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import torch
from torch import Tensor

from neuprim.core.errors import DataError, warn_once
from neuprim.core.io.files import checked_atomic_path

__all__ = ["ExrChannel", "exr_channels", "read_exr", "write_exr", "write_exr_layers"]

MAX_PIXELS = 64 * 2**20
"""Largest number of pixels of an image (8192 x 8192). Larger images are refused before memory is allocated."""

REC709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
"""Chromaticities (CIE xy) of red, green, blue and white of Rec. 709, which files have that state none."""

_MAX_VALUES = 16 * MAX_PIXELS  # most values of all channels of a file, which are decoded together
_MAX_HALF = 65504.0

COMPRESSIONS = {
    "zip": OpenEXR.ZIP_COMPRESSION,
    "piz": OpenEXR.PIZ_COMPRESSION,
    "dwaa": OpenEXR.DWAA_COMPRESSION,
}
"""Compressions of written files. All are lossless, except dwaa for :data:`_DWA_COLORS`."""

_DWA_COLORS = ("R", "G", "B", "Y", "RY", "BY")  # last parts of names of channels that dwaa stores as half floats

_MAX_NAME_BYTES = 31  # longest channel name that every reader of OpenEXR accepts
_MAGIC = b"\x76\x2f\x31\x01"


def check_image_file_size(path: Path, width: int, height: int) -> None:
    """Raise DataError unless an image has at least one pixel and at most :data:`MAX_PIXELS`."""
    if width <= 0 or height <= 0:
        raise DataError(f"{path}: header claims {width}x{height} pixels; expected a positive size")
    if width * height > MAX_PIXELS:
        raise DataError(f"{path}: header claims {width}x{height} pixels; at most {MAX_PIXELS} are accepted")


@contextmanager
def refuse_image_file_beyond_memory(path: Path) -> Iterator[None]:
    """Convert a MemoryError in the block to a DataError that names the image; damaged headers can claim huge sizes."""
    try:
        yield
    except MemoryError:
        what = "reading the image needs more memory than available; it is damaged or too large"
        raise DataError(f"{path}: {what}") from None


def default_exr_channel_names(count: int) -> tuple[str, ...]:
    """Return names for ``count`` channels: R, G, B for three, Y for one, else c0, c1, ..."""
    return {1: ("Y",), 3: ("R", "G", "B")}.get(count, tuple(f"c{i}" for i in range(count)))


def exr_channel_name_error(names: Sequence[Any]) -> str | None:
    """Return a message ``[INDEX] PROBLEM; expected ...`` for the first invalid or repeated channel name, else None."""
    used: set[str] = set()
    for i, name in enumerate(names):
        if not isinstance(name, str):
            return f"[{i}] is of type {type(name).__name__}; expected text"
        if not name.strip() or name != name.strip() or not name.isprintable() or len(name.encode()) > _MAX_NAME_BYTES:
            expected = f"1 to {_MAX_NAME_BYTES} bytes of printable text without blanks around it"
            return f"[{i}] is {name[:60]!r}; expected {expected}"
        if name == "A":
            return f"[{i}] is 'A'; expected another name, as A is alpha in OpenEXR files"
        if name in used:
            return f"[{i}] is {name!r} again; expected different names"
        used.add(name)
    return None


def is_exr(path: Path, required: bool = False) -> bool:
    """Return whether a file starts like an OpenEXR file.

    Raises DataError if the file is unreadable or empty or, with ``required``, if it is not OpenEXR.
    """
    try:
        with open(path, "rb") as file:
            head = file.read(8)
    except FileNotFoundError:
        raise DataError(f"{path}: file not found; expected an image") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}); expected an image") from None
    if not head:
        raise DataError(f"{path}: file is empty; expected an image")
    if required and head[:4] != _MAGIC:
        raise DataError(f"{path}: not an OpenEXR file; expected OpenEXR, because other formats have no channel names")
    return head[:4] == _MAGIC


def exr_channels(path: Path) -> tuple[str, ...]:
    """Return the names of all channels of an OpenEXR file, in alphabetical order; raises DataError."""
    is_exr(path, required=True)
    return tuple(_read_exr_header(path)[0])


def read_exr_layout(path: Path, wanted: Sequence[str] | None = None) -> tuple[list[str], int, int]:
    """Return the names of the channels to read from an OpenEXR file, and the image's width and height in pixels.

    The names are ``wanted``. If ``wanted`` is None, the names are R, G, B and, if present, A: without a prefix, else
    with the prefix of the only layer that has these channels. Raises DataError for missing or subsampled channels.
    """
    channels, width, height, primaries = _read_exr_header(path)
    if wanted is None and not np.allclose(primaries, REC709, rtol=0, atol=2e-3):
        warn_once(f"{path.parent}: OpenEXR files have other chromaticities than Rec. 709; colours are not converted")
    names, expected = list(wanted or ()), ", ".join(wanted or ())
    if wanted is None:
        prefixes = [n[:-1] for n in channels if n.endswith("R") and {n[:-1] + "G", n[:-1] + "B"} <= channels.keys()]
        prefixes = [""] if "" in prefixes else prefixes
        names = [prefixes[0] + c for c in "RGBA" if prefixes[0] + c in channels] if len(prefixes) == 1 else []
        expected = "R, G, B and optionally A, of one layer"
    if not names or not set(names) <= channels.keys():
        found = f"OpenEXR channels are {', '.join(channels) or 'none'}"
        raise DataError(f"{path}: {found}; expected {expected or 'at least one requested channel'}")
    if any(channels[n].xSampling != 1 or channels[n].ySampling != 1 for n in names):
        raise DataError(f"{path}: OpenEXR colour channels are subsampled; expected one value per pixel")
    return names, width, height


def _read_exr_header(path: Path) -> tuple[dict[str, Any], int, int, tuple[float, ...]]:
    """Return channels by name, width, height and chromaticities of an OpenEXR file.

    Raises DataError if the header is damaged, or the file is too large or of another kind.
    """
    try:
        with OpenEXR.File(str(path), separate_channels=True, header_only=True) as file:
            parts = len(file.parts)
            header = dict(file.parts[0].header)  # the file's own is emptied when it closes
            low, high, full_low, full_high = (
                [int(v) for v in corner] for window in ("dataWindow", "displayWindow") for corner in header[window]
            )
            channels = {c.name: c for c in header["channels"]}
            primaries = tuple(float(x) for x in header.get("chromaticities", REC709))
            flat = header.get("type", OpenEXR.scanlineimage) in (OpenEXR.scanlineimage, OpenEXR.tiledimage)
    except Exception as error:  # also KeyError and UnicodeDecodeError, from damaged attributes
        raise DataError(f"{path}: OpenEXR header is truncated or corrupt ({type(error).__name__}: {error})") from None
    if parts != 1 or not flat:
        found = f"OpenEXR file has {parts} parts of type {header.get('type')}"
        raise DataError(f"{path}: {found}; expected 1 part of flat scan lines or tiles")
    if (low, high) != (full_low, full_high):
        found = f"OpenEXR data window {low}..{high} differs from the display window {full_low}..{full_high}"
        raise DataError(f"{path}: {found}; expected equal windows")
    width, height = high[0] - low[0] + 1, high[1] - low[1] + 1
    check_image_file_size(path, width, height)
    if width * height * len(channels) > _MAX_VALUES:
        found = f"header claims {len(channels)} channels of {width}x{height} pixels"
        raise DataError(f"{path}: {found}; at most {_MAX_VALUES} values are accepted")
    return channels, width, height, primaries


def read_exr(path: Path, names: Sequence[str], width: int, height: int) -> Tensor:
    """Read channels ``names`` as (H, W, C) float16 or float32; DataError for damage, another size, NaN or infinity."""
    try:
        with OpenEXR.File(str(path), separate_channels=True) as file:
            planes = [np.array(file.channels()[name].pixels) for name in names]
    except MemoryError:
        raise
    except Exception as error:
        found = f"OpenEXR data is truncated or corrupt ({error})"
        raise DataError(f"{path}: {found}; expected a complete {width}x{height} image") from None
    if any(p.dtype not in (np.float16, np.float32) for p in planes):
        kinds = ", ".join(str(p.dtype) for p in planes)
        raise DataError(f"{path}: OpenEXR colour channels are {kinds}; expected half or float")
    if any(p.shape != (height, width) for p in planes):
        actual = f"{planes[0].shape[1]}x{planes[0].shape[0]}"
        raise DataError(f"{path}: OpenEXR data is {actual}; expected {width}x{height} as in its header")
    pixels = np.stack(planes, axis=-1)
    bad = ~np.isfinite(pixels)
    if bad.any():
        row, column, channel = (int(i[0]) for i in np.nonzero(bad))
        found = f"value {pixels[row, column, channel]} at row {row}, column {column}, channel {channel}"
        raise DataError(f"{path}: {found}; expected finite numbers")
    return torch.from_numpy(pixels)


@dataclass(frozen=True)
class ExrChannel:
    """One channel of an OpenEXR file to write."""

    values: Tensor  # (H, W) finite numbers
    half: bool = False  # store 16-bit instead of 32-bit floats


def write_exr(path: Path, image: Tensor, half: bool = True, names: Sequence[str] | None = None) -> None:
    """Write an OpenEXR file: (H, W, 3 or 4) linear premultiplied RGB(A), or (H, W, C) values of channels ``names``."""
    error = None if names is None else exr_channel_name_error(names)
    if error:
        raise DataError(f"{path}: names{error}")
    counts = (3, 4) if names is None else (len(names),)
    if image.ndim != 3 or 0 in image.shape or image.shape[-1] not in counts:
        expected = " or ".join(f"(H, W, {count})" for count in counts)
        raise DataError(f"{path}: image to write has shape {tuple(image.shape)}; expected {expected}")
    names = names or "RGBA"[: image.shape[-1]]
    write_exr_layers(path, {name: ExrChannel(image[..., i], half) for i, name in enumerate(names)})


def write_exr_layers(
    path: Path,
    channels: Mapping[str, ExrChannel],
    attributes: Mapping[str, Any] | None = None,
    compression: str = "zip",
    visible: Tensor | None = None,
) -> None:
    """Write an image of several layers as one OpenEXR file.

    Args:
        channels: channel name, with the prefix of its layer -> channel. All channels have the same size. Values of half
            floats, and of colours with dwaa, are at most 65504.
        attributes: header attributes: text, numbers, float32 arrays of shape (2,), (3,) or (4, 4), lists of floats.
        compression: name in :data:`COMPRESSIONS`.
        visible: (H, W) bool; the file stores only the smallest rectangle that contains these pixels, its data window.
            If there are none, it stores the first pixel. None: store all pixels.
    """
    shapes = sorted({tuple(channel.values.shape) for channel in channels.values()})
    if len(shapes) != 1 or len(shapes[0]) != 2 or 0 in shapes[0]:
        raise DataError(f"{path}: channels to write have shapes {shapes}; expected the same (H, W) for all")
    stored = {name: _exr_values(f"{path}: channel {name}", channel) for name, channel in channels.items()}
    for name, values in stored.items():
        if compression == "dwaa" and name.split(".")[-1] in _DWA_COLORS and (most := np.abs(values).max()) > _MAX_HALF:
            found = f"channel {name}: value {most:.6g} does not fit the compression dwaa (at most {_MAX_HALF:.0f})"
            raise DataError(f"{path}: {found}; expected zip or piz")
    header = {**(attributes or {}), "compression": COMPRESSIONS[compression], "type": OpenEXR.scanlineimage}
    if visible is not None:
        (top, bottom), (left, right) = (_first_and_last(visible.any(1 - axis)) for axis in (0, 1))
        stored = {n: np.ascontiguousarray(v[top : bottom + 1, left : right + 1]) for n, v in stored.items()}
        height, width = visible.shape
        for window, corners in (
            ("dataWindow", ((left, top), (right, bottom))),
            ("displayWindow", ((0, 0), (width - 1, height - 1))),
        ):
            header[window] = tuple(np.array(corner, np.int32) for corner in corners)
    _write_exr_file(path, header, stored)


def write_deep_exr(
    path: Path,
    counts: Tensor,
    samples: Mapping[str, ExrChannel],
    attributes: Mapping[str, Any] | None = None,
) -> None:
    """Write a deep OpenEXR file: any number of samples in each pixel.

    Args:
        counts: (H, W) int64 numbers of samples.
        samples: channel name -> channel with (S, 1) values of all samples, row by row of pixels.
        attributes: header attributes, see :func:`write_exr_layers`.
    """
    numbers = counts.flatten()
    filled, ends = numbers.nonzero()[:, 0].tolist() or [0], numbers.cumsum(0)  # OpenEXR takes the type from a pixel
    stored = {}
    for name, channel in samples.items():
        parts = np.split(_exr_values(f"{path}: channel {name}", channel)[:, 0], ends[:-1].numpy())
        pixels = np.empty(len(numbers), dtype=object)  # None where a pixel is empty
        for i in filled:
            pixels[i] = parts[i]
        stored[name] = pixels.reshape(tuple(counts.shape))
    header = {**(attributes or {}), "compression": OpenEXR.ZIPS_COMPRESSION, "type": OpenEXR.deepscanline}
    _write_exr_file(path, header, stored)


def _write_exr_file(path: Path, header: dict[str, Any], stored: dict[str, np.ndarray]) -> None:
    with checked_atomic_path(path) as temporary:
        try:
            with OpenEXR.File(header, stored) as file:
                file.write(str(temporary))
        except RuntimeError as error:
            raise DataError(f"{path}: cannot be written ({error})") from None


def _first_and_last(flags: Tensor) -> tuple[int, int]:
    """Return the indices of the first and the last True of (N,) ``flags``; 0 and 0 if there is none."""
    found = flags.nonzero()[:, 0].tolist() or [0]
    return found[0], found[-1]


def _exr_values(where: str, channel: ExrChannel) -> np.ndarray:
    values = channel.values.detach().cpu().float().numpy()
    bad = np.argwhere(~np.isfinite(values))
    if len(bad):
        y, x = bad[0].tolist()
        raise DataError(f"{where}: value {values[y, x]} at row {y}, column {x}; expected finite numbers")
    if channel.half and np.abs(values).max(initial=0.0) > _MAX_HALF:
        found = f"value {np.abs(values).max():.6g} does not fit 16-bit floats (at most {_MAX_HALF:.0f})"
        raise DataError(f"{where}: {found}; write 32-bit floats (half=False)")
    return np.ascontiguousarray(values, dtype=np.float16 if channel.half else np.float32)
