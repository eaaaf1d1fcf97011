"""The photometric loss (1 - lambda) L1 + lambda (1 - SSIM)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor

from neuprim.core.task import Loss

__all__ = ["photometric", "photometric_reference", "scale_anisotropy"]


def photometric_reference(rendered: Tensor, truth: Tensor, ssim_weight: float) -> tuple[Tensor, dict[str, float]]:
    """The loss by kornia and autograd: any device and dtype; the oracle of the fused CPU version.

    Args:
        rendered, truth: (H, W, C), values nominally in 0..1.
        ssim_weight: lambda. SSIM uses an 11 x 11 Gaussian window (sigma 1.5) without padding, averaged over windows;
            images smaller than the window use L1 alone.
    """
    l1 = (rendered - truth).abs().mean()
    if ssim_weight == 0 or min(rendered.shape[:2]) < 11:
        return l1, {"l1": l1.item()}
    maps = kornia_ssim(rendered.permute(2, 0, 1)[None], truth.permute(2, 0, 1)[None], 11, padding="valid")
    similarity = maps.mean()
    loss = (1 - ssim_weight) * l1 + ssim_weight * (1 - similarity)
    return loss, {"l1": l1.item(), "ssim": similarity.item()}


def photometric(settings: Mapping[str, Any]) -> Loss:
    """Loss of a run, from ``{"ssim_weight": lambda}``; fused on float32 CPU tensors, kornia elsewhere."""
    weight = float(settings["ssim_weight"])

    def loss(rendered: Tensor, truth: Tensor) -> tuple[Tensor, dict[str, float]]:
        if (
            rendered.device.type == "cpu"
            and rendered.dtype == torch.float32
            and weight > 0
            and min(rendered.shape[:2]) >= 11
            and rendered.shape[2] <= 51
        ):
            from neuprim.core.train.ssim_cpu import photometric_fused

            return photometric_fused(rendered, truth, weight)
        return photometric_reference(rendered, truth, weight)

    return loss


def scale_anisotropy(log_scales: Tensor) -> Tensor:
    """mean over primitives of std over axes of s / min s (the authors' regulariser); 0 for spheres."""
    ratio = (log_scales - log_scales.min(dim=-1, keepdim=True).values).exp()
    return ratio.std(dim=-1).mean()
