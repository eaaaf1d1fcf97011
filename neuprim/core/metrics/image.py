"""Image quality of one rendered view against its ground truth: PSNR and SSIM.

Float images (H, W, C) are compared as they are: nothing is clipped, quantised or converted. Sums are in float64. JSON
has no infinity, so files state an infinite PSNR as ``{"psnr": null, "psnr_infinite": true}`` (:func:`metric_to_json`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from neuprim.core.errors import DataError, NonFiniteError
from neuprim.core.metrics.image_kernels import SSIM_WINDOW, mean_ssim, sum_squared_errors

_MAX_NAMED = 6  # views in one line; metrics.json names all


def comparable_images(rendered: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return both images as detached float64 (H, W, C) on the CPU.

    Raises DataError for different shapes or values that are not floats, and NonFiniteError for NaN or infinity.
    """
    first, second = _check_images(rendered, truth)
    return first.double(), second.double()


def _check_images(rendered: Tensor, truth: Tensor) -> tuple[Tensor, Tensor]:
    """Return both images as :func:`comparable_images` does, but keep two float32 images in float32."""
    images = {"rendered": rendered, "truth": truth}
    for name, image in images.items():
        if not image.is_floating_point():
            raise DataError(f"{name} image: expected floating-point values, found {image.dtype}")
        if image.ndim != 3 or image.numel() == 0:
            raise DataError(
                f"{name} image: expected shape (H, W, C) with at least one pixel, found {tuple(image.shape)}"
            )
    if rendered.shape != truth.shape:
        raise DataError(
            f"rendered image has shape {tuple(rendered.shape)}, but ground truth has {tuple(truth.shape)}; "
            "expected equal shapes"
        )
    for name, image in images.items():
        if math.isfinite(image.detach().sum().item()):
            continue
        bad = int((~torch.isfinite(image)).sum())  # none where the sum alone overflowed
        if bad:
            raise NonFiniteError(f"{name} image: {bad} of {image.numel()} values are NaN or infinite")
    first, second = (image.detach().cpu() for image in images.values())
    return (first, second) if first.dtype == second.dtype == torch.float32 else (first.double(), second.double())


def psnr(rendered: Tensor, truth: Tensor, mask: Tensor | None = None, peak: float = 1.0) -> float:
    """Return the peak signal-to-noise ratio in dB, ``10 log10(peak^2 / MSE)``; ``math.inf`` for equal images.

    Args:
        mask: (H, W) bool of the pixels that count; None for all.
        peak: largest possible pixel value.
    """
    first, second = _check_images(rendered, truth)
    if not (math.isfinite(peak) and peak > 0):
        raise DataError(f"peak must be a positive number, found {peak}")
    count = first.numel()
    if mask is not None:
        if mask.dtype != torch.bool or mask.shape != first.shape[:2]:
            raise DataError(
                f"mask: expected bool of shape {tuple(first.shape[:2])}, found {mask.dtype} of {tuple(mask.shape)}"
            )
        mask = mask.cpu()
        count = int(mask.sum()) * first.shape[2]
        if count == 0:
            raise DataError("mask excludes all pixels; expected at least one to compare")
    error = sum_squared_errors(first, second, mask) / count
    return math.inf if error == 0.0 else 20.0 * math.log10(peak) - 10.0 * math.log10(error)


def psnr_gain(rendered: Tensor, truth: Tensor, mask: Tensor | None = None, peak: float = 1.0) -> float:
    """Return the :func:`psnr` after each channel of ``rendered`` is scaled by the factor that fits ``truth`` best."""
    first, second = comparable_images(rendered, truth)
    counted = torch.ones(second.shape[:2], dtype=torch.bool) if mask is None else mask.cpu()
    square = first[counted].square().sum(0)
    gain = torch.where(square > 0, (first * second)[counted].sum(0) / square.clamp_min(1e-300), torch.ones_like(square))
    return psnr(first * gain, second, mask, peak)


def ssim(rendered: Tensor, truth: Tensor, peak: float = 1.0) -> float:
    """Return the structural similarity (SSIM), mean over pixels and channels, from -1 to 1 for equal images.

    The window is Gaussian, 11x11, sigma 1.5, K1 = 0.01, K2 = 0.03, and lies inside the image (Wang et al. 2004). For
    smaller images, the window shrinks to the largest odd size. ``peak`` is the data range L. Agrees with kornia in
    float64.
    """
    first, second = _check_images(rendered, truth)
    if not (math.isfinite(peak) and peak > 0):
        raise DataError(f"peak must be a positive number, found {peak}")
    fitting = min(first.shape[0], first.shape[1])
    if fitting >= SSIM_WINDOW:
        return mean_ssim(first, second, float(peak))
    from kornia.metrics import ssim as ssim_map  # slow to import, and only tiny images need it

    first, second = (image.double().permute(2, 0, 1)[None].contiguous() for image in (first, second))
    # kornia's eps would keep equal dark images below 1; the two constants already keep the denominator positive.
    window = fitting - 1 + fitting % 2
    return ssim_map(first, second, window_size=window, max_val=float(peak), eps=0.0, padding="valid").mean().item()


def ssim_3dgs(rendered: Tensor, truth: Tensor) -> float:
    """Return the SSIM as the tools of 3D Gaussian splatting compute it, for comparison with their published tables.

    Values are from 0 to 1. Unlike in :func:`ssim`, a window is centred on every pixel, and pixels outside of an image
    count as black, so the mean is mostly higher. Unlike the tools of 3D Gaussian splatting, this function does not
    quantise images.
    """
    first, second = _check_images(rendered, truth)
    border = (0, 0, *(SSIM_WINDOW // 2,) * 4)
    return mean_ssim(pad(first, border), pad(second, border), 1.0)


def metric_to_json(key: str, value: float) -> dict[str, float | bool | None]:
    """Return the JSON entries for the metric ``key``; infinity becomes ``null`` and ``KEY_infinite: true``."""
    return {key: None, f"{key}_infinite": True} if value == math.inf else {key: value}


def mean_metrics(views: Sequence[Mapping[str, float]]) -> dict[str, Any]:
    """Return JSON-able means over views by the rules of :attr:`TaskSpec.metrics <neuprim.core.task.TaskSpec>`.

    Each element of ``views`` maps metric names to the values of one view.
    """
    result: dict[str, Any] = {}
    for name in sorted({key for v in views for key in v}):
        having = [v for v in views if name in v]
        values, (kind, _, part) = [v[name] for v in having], name.partition("_")
        if kind == "mse":
            error = float(np.average(values, weights=[v.get(f"pixels_{part}", 1.0) for v in having]))
            result |= metric_to_json(f"psnr_pooled_{part}", -10.0 * math.log10(error) if error > 0 else math.inf)
        elif kind == "pixels":
            result[name] = int(sum(values))
        else:
            result |= metric_to_json(name, float(np.mean(values)))
    return result


def metric_from_json(entries: Mapping[str, object], key: str) -> float | None:
    """Return the number that :func:`metric_to_json` stored; None if it is missing, not a number or NaN."""
    if entries.get(f"{key}_infinite") is True:
        return math.inf
    value = entries.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        return None
    return float(value)


def format_metrics(metrics: Mapping[str, Any]) -> str:
    """Return a line that sums up metrics.json, such as ``PSNR 29.99 dB, SSIM 0.977 (20 held-out views)``.

    The PSNR is the mean of the finite values.
    """
    values = [value for entry in metrics["per_view"] if (value := metric_from_json(entry, "psnr")) is not None]
    wrong = [value for value in values if math.isfinite(value)]
    exact = f", {len(values) - len(wrong)} exact" if len(wrong) < len(values) else ""
    mean = sum(wrong) / len(wrong) if wrong else math.inf
    views = f"{len(values)} held-out view{'s' * (len(values) != 1)}"
    return f"PSNR {mean:.2f} dB, SSIM {metrics['ssim']:.3f} ({views}{exact})"


def format_failed_views(metrics: Mapping[str, Any]) -> str:
    """Return a line that names the held-out views in metrics.json that are worse than a black image; "" for none."""
    bad = metrics["worse_than_black_image"]
    if not bad:
        return ""
    more = f" and {len(bad) - _MAX_NAMED} more" if len(bad) > _MAX_NAMED else ""
    count, named = len(metrics["per_view"]), f"{', '.join(bad[:_MAX_NAMED])}{more}"
    return f"{len(bad)} of {count} held-out views are worse than a black image: {named}"
