"""Read and write PNG, JPEG, WebP and OpenEXR images and animations, and convert between sRGB and linear light.

PNG, JPEG and WebP hold display-referred sRGB values with *straight* alpha, OpenEXR linear light with *premultiplied*
alpha. Grey and palette images are read as RGB(A). Images that 8-bit RGB(A) cannot represent exactly are refused. Colour
profiles and EXIF orientation are not applied, as in COLMAP. Every failure is a :class:`~neuprim.core.errors.DataError`.
"""

from __future__ import annotations

import base64
import io
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import torch
from PIL import Image, TiffImagePlugin
from torch import Tensor

from neuprim.core.errors import BackendUnavailable, DataError
from neuprim.core.io.exr import (
    MAX_PIXELS,
    check_image_file_size,
    is_exr,
    read_exr,
    read_exr_layout,
    refuse_image_file_beyond_memory,
)
from neuprim.core.io.files import atomic_path, checked_atomic_path

# formats that are refused by name -> byte offset of their signature, and possible signatures
_OTHER_FORMATS = {
    "AVIF": (4, (b"ftypavif", b"ftypavis")),
    "HEIF": (4, (b"ftyphei", b"ftyphev", b"ftypmif1", b"ftypmsf1")),
    "TIFF": (0, (b"II*\0", b"MM\0*")),
    "GIF": (0, (b"GIF8",)),
    "BMP": (0, (b"BM",)),
    "JPEG 2000": (4, (b"jP  ",)),
    "JPEG XL": (0, (b"\xff\x0a", b"\0\0\0\x0cJXL ")),
}
_PNG_KINDS = {0: "grey", 2: "RGB", 3: "palette", 4: "grey with alpha", 6: "RGBA"}
_EXIF_ORIENTATION = 0x0112


__all__ = ["FrameSpool", "ImageInfo", "image_info", "linear_to_srgb", "read_image", "read_mask_image"]
__all__ += ["srgb_to_linear", "write_animation", "write_png", "write_webp"]


@dataclass(frozen=True)
class ImageInfo:
    """Size and channels of an image file, from its header."""

    width: int
    height: int
    channels: int  # 3 (RGB), 4 (RGBA), or the number of OpenEXR channels that were asked for by name
    linear: bool  # True for OpenEXR: linear light, premultiplied alpha; else sRGB, straight alpha
    orientation: int = 1  # orientation of EXIF, 1 to 8; reading ignores it


def image_info(path: Path, channels: Sequence[str] | None = None) -> ImageInfo:
    """Return size and channels of an image from its header. Arguments and errors are as in :func:`read_image`."""
    if is_exr(path, required=channels is not None):
        names, width, height = read_exr_layout(path, channels)
        return ImageInfo(width, height, len(names), True)
    with refuse_image_file_beyond_memory(path), _open_image(path) as image:
        return ImageInfo(image.width, image.height, len(_lossless_mode(path, image)), False, _exif_orientation(image))


def read_image(path: Path, size: tuple[int, int] | None = None, channels: Sequence[str] | None = None) -> Tensor:
    """Return (H, W, 3 or 4) pixels: uint8 sRGB with straight alpha, or premultiplied linear floats (OpenEXR).

    Args:
        path: PNG, JPEG, WebP or OpenEXR file.
        size: expected (width, height); None for any.
        channels: names of OpenEXR channels to read as (H, W, C), instead of R, G, B(, A).

    Raises:
        DataError: the file is missing, damaged, of another size or format, or too large.
    """
    with refuse_image_file_beyond_memory(path):
        if is_exr(path, required=channels is not None):
            names, width, height = read_exr_layout(path, channels)
            _check_image_size(path, width, height, size)
            return read_exr(path, names, width, height)
        with _open_image(path) as image:
            mode = _lossless_mode(path, image)
            _check_image_size(path, image.width, image.height, size)
            return torch.from_numpy(_decode_image(path, image, mode))


def read_mask_image(path: Path, size: tuple[int, int] | None = None) -> Tensor:
    """Read a PNG, JPEG or WebP as (H, W) bool mask: True where a colour channel is not 0.

    Raises the errors of :func:`read_image`, and DataError if pixels with a colour are transparent.
    """
    with refuse_image_file_beyond_memory(path), _open_image(path) as image:
        mode = _lossless_mode(path, image)
        _check_image_size(path, image.width, image.height, size)
        pixels = _decode_image(path, image, mode)
        colored = pixels[..., :3].any(axis=-1)
        if mode == "RGBA" and (colored & (pixels[..., 3] == 0)).any():  # some programs mask by alpha
            what = "transparent pixels of the mask are not black"
            raise DataError(f"{path}: {what}; expected black and white without alpha")
        return torch.from_numpy(colored)


def _check_image_size(path: Path, width: int, height: int, size: tuple[int, int] | None) -> None:
    if size is not None and (width, height) != tuple(size):
        raise DataError(f"{path}: image is {width}x{height}; expected {size[0]}x{size[1]}")


@contextmanager
def _open_image(path: Path) -> Iterator[Image.Image]:
    """Open a PNG, JPEG or WebP without decoding pixels; DataError for other formats and sizes above MAX_PIXELS."""
    try:
        image = Image.open(path, formats=("PNG", "JPEG", "WEBP"))
    except FileNotFoundError:
        raise DataError(f"{path}: file not found; expected an image") from None
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise DataError(f"{path}: header claims more than {MAX_PIXELS} pixels; larger images are refused") from None
    except MemoryError:
        raise
    except Exception as error:  # Pillow's plugins raise many types for damaged headers
        with open(path, "rb") as file:
            head = file.read(16)
        expected = "PNG, JPEG, WebP or OpenEXR"
        for name, (at, signatures) in _OTHER_FORMATS.items():
            if head[at:].startswith(signatures):
                raise DataError(f"{path}: image is {name}; expected {expected}: convert it to one of them") from None
        found = f"not a readable PNG or JPEG image ({type(error).__name__}: {error})"
        raise DataError(f"{path}: {found}; expected {expected}") from None
    with image:
        check_image_file_size(path, image.width, image.height)
        yield image


def _png_depth_and_kind(path: Path) -> tuple[int, int]:
    """Return (bit depth, colour type) of a PNG; (0, -1) for other files.

    Pillow does not provide the bit depth, because it opens 16-bit RGB as 8-bit.
    """
    with open(path, "rb") as file:
        head = file.read(26)
    return (head[24], head[25]) if head[:8] == b"\x89PNG\r\n\x1a\n" and len(head) == 26 else (0, -1)


def _lossless_mode(path: Path, image: Image.Image) -> str:
    """Return "RGB" or "RGBA", the mode that stores the image without loss.

    Raises DataError if there is no such mode, or for animations.
    """
    depth, kind = _png_depth_and_kind(path)
    if depth == 16 or image.mode not in ("1", "L", "LA", "P", "PA", "RGB", "RGBA"):
        what = {"L": "8-bit grey JPEG", "CMYK": "CMYK JPEG"}.get(image.mode, f"{image.format} of mode {image.mode}")
        if kind >= 0:
            what = f"{depth}-bit {_PNG_KINDS.get(kind, 'unknown')} PNG"
        raise DataError(f"{path}: image is {what}; expected 8-bit RGB or RGBA")
    if image.mode != "P" and "transparency" in image.info:
        raise DataError(f"{path}: image is {image.mode} with a transparent colour key (tRNS); expected RGB or RGBA")
    # Cameras store previews as further pictures of a JPEG, which Pillow calls MPO.
    if getattr(image, "n_frames", 1) > 1 and image.format != "MPO":
        raise DataError(f"{path}: image is an animation; expected one picture")
    return "RGBA" if image.mode in ("LA", "PA", "RGBA") or "transparency" in image.info else "RGB"


def _exif_orientation(image: Image.Image) -> int:
    """Return the EXIF orientation, 1 to 8; 1 if it is missing or unreadable."""
    if "exif" not in image.info:  # getexif would decode a PNG to look for a chunk behind the pixels
        return 1
    try:
        orientation = image.getexif().get(_EXIF_ORIENTATION, 1)
    except Exception:
        return 1
    return orientation if isinstance(orientation, int) and 1 <= orientation <= 8 else 1


def _decode_image(path: Path, image: Image.Image, mode: str) -> np.ndarray:
    try:
        image.load()
        return np.array(image if image.mode == mode else image.convert(mode))
    except MemoryError:
        raise
    except Exception as error:  # Pillow's decoders raise OSError, SyntaxError, ValueError, struct.error, ...
        expected = f"a complete {image.width}x{image.height} image"
        raise DataError(f"{path}: image data is truncated or corrupt ({error}); expected {expected}") from None


def to_uint8(image: Tensor) -> Tensor:
    """Convert display-referred values 0..1 of any shape to uint8, clamped and rounded; raises DataError for NaN."""
    if image.dtype == torch.uint8:
        return image
    if torch.isnan(image).any():
        raise DataError("image has NaN values, which cannot be written with 8 bits; expected numbers")
    return (image.detach().float().clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def pillow_image(path: Path, image: Tensor) -> Image.Image:
    """Convert (H, W, 3 or 4) sRGB values to an 8-bit Pillow image; raise DataError, naming ``path``, for bad values."""
    if image.ndim != 3 or image.shape[-1] not in (3, 4) or 0 in image.shape:
        raise DataError(f"{path}: image to write has shape {tuple(image.shape)}; expected (H, W, 3) or (H, W, 4)")
    try:
        return Image.fromarray(to_uint8(image).cpu().contiguous().numpy())
    except DataError as error:
        raise DataError(f"{path}: {error}") from None


def write_png(path: Path, image: Tensor) -> None:
    """Write (H, W, 3 or 4) sRGB values, float 0..1 (clamped, rounded) or uint8, straight alpha, as a PNG."""
    picture = pillow_image(path, image)
    with checked_atomic_path(path) as temporary:
        picture.save(temporary, format="PNG")


def write_webp(path: Path, image: Tensor) -> None:
    """Write (H, W, 3 or 4) sRGB values as a still WebP; arguments are as in :func:`write_png`."""
    picture = pillow_image(path, image)
    with checked_atomic_path(path) as temporary:
        picture.save(temporary, format="WEBP", quality=90)


def encode_webp_data_uri(image: Tensor, max_width: int, quality: int = 85) -> str:
    """Encode (H, W, 3) sRGB values 0..1 as a ``data:`` URI of a WebP, scaled down to at most ``max_width`` pixels."""
    picture = Image.fromarray(to_uint8(image).numpy())
    if picture.width > max_width:
        height = max(1, round(picture.height * max_width / picture.width))
        picture = picture.resize((max_width, height), Image.Resampling.LANCZOS)
    file = io.BytesIO()
    picture.save(file, "WEBP", quality=quality)
    return f"data:image/webp;base64,{base64.b64encode(file.getvalue()).decode('ascii')}"


def srgb_to_linear(values: Tensor) -> Tensor:
    """Convert sRGB values (IEC 61966-2-1) to linear light; any shape, differentiable, unclamped, linear below 0."""
    curve = ((values.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(values <= 0.04045, values / 12.92, curve)


def linear_to_srgb(values: Tensor) -> Tensor:
    """Convert linear light to sRGB values (IEC 61966-2-1); any shape, differentiable also at 0, unclamped."""
    curve = 1.055 * values.clamp_min(0.0031308) ** (1.0 / 2.4) - 0.055
    return torch.where(values <= 0.0031308, values * 12.92, curve)


def write_animation(path: Path, frames: Sequence[Tensor], fps: float, quality: int = 80) -> None:
    """Write (H, W, 3 or 4) sRGB frames as a looping animation: WebP, GIF or MP4, by the suffix of ``path``.

    GIF rounds frame times to hundredths of a second. MP4 is H.264, RGB only, with even width and height (an odd last
    row or column is repeated). Raises DataError for invalid frames, suffix or rate, and BackendUnavailable for MP4
    without the package ``av``.
    """
    _check_animation_rate(path, len(frames), fps)
    shapes = sorted({tuple(f.shape) for f in frames})
    if len(shapes) != 1:
        raise DataError(f"{path}: frames have shapes {shapes}; expected the same shape for all")
    if path.suffix.lower() == ".mp4":
        _write_mp4(path, frames, fps)
    else:
        images = [pillow_image(path, f) for f in frames]
        _write_animation_file(path, images[0], images[1:], fps, quality)


class FrameSpool:
    """Collector of frames for an animation. Frames are stored in a temporary file in ``folder``, not in memory."""

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)
        self._pages = TiffImagePlugin.AppendingTiffWriter(self._file, new=True)  # pages can be read one at a time
        self._size: tuple[int, int] | None = None
        self.count = 0

    def add(self, frame: Tensor) -> None:
        """Append a frame of (H, W, 3) sRGB values, float 0..1 or uint8; all frames have the same size."""
        image = pillow_image(Path(f"frame {self.count} of an animation"), frame)
        if image.size != (self._size or image.size):
            raise DataError(f"frame {self.count} of an animation has size {image.size}; expected {self._size}")
        self._size = image.size
        image.save(self._pages, format="TIFF")
        self._pages.newFrame()
        self.count += 1

    def write(self, path: Path, fps: float) -> None:
        """Write all frames as :func:`write_animation` does (WebP or GIF), and delete the temporary file."""
        _check_animation_rate(path, self.count, fps)
        self._pages.finalize()
        self._file.seek(0)
        with Image.open(self._file, formats=["TIFF"]) as frames:
            _write_animation_file(path, frames, (), fps)
        self._file.close()


def _check_animation_rate(path: Path, count: int, fps: float) -> None:
    if not count or not 0.0 < fps < float("inf"):
        expected = "at least one frame and a positive rate"
        raise DataError(f"{path}: {count} frames at {fps} frames per second; expected {expected}")


def _write_animation_file(
    path: Path, first: Image.Image, others: Sequence[Image.Image], fps: float, quality: int = 80
) -> None:
    kind = {".webp": "WEBP", ".gif": "GIF"}.get(path.suffix.lower())
    if kind is None:
        raise DataError(f"{path}: unknown animation format {path.suffix!r}; expected .webp or .gif")
    options: dict[str, Any] = {"quality": quality} if kind == "WEBP" else {"disposal": 2}
    duration = max(1, round(1000.0 / fps)) if kind == "WEBP" else 10 * max(1, round(100.0 / fps))
    with checked_atomic_path(path) as temporary:
        first.save(
            temporary, format=kind, save_all=True, append_images=list(others), duration=duration, loop=0, **options
        )


def _write_mp4(path: Path, frames: Sequence[Tensor], fps: float) -> None:
    try:
        import av
        from av.video.reformatter import Colorspace
    except ImportError as error:
        what = f"MP4 needs the package av ({error}); pip install 'neuprim[video]', or use .webp"
        raise BackendUnavailable(f"{path}: {what}") from error
    height, width = frames[0].shape[:2]
    rows, columns = (list(range(n)) + [n - 1] * (n % 2) for n in (height, width))
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        stream = container.add_stream("h264", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = len(columns), len(rows), "yuv420p"
        stream.options = {"crf": "18"}
        # Without these tags (ITU-T H.273), players guess the matrix from the size of the image.
        tags = stream.codec_context
        tags.colorspace, tags.color_primaries, tags.color_trc, tags.color_range = 1, 1, 13, 1  # BT.709, sRGB, 16 to 235
        for frame in frames:
            pixels = av.VideoFrame.from_ndarray(to_uint8(frame).numpy()[rows][:, columns], format="rgb24")
            picture = pixels.reformat(format="yuv420p", dst_colorspace=Colorspace.ITU709)
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
