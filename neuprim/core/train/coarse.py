"""Views at a lower resolution: what a training looks at before details matter."""

from __future__ import annotations

from dataclasses import replace

from neuprim.core.data import Pixels, View
from neuprim.core.data.image_views import average_pixels, reduce_mask

__all__ = ["reduced", "reduction"]

_SMALLEST = 16
"""Pixels along a side that no reduction goes below."""


def reduction(progress: float, coarse: int, until: float) -> int:
    """Whole factor at this used share of the budget: ``coarse`` at first, then half of it, rounded down, and so on,
    each for an equal share, 1 from ``until`` on."""
    if coarse <= 1 or progress >= until:
        return 1
    stages = coarse.bit_length() - 1
    return coarse >> min(int(progress / until * stages), stages)


def reduced(view: View, pixels: Pixels, factor: int) -> tuple[View, Pixels]:
    """The view on pixels ``factor`` times as large, averaged; what is left over at the right and at the bottom is cut
    off.

    Colours are premultiplied, so that the mean is that of what a camera would see. A large pixel counts where all of
    its parts do.
    """
    camera = view.camera
    while factor > 1 and min(camera.width, camera.height) // factor < _SMALLEST:
        factor //= 2
    if factor == 1:
        return view, pixels
    alpha = None if pixels.alpha is None else average_pixels(pixels.alpha[..., None], factor)[..., 0]
    mask = None if pixels.mask is None else reduce_mask(pixels.mask, factor)
    return replace(view, camera=camera.reduced(factor)), Pixels(average_pixels(pixels.rgb, factor), alpha, mask)
