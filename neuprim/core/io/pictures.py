"""PNG, JPEG and WebP files read by Pillow as 8-bit RGB or RGBA, and every other image refused by name."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image

from neuprim.core.errors import DataError

__all__ = ["MAX_PIXELS", "check_pixels", "decode", "enough_memory", "open_picture", "orientation_of", "rgb_mode"]

MAX_PIXELS = 64 * 2**20
"""Largest image read: 67,108,864 pixels (8192 x 8192). A header that claims more is refused before any pixel memory is
taken."""

_FOREIGN = {
    "AVIF": (4, (b"ftypavif", b"ftypavis")),
    "HEIF": (4, (b"ftyphei", b"ftyphev", b"ftypmif1", b"ftypmsf1")),
    "TIFF": (0, (b"II*\0", b"MM\0*")),
    "GIF": (0, (b"GIF8",)),
    "BMP": (0, (b"BM",)),
    "JPEG 2000": (4, (b"jP  ",)),
    "JPEG XL": (0, (b"\xff\x0a", b"\0\0\0\x0cJXL ")),
}
"""Formats that are refused by name: where in the file their first bytes are, and what these can be."""

_PNG_KINDS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}


@contextmanager
def enough_memory(path: Path) -> Iterator[None]:
    """Turns a lack of memory inside into a DataError that names the file; damaged files ask for more than they hold,
    too."""
    try:
        yield
    except MemoryError:
        raise DataError(
            f"{path}: reading the image takes more memory than there is; is it damaged, or too large?"
        ) from None


@contextmanager
def open_picture(path: Path) -> Iterator[Image.Image]:
    """The opened, not yet decoded image; refuses foreign formats and sizes beyond MAX_PIXELS."""
    try:
        image = Image.open(path, formats=("PNG", "JPEG", "WEBP"))
    except FileNotFoundError:
        raise DataError(f"{path}: file not found; expected an image") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise DataError(f"{path}: header claims more than {MAX_PIXELS} pixels; larger images are refused") from None
    except Exception as error:  # Pillow's plugins raise many types for damaged headers
        if isinstance(error, MemoryError):
            raise
        kind = _foreign(path)
        if kind:
            raise DataError(
                f"{path}: image is {kind}; expected PNG, JPEG, WebP or OpenEXR: convert it to one of them"
            ) from None
        raise DataError(
            f"{path}: not a readable PNG or JPEG image ({type(error).__name__}: {error}); expected PNG, JPEG, WebP or OpenEXR"
        ) from None
    with image:
        check_pixels(path, image.width, image.height)
        yield image


def _foreign(path: Path) -> str:
    """The name of a format that is not read; "" for an unknown one."""
    with open(path, "rb") as file:
        head = file.read(16)
    return next((name for name, (at, marks) in _FOREIGN.items() if head[at:].startswith(marks)), "")


def check_pixels(path: Path, width: int, height: int) -> None:
    if width <= 0 or height <= 0:
        raise DataError(f"{path}: header claims {width}x{height} pixels; expected a positive size")
    if width * height > MAX_PIXELS:
        raise DataError(f"{path}: header claims {width}x{height} pixels; at most {MAX_PIXELS} are accepted")


def _png_header(path: Path) -> tuple[int, int]:
    """(bit depth, colour type) of a PNG; (0, -1) for other files. Pillow opens 16-bit RGB as 8-bit without saying
    so."""
    with open(path, "rb") as file:
        head = file.read(26)
    return (head[24], head[25]) if head[:8] == b"\x89PNG\r\n\x1a\n" and len(head) == 26 else (0, -1)


def _describe(path: Path, image: Image.Image) -> str:
    depth, kind = _png_header(path)
    if kind >= 0:
        return f"{depth}-bit {_PNG_KINDS.get(kind, 'unknown')} PNG"
    return {"L": "8-bit grey JPEG", "CMYK": "CMYK JPEG"}.get(image.mode, f"{image.format} of mode {image.mode}")


def rgb_mode(path: Path, image: Image.Image) -> str:
    """RGB or RGBA, whichever holds the image without loss.

    Raises:
        DataError: neither does, or it is an animation.
    """
    depth, _ = _png_header(path)
    if depth == 16 or image.mode not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
        raise DataError(f"{path}: image is {_describe(path, image)}; expected 8-bit RGB or RGBA")
    if image.mode != "P" and "transparency" in image.info:
        raise DataError(f"{path}: image is {image.mode} with a transparent colour key (tRNS); expected RGB or RGBA")
    if (
        getattr(image, "n_frames", 1) > 1 and image.format != "MPO"
    ):  # cameras keep previews in the further pictures of a JPEG
        raise DataError(f"{path}: image is an animation; expected one picture")
    return "RGBA" if image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info else "RGB"


def orientation_of(image: Image.Image) -> int:
    """EXIF's orientation; 1 where there is none, or none that is readable."""
    try:
        found = (
            image.getexif().get(0x0112, 1) if "exif" in image.info else 1
        )  # without the chunk in front, Pillow would decode a PNG
    except Exception:
        return 1
    return found if isinstance(found, int) and 1 <= found <= 8 else 1


def decode(path: Path, image: Image.Image, mode: str) -> np.ndarray:
    try:
        image.load()
        return np.array(image if image.mode == mode else image.convert(mode))
    except MemoryError:
        raise
    except Exception as error:  # Pillow's decoders raise OSError, SyntaxError, ValueError, struct.error, ...
        raise DataError(
            f"{path}: image data is truncated or corrupt ({error}); expected a complete {image.width}x{image.height} image"
        ) from None
