"""Animations: WebP and GIF by what is installed anyway, MP4 by the extra ``neuprim[video]``."""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

from torch import Tensor

from neuprim.core.errors import BackendUnavailable, DataError
from neuprim.core.io import images
from neuprim.core.io.files import atomic_path

__all__ = ["write_film"]


def write_film(path: Path, frames: Sequence[Tensor], fps: float) -> None:
    """Write (H, W, 3) sRGB frames; the suffix ``.webp``, ``.gif`` or ``.mp4`` picks the format; atomic.

    MP4 is H.264 with 4:2:0 colour, which wants even sizes: an odd last row or column is repeated.

    Raises:
        BackendUnavailable: an MP4 without the package ``av``.
        DataError: as :func:`neuprim.core.io.images.write_animation`.
    """
    if path.suffix.lower() != ".mp4":
        images.write_animation(path, frames, fps)
        return
    try:
        import av
    except ImportError as error:
        raise BackendUnavailable(
            f"{path}: MP4 needs the package av ({error}); pip install 'neuprim[video]', or use .webp"
        ) from error
    if not frames or not 0.0 < fps < float("inf") or len({tuple(f.shape) for f in frames}) != 1:
        raise DataError(
            f"{path}: {len(frames)} frames at {fps} frames per second; expected at least one, all of one shape"
        )
    height, width = frames[0].shape[:2]
    with atomic_path(path) as temporary:
        with av.open(str(temporary), "w", format="mp4") as container:
            stream = container.add_stream("h264", rate=Fraction(fps).limit_denominator(1001))
            stream.width, stream.height, stream.pix_fmt = width + width % 2, height + height % 2, "yuv420p"
            stream.options = {"crf": "18"}
            for frame in frames:
                pixels = images.to_uint8(frame)
                rows, columns = (list(range(n)) + [n - 1] * (n % 2) for n in (height, width))
                picture = av.VideoFrame.from_ndarray(pixels.numpy()[rows][:, columns], format="rgb24")
                container.mux(stream.encode(picture))
            container.mux(stream.encode())
