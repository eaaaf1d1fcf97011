"""A film that is drawn frame by frame: its frames wait in a temporary file, so that memory does not grow with its
length."""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image, TiffImagePlugin
from torch import Tensor

from neuprim.core.errors import DataError
from neuprim.core.io.images import pillow_image, save_animation

__all__ = ["Reel"]


class Reel:
    """Frames of one size, added one after the other, then written as an animation.

    Args:
        folder: of the temporary file, which has no name and is gone afterwards, however this process ends.
    """

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)
        self._pages = TiffImagePlugin.AppendingTiffWriter(
            self._file, new=True
        )  # pages that are read back one at a time
        self._size: tuple[int, int] | None = None
        self.count = 0

    def add(self, frame: Tensor) -> None:
        """(H, W, 3) sRGB values, float 0..1 or uint8."""
        image = pillow_image(Path(f"frame {self.count} of a film"), frame)
        if image.size != (self._size or image.size):
            raise DataError(f"frame {self.count} of a film is {image.size}; expected {self._size}, as the first")
        self._size = image.size
        image.save(self._pages, format="TIFF")
        self._pages.newFrame()
        self.count += 1

    def write(self, path: Path, fps: float) -> None:
        """The same file as :func:`~neuprim.core.io.images.write_animation` of all frames, atomically, and no more after
        it; raises as that."""
        if not self.count:
            raise DataError(
                f"{path}: 0 frames at {fps} frames per second; expected at least one frame and a positive rate"
            )
        self._pages.finalize()
        self._file.seek(0)
        with Image.open(self._file, formats=["TIFF"]) as frames:
            save_animation(path, frames, fps)
        self._file.close()
