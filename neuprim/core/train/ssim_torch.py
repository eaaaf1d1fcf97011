"""L1 + SSIM with its analytic gradient in torch code: the twin of :mod:`neuprim.core.train.ssim_cpu`, see there for the
derivation.

The gradient is found with the value, as there, and blurs keep away from cuDNN, which may round to ten bits (TF32):
variances are differences of blurs.
"""

from __future__ import annotations

import functools
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad

from neuprim.core.compute import device
from neuprim.core.train.ssim_window import TAPS, WINDOW

__all__ = ["photometric_torch"]

_C1, _C2 = 0.01**2, 0.03**2


@functools.cache
def _window(dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(WINDOW, dtype=dtype, device=device)


def _blurred(maps: Tensor) -> Tensor:
    """(M, H - 10, W - 10) of (M, H, W)."""
    M = len(maps)
    window = _window(maps.dtype, maps.device).expand(M, 1, TAPS)
    with torch.backends.cudnn.flags(enabled=False):
        down = conv2d(maps[None], window[..., None], groups=M)
        return conv2d(down, window[:, :, None], groups=M)[0]


def _measured(rendered: Tensor, truth: Tensor, weight: float) -> tuple[Tensor, Tensor]:
    """Means of |x - y| and of SSIM, (2,) float64, and the gradient (H, W, C); in a few kernels where there are some."""
    if device.on_warp(rendered, truth) and rendered.dtype == truth.dtype == torch.float32:
        from neuprim.core.train.ssim_warp import similarity

        return similarity(rendered, truth, weight)
    x, y = rendered.permute(2, 0, 1), truth.permute(2, 0, 1)
    a, b, xx, yy, xy = _blurred(torch.cat([x, y, x * x, y * y, x * y])).chunk(5)
    A, B = 2 * a * b + _C1, 2 * (xy - a * b) + _C2
    iC, iD = 1 / (a * a + b * b + _C1), 1 / (xx - a * a + yy - b * b + _C2)
    S = A * B * iC * iD
    maps = [2 * b * (B - A) * iC * iD - 2 * a * S * (iC - iD), -S * iD, 2 * A * iC * iD]
    from_x, from_xx, from_xy = (_blurred(pad(torch.cat(maps), (TAPS - 1,) * 4)) / S.numel()).chunk(
        3
    )  # the adjoint: the window is symmetric
    difference = x - y
    grad = (1 - weight) / x.numel() * difference.sign() - weight * (from_x + 2 * x * from_xx + y * from_xy)
    means = torch.stack([difference.abs().mean(dtype=torch.float64), S.mean(dtype=torch.float64)])
    return means, grad.permute(1, 2, 0).contiguous()


class _Photometric(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, rendered: Tensor, truth: Tensor, weight: float, parts: dict[str, float]) -> Tensor:
        means, grad = _measured(rendered.detach(), truth.detach(), weight)
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
