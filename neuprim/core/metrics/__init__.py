"""Metrics that compare rendered images with ground truth."""

from neuprim.core.metrics.image import (
    comparable_images,
    mean_metrics,
    metric_from_json,
    metric_to_json,
    psnr,
    psnr_gain,
    ssim,
    ssim_3dgs,
)
from neuprim.core.metrics.image_kernels import SSIM_SIGMA, SSIM_WINDOW

__all__ = [
    "SSIM_SIGMA",
    "SSIM_WINDOW",
    "metric_from_json",
    "comparable_images",
    "mean_metrics",
    "psnr",
    "psnr_gain",
    "ssim",
    "ssim_3dgs",
    "metric_to_json",
]
