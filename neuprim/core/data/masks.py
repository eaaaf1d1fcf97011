"""Masks that lie beside images, as COLMAP, nerfstudio and instant-ngp find them: what is black in a mask does not
count."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from neuprim.core.notices import warn_once

__all__ = ["Mask", "masks_beside"]


@dataclass(frozen=True)
class Mask:
    """A mask's file.

    Attributes:
        path: image whose zero pixels do not count.
        inverted: all others do not count instead.
    """

    path: Path
    inverted: bool = False


def masks_beside(folder: Path, files: Sequence[Path], images: Path | None = None) -> list[Mask | None]:
    """The mask of every image file, or None; a line says how many there are.

    ``images/a/b.jpg`` has ``masks/a/b.png``, ``masks/a/b.jpg.png`` or ``masks/a/b.jpg``; ``images_4`` has ``masks_4``
    before ``masks``. instant-ngp has ``dynamic_mask_b.png`` beside the image, which is black where pixels count.

    Args:
        folder: the data set's.
        images: the images' own folder; None for the first part of their paths where it begins with "images", else
        ``folder``.
    """
    masks = [_mask(folder, file, images) for file in files]
    found = [m for m in masks if m is not None]
    if found:
        black = "not black" if found[0].inverted else "black"
        warn_once(
            f"{found[0].path.parent}: masks of {len(found)} of {len(files)} images are read; what is {black} there does not count"
        )
    return masks


def _mask(folder: Path, file: Path, images: Path | None) -> Mask | None:
    try:
        if images is None:
            first = file.relative_to(folder).parts[0]
            images = folder / first if first.startswith("images") and first != file.name else folder
        name = file.relative_to(images)
    except ValueError:  # an image outside of the folder
        return None
    places = dict.fromkeys(
        (images.name.replace("images", "masks", 1) if images.name.startswith("images") else "masks", "masks")
    )
    for place in places:
        for candidate in (name.with_suffix(".png"), name.with_name(name.name + ".png"), name):
            if (folder / place / candidate).is_file():
                return Mask(folder / place / candidate)
    dynamic = file.with_name(f"dynamic_mask_{file.stem}.png")
    return Mask(dynamic, inverted=True) if dynamic.is_file() else None
