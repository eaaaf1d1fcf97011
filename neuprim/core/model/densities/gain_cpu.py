"""The gain of a cosine density with its gradient, fused per primitive."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.operation import apply_autograd


@exact_kernel
def scale_backward(w2, b2, factor, p_w2, p_b2, g_w2, g_b2, pulled):  # type: ignore[no-untyped-def]
    """Gradients of (w2, b2), (N, K) and (N, 1), times ``factor`` (N, 1), and of the factor, ``pulled``."""
    for n in range(b2.shape[0]):
        total = np.float64(p_b2[n, 0]) * b2[n, 0]
        g_b2[n, 0] = p_b2[n, 0] * factor[n, 0]
        for k in range(w2.shape[1]):
            total += np.float64(p_w2[n, k]) * w2[n, k]
            g_w2[n, k] = p_w2[n, k] * factor[n, 0]
        pulled[n, 0] = total


class _Gain(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, w2: Tensor, b2: Tensor, log_gain: Tensor, limit: float) -> tuple[Tensor, Tensor]:  # type: ignore[override]
        gain = log_gain.clamp(-limit, limit).exp()
        ctx.save_for_backward(w2, b2, log_gain, gain)
        ctx.limit = limit
        return w2 * gain, b2 * gain

    @staticmethod
    def backward(ctx: Any, p_w2: Tensor, p_b2: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        w2, b2, log_gain, gain = ctx.saved_tensors
        g_w2, g_b2, pulled = (torch.empty(x.shape, dtype=x.dtype) for x in (w2, b2, gain))
        given = (x.detach().contiguous().numpy() for x in (w2, b2, gain, p_w2, p_b2))
        scale_backward(*given, g_w2.numpy(), g_b2.numpy(), pulled.numpy())
        return g_w2, g_b2, (pulled * gain).masked_fill_(log_gain.abs() > ctx.limit, 0.0), None


def fused_gain(w2: Tensor, b2: Tensor, log_gain: Tensor, limit: float) -> tuple[Tensor, Tensor]:
    """(w2, b2), (N, K) and (N, 1), times exp(log_gain), (N, 1), clamped to ``limit``; one dtype."""
    if not device.on_numba(w2, b2, log_gain):
        gain = log_gain.clamp(-limit, limit).exp()
        return w2 * gain, b2 * gain
    result: tuple[Tensor, Tensor] = apply_autograd(_Gain, w2, b2, log_gain, limit)
    return result
