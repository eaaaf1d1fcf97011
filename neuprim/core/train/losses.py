"""Losses of an image: the photometric one, (1 - lambda) L1 + lambda (1 - SSIM), and three for linear light of high
dynamic range.

Each factory takes the settings that a :class:`~neuprim.core.extensions.LossExtension` or a task's ``loss`` gets. The
losses ignore masks: masked pixels are equal in both images.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from typing import Any

import torch
from kornia.metrics import ssim as kornia_ssim
from torch import Tensor
from torch.nn.functional import conv2d, pad

from neuprim.core.compute import device
from neuprim.core.task import Loss, Supervision
from neuprim.core.train.ssim_window import SSIM_TAPS, SSIM_WINDOW

__all__ = [
    "compressed",
    "l1",
    "photometric",
    "photometric_reference",
    "photometric_torch",
    "relative",
]

_MU = 16.0
_DARK = 0.05
_C1, _C2 = 0.01**2, 0.03**2


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
    """Make the loss from ``{"ssim_weight": lambda}``. float32 images use an analytic gradient, others kornia's."""
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


# ------------------------------------------------------------ L1 + SSIM in torch


@functools.cache
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(SSIM_WINDOW, dtype=dtype, device=device)


def _blur(maps: Tensor) -> Tensor:
    """Blur (M, H, W) maps to (M, H - 10, W - 10), without cuDNN, which may round to ten bits (TF32): variances are
    differences of blurs."""
    M = len(maps)
    window = _window(maps.dtype, maps.device).expand(M, 1, SSIM_TAPS)
    with torch.backends.cudnn.flags(enabled=False):
        down = conv2d(maps[None], window[..., None], groups=M)
        return conv2d(down, window[:, :, None], groups=M)[0]


def _measure_photometric(rendered: Tensor, truth: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """Means of |x - y| and of SSIM, (2,) float64, and the gradient (H, W, C); by Warp kernels where these run."""
    if device.on_warp(rendered, truth) and rendered.dtype == truth.dtype == torch.float32:
        from neuprim.core.train.ssim_warp import similarity

        return similarity(rendered, truth, weight)
    x, y = rendered.permute(2, 0, 1), truth.permute(2, 0, 1)
    a, b, xx, yy, xy = _blur(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    A, B = 2 * a * b + _C1, 2 * (xy - a * b) + _C2
    iC, iD = 1 / (a * a + b * b + _C1), 1 / (xx - a * a + yy - b * b + _C2)
    S = A * B * iC * iD
    maps = [2 * b * (B - A) * iC * iD - 2 * a * S * (iC - iD), -S * iD, 2 * A * iC * iD]
    from_x, from_xx, from_xy = (_blur(pad(torch.cat(maps), (SSIM_TAPS - 1,) * 4)) / S.numel()).chunk(
        3
    )  # the adjoint: the window is symmetric
    difference = x - y
    grad = (1 - weight) / x.numel() * difference.sign() - weight * (from_x + 2 * x * from_xx + y * from_xy)
    means = torch.stack([difference.abs().mean(dtype=torch.float64), S.mean(dtype=torch.float64)])
    return means, grad.permute(1, 2, 0).contiguous()


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rendered: Tensor, truth: Tensor, weight: float, parts: dict[str, float]) -> Tensor:
        means, grad = _measure_photometric(rendered.detach(), truth.detach(), weight)
        parts["l1"], parts["ssim"] = means.tolist()
        ctx.save_for_backward(grad)
        return ((1 - weight) * means[0] + weight * (1 - means[1])).to(rendered.dtype)

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        (grad,) = ctx.saved_tensors
        return grad * g, None, None, None


def photometric_torch(rendered: Tensor, truth: Tensor, ssim_weight: float) -> tuple[Tensor, dict[str, float]]:
    """Same value and gradient as :func:`~neuprim.core.train.losses.photometric_reference`, of images of at least 11 x
    11 on any device."""
    parts: dict[str, float] = {}
    loss: Tensor = _Photometric.apply(rendered, truth, ssim_weight, parts)
    return loss, parts
