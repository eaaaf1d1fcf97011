"""Write animations as WebP, GIF or (with the extra ``neuprim[video]``) MP4."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

from PIL import Image, TiffImagePlugin
from torch import Tensor

from neuprim.core.errors import BackendUnavailable, DataError
from neuprim.core.io.files import atomic_path, checked_atomic_path
from neuprim.core.io.images import pillow_image, to_uint8


def write_animation(path: Path, frames: Sequence[Tensor], fps: float, quality: int = 80) -> None:
    """Write (H, W, 3 or 4) sRGB frames as an endless animation; the suffix picks the format; atomic.

    GIF rounds frame times to hundredths of a second. MP4 is H.264 with even sizes (an odd last row or column is
    repeated), RGB only. Raises DataError for frames, suffix or rate, and BackendUnavailable for MP4 without the package
    ``av``.
    """
    _check_animation_rate(path, len(frames), fps)
    shapes = sorted({tuple(f.shape) for f in frames})
    if len(shapes) != 1:
        raise DataError(f"{path}: frames have shapes {shapes}; expected one shape")
    if path.suffix.lower() == ".mp4":
        _write_mp4(path, frames, fps)
    else:
        images = [pillow_image(path, f) for f in frames]
        _write_animation_file(path, images[0], images[1:], fps, quality)


class FrameSpool:
    """Collect frames of one size in a nameless temporary file in ``folder``, then write them as an animation."""

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)
        self._pages = TiffImagePlugin.AppendingTiffWriter(self._file, new=True)  # pages can be read one at a time
        self._size: tuple[int, int] | None = None
        self.count = 0

    def add(self, frame: Tensor) -> None:
        """Append (H, W, 3) sRGB values, float 0..1 or uint8."""
        image = pillow_image(Path(f"frame {self.count} of a film"), frame)
        if image.size != (self._size or image.size):
            raise DataError(f"frame {self.count} of a film is {image.size}; expected {self._size}, as the first")
        self._size = image.size
        image.save(self._pages, format="TIFF")
        self._pages.newFrame()
        self.count += 1

    def write(self, path: Path, fps: float) -> None:
        """Write the same file as :func:`write_animation` (WebP or GIF) and close the spool; raises as that."""
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
    except ImportError as error:
        what = f"MP4 needs the package av ({error}); pip install 'neuprim[video]', or use .webp"
        raise BackendUnavailable(f"{path}: {what}") from error
    height, width = frames[0].shape[:2]
    rows, columns = (list(range(n)) + [n - 1] * (n % 2) for n in (height, width))
    with atomic_path(path) as temporary, av.open(str(temporary), "w", format="mp4") as container:
        stream = container.add_stream("h264", rate=Fraction(fps).limit_denominator(1001))
        stream.width, stream.height, stream.pix_fmt = len(columns), len(rows), "yuv420p"
        stream.options = {"crf": "18"}
        for frame in frames:
            picture = av.VideoFrame.from_ndarray(to_uint8(frame).numpy()[rows][:, columns], format="rgb24")
            container.mux(stream.encode(picture))
        container.mux(stream.encode())
