"""Measures of relit images: PSNR over the exposure and on the display, per kind of shadow, and the same of simple
baselines.

Images are linear light over the exposure, in which 1 is as bright as a display shows. Everything here is clamped to
0..1 first: without that one highlight of 20 would decide an image's error. "linear_clamped" compares these values,
"display" what they become by the sRGB curve. FLIP is measured where its package is installed (``neuprim[flip]``).
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.errors import DataError
from neuprim.core.io.images import linear_to_srgb
from neuprim.core.metrics import psnr, ssim
from neuprim.core.metrics.flip import flip, flip_available
from neuprim.scenes import PIXEL_CLASSES

__all__ = ["class_errors", "class_shares", "scores"]


def scores(rendered: Tensor, truth: Tensor, structure: bool = True) -> dict[str, float]:
    """``psnr_linear_clamped``, ``psnr_display``, ``ssim_display`` and, where its package is installed, ``flip``.

    Args:
        rendered, truth: (H, W, 3) linear light over the exposure.
        structure: measure the last two as well, which take longest.
    """
    first, second = rendered.clamp(0.0, 1.0), truth.clamp(0.0, 1.0)
    result = {"psnr_linear_clamped": psnr(first, second)}
    first, second = linear_to_srgb(first), linear_to_srgb(second)
    result["psnr_display"] = psnr(first, second)
    if structure:
        result["ssim_display"] = ssim(first, second)
        if flip_available():
            result["flip"] = flip(first, second)
    return result


def class_errors(rendered: Tensor, truth: Tensor, classes: Tensor) -> dict[str, float]:
    """``mse_NAME`` (linear_clamped) and ``pixels_NAME`` of every class that the image has, to be pooled over views.

    Args:
        rendered, truth: (H, W, 3) linear light over the exposure.
        classes: (H, W) uint8, indices of :data:`PIXEL_CLASSES`.

    Raises:
        DataError: the map has another size than the images, or a value that is no class.
    """
    if classes.shape != truth.shape[:2] or int(classes.max()) >= len(PIXEL_CLASSES):
        raise DataError(
            f"pixel classes: found {tuple(classes.shape)} with values up to {int(classes.max())}; "
            f"expected {tuple(truth.shape[:2])} with values below {len(PIXEL_CLASSES)}"
        )
    squares = (rendered.clamp(0.0, 1.0) - truth.clamp(0.0, 1.0)).double().square().mean(-1)
    result: dict[str, float] = {}
    for value, name in enumerate(PIXEL_CLASSES):
        inside = classes == value
        if bool(inside.any()):
            result |= {f"mse_{name}": float(squares[inside].mean()), f"pixels_{name}": float(inside.sum())}
    return result


def class_shares(maps: list[Tensor]) -> dict[str, float]:
    """Share of each class, in percent of the pixels that are not background."""
    counts = torch.stack([torch.bincount(m.reshape(-1).long(), minlength=len(PIXEL_CLASSES)) for m in maps]).sum(0)
    return {
        name: 100.0 * float(counts[i]) / max(float(counts[1:].sum()), 1.0) for i, name in enumerate(PIXEL_CLASSES) if i
    }
