"""Measures of images against their truth."""

from neuprim.core.metrics.image import (
    SSIM_SIGMA,
    SSIM_WINDOW,
    from_json,
    matched,
    means,
    psnr,
    psnr_gain,
    ssim,
    ssim_3dgs,
    to_json,
)

__all__ = [
    "SSIM_SIGMA",
    "SSIM_WINDOW",
    "from_json",
    "matched",
    "means",
    "psnr",
    "psnr_gain",
    "ssim",
    "ssim_3dgs",
    "to_json",
]
