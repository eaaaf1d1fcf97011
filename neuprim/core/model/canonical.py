"""One of the many ways to write a density: the one whose numbers lie closest together.

A strength b exp(g) is the sign of b times another gain, so that one number says what two did. Of a sum of cosines,

    sum_k w_k cos(rate (v_k . x + b_k))

does not change when a (v_k, b_k) changes its sign, when rate b_k gains a whole turn, or when it gains half a turn and
w_k changes its sign.
So every w_k may be positive and every b_k between 0 and half a turn, where few bits say more about it.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuprim.core.model.schema import Params

__all__ = ["canonicalize_cosines", "canonicalize_gain"]

_SLACK = 1e-6
"""Of a turn: phases that rounding left beside an end stay there, so that folding what is folded changes no bit."""


def canonicalize_cosines(
    params: Params, inputs: tuple[str, ...], phase: str, weights: str, rate: float
) -> dict[str, Tensor]:
    """The same sums, every weight of the first output positive or zero and every phase between 0 and half a turn,
    pi/rate.

    Args:
        params: name -> (N, ...); those that are not named pass through.
        inputs: names of what cosines multiply with, (N, K) or (N, K, ...).
        phase: name of the b_k, (N, K).
        weights: name of the w_k, (N, K) or (N, outputs, K).
    """
    turn = 2 * math.pi / rate
    b, w = params[phase].detach().double(), params[weights].detach()
    negative = (w if w.dim() == 2 else w[:, 0]) < 0
    b = torch.where(negative, b + turn / 2, b)
    b = torch.where((b / turn).abs() <= 0.5 + _SLACK, b, b - turn * torch.round(b / turn))
    backward = b < 0
    found = {
        **params,
        phase: b.abs().to(params[phase]),
        weights: torch.where(negative if w.dim() == 2 else negative[:, None], -w, w),
    }
    for name in inputs:
        value = params[name].detach()
        found[name] = torch.where(backward.reshape(*backward.shape, *[1] * (value.dim() - 2)), -value, value)
    return found


def canonicalize_gain(params: Params, strength: str, log_gain: str, limit: float) -> dict[str, Tensor]:
    """The same products b exp(g), every b -1, 0 or 1.

    Args:
        params: name -> (N, ...); those that are not named pass through.
        strength, log_gain: names of b and g, (N, 1).
        limit: a g counts as no further from 0; where it would be, and where b is 0, both stay as they are.
    """
    b, g = params[strength].detach(), params[log_gain].detach()
    joined = g.double().clamp(-limit, limit) + b.double().abs().log()
    fits = (b != 0) & (joined.abs() <= limit)
    return {**params, strength: torch.where(fits, b.sign(), b), log_gain: torch.where(fits, joined.to(g), g)}
