"""Losses of an image: the photometric one, (1 - lambda) L1 + lambda (1 - SSIM), and three for linear light of high
dynamic range.

Each factory takes the settings that a :class:`~neuprim.core.extensions.LossExtension` or a task's ``loss`` gets. Of
what a step knows beside the images they read nothing: masked pixels are equal in both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.task import Loss, Supervision
from neuprim.core.train.ssim_torch import photometric_torch

__all__ = ["compressed", "l1", "photometric", "photometric_reference", "relative", "scale_anisotropy"]

_MU = 16.0
_DARK = 0.05


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
    """Loss of a run, from ``{"ssim_weight": lambda}``; of float32 tensors with its own gradient, kornia's else."""
    weight = float(settings["ssim_weight"])

    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        if rendered.dtype == torch.float32 and weight > 0 and min(rendered.shape[:2]) >= 11:
            if not device.on_numba(rendered, truth):
                return photometric_torch(rendered, truth, weight)
            if rendered.shape[2] <= 51:
                from neuprim.core.train.ssim_cpu import photometric_fused

                return photometric_fused(rendered, truth, weight)
        return photometric_reference(rendered, truth, weight)

    return loss


def l1(settings: Mapping[str, Any]) -> Loss:
    """Mean absolute difference."""
    return _named("l1", lambda rendered, truth: (rendered - truth).abs().mean())


def compressed(settings: Mapping[str, Any]) -> Loss:
    """L1 of log(1 + mu x) / log(1 + mu), mu = 16: shadows count more, highlights less."""

    def measure(rendered: Tensor, truth: Tensor) -> Tensor:
        scale = torch.log1p(torch.tensor(_MU))
        a, b = (torch.log1p(_MU * x.clamp_min(0.0)) / scale for x in (rendered, truth))
        return (a - b).abs().mean()

    return _named("compressed", measure)


def relative(settings: Mapping[str, Any]) -> Loss:
    """Squared error over the squared rendered value (Mildenhall et al. 2022, RawNeRF), which carries no gradient
    itself."""
    return _named(
        "relative",
        lambda rendered, truth: ((rendered - truth) / (rendered.detach().clamp_min(0.0) + _DARK)).square().mean(),
    )


def _named(name: str, measure: Callable[[Tensor, Tensor], Tensor]) -> Loss:
    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        value = measure(rendered, truth)
        return value, {name: value.item()}

    return loss


def scale_anisotropy(log_scales: Tensor) -> Tensor:
    """mean over primitives of std over axes of s / min s (the authors' regulariser); 0 for spheres."""
    ratio = (log_scales - log_scales.min(dim=-1, keepdim=True).values).exp()
    return ratio.std(dim=-1).mean()
