"""Losses of an image: the photometric one, (1 - lambda) L1 + lambda (1 - SSIM), and three for linear light of high
dynamic range.

Each factory takes the settings that a :class:`~neuprim.core.extensions.LossExtension` or a task's ``loss`` gets. The
losses ignore masks: masked pixels are equal in both images.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.task import Loss, Supervision

_WINDOW = 11
_MAX_CPU_CHANNELS = 51
_MU = 16.0
_DARK = 0.05


def photometric_reference(rendered: Tensor, truth: Tensor, ssim_weight: float) -> tuple[Tensor, dict[str, float]]:
    """The loss by kornia and autograd, on any device and in any dtype; the oracle of the fused versions.

    Args:
        rendered, truth: (H, W, C), values nominally in 0..1.
        ssim_weight: lambda. SSIM uses an 11 x 11 Gaussian window (sigma 1.5) without padding, averaged over windows;
            images smaller than the window use L1 alone.
    """
    l1 = (rendered - truth).abs().mean()
    if ssim_weight == 0 or min(rendered.shape[:2]) < _WINDOW:
        return l1, {"l1": l1.item()}
    with torch.backends.cudnn.flags(enabled=False):  # may round to ten bits, and variances are differences of blurs
        maps = kornia_ssim(rendered.permute(2, 0, 1)[None], truth.permute(2, 0, 1)[None], _WINDOW, padding="valid")
    similarity = maps.mean()
    loss = (1 - ssim_weight) * l1 + ssim_weight * (1 - similarity)
    return loss, {"l1": l1.item(), "ssim": similarity.item()}


class _Photometric(torch.autograd.Function):
    """The same by kernels, which compute the gradient with the value."""

    @staticmethod
    def forward(ctx: Any, rendered: Tensor, truth: Tensor, weight: float, parts: dict[str, float]) -> Tensor:
        if device.on_numba(rendered):
            from neuprim.core.train.ssim_cpu import similarity
        else:
            from neuprim.core.train.ssim_warp import similarity
        means, grad = similarity(rendered.detach(), truth.detach(), weight)
        parts["l1"], parts["ssim"] = means.tolist()
        ctx.save_for_backward(grad)
        return ((1 - weight) * means[0] + weight * (1 - means[1])).float()

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        (grad,) = ctx.saved_tensors
        return grad * g, None, None, None


def photometric(settings: Mapping[str, Any]) -> Loss:
    """Make the loss from ``{"ssim_weight": lambda}``."""
    weight = float(settings["ssim_weight"])

    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        fits = rendered.dtype == truth.dtype == torch.float32 and min(rendered.shape[:2]) >= _WINDOW
        on_cpu = device.on_numba(rendered, truth) and rendered.shape[2] <= _MAX_CPU_CHANNELS
        if weight > 0 and fits and (on_cpu or device.on_warp(rendered, truth)):
            parts: dict[str, float] = {}
            value: Tensor = _Photometric.apply(rendered, truth, weight, parts)
            return value, parts
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
    """Squared error over the squared rendered value, which carries no gradient (Mildenhall et al. 2022, RawNeRF)."""

    def measure(rendered: Tensor, truth: Tensor) -> Tensor:
        return ((rendered - truth) / (rendered.detach().clamp_min(0.0) + _DARK)).square().mean()

    return _named("relative", measure)


def _named(name: str, measure: Callable[[Tensor, Tensor], Tensor]) -> Loss:
    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        value = measure(rendered, truth)
        return value, {name: value.item()}

    return loss
