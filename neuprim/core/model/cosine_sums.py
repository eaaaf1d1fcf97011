"""Sums of cosines, w_k cos(rate (v_k . x + b_k)): a canonical form for quantisation, and pruning of neurons.

**Canonical form.** A sum stays the same when (v_k, b_k) changes sign, when rate b_k gains a whole turn, and when it
gains half a turn and w_k changes sign. So every w_k can be positive and every b_k between 0 and half a turn.

**Pruning.** The neurons whose part of the density varies most stay; the others leave their mean behind. Over an
ellipsoid with semi-axes s and orientation R, x~ = R diag(s/m) y with y in the unit ball, a neuron's cosine has

    mean of cos(phi + r.y) = cos(phi) b(|r|),   b(r) = 3 (sin r - r cos r)/r^3,   phi = omega0 b1,
    r = omega0 diag(s/m) R^T W1

and its variance follows from the mean of cos^2 = (1 + cos 2(.))/2. Where phases advance in time, phi + xi a for xi in
0..1, b gets the factor sinc(a/2) and phi becomes phi + a/2. Means are those of a hard edge.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuprim.core.model.edge import sinc
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import Params

_SLACK = 1e-6  # of a turn: phases that rounding left beside an end stay, so that a second pass changes no bit


def canonicalize_cosines(
    params: Params, inputs: tuple[str, ...], phase: str, weights: str, rate: float
) -> dict[str, Tensor]:
    """Make every weight of the first output at least 0, and every phase between 0 and half a turn, pi/rate.

    Args:
        inputs: names of what cosines multiply with, (N, K) or (N, K, ...).
        phase, weights: names of the b_k, (N, K), and of the w_k, (N, K) or (N, outputs, K).
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
    """Make every b of the products b exp(g) -1, 0 or 1; a g stays where it would be beyond ``limit``."""
    b, g = params[strength].detach(), params[log_gain].detach()
    joined = g.double().clamp(-limit, limit) + b.double().abs().log()
    fits = (b != 0) & (joined.abs() <= limit)
    return {**params, strength: torch.where(fits, b.sign(), b), log_gain: torch.where(fits, joined.to(g), g)}


def smaller_cosine_neuron_counts(neurons: int) -> tuple[int, ...]:
    """Return three quarters, a half and a quarter of a number of neurons, and 0."""
    return tuple(sorted({neurons * part // 4 for part in range(4)} - {neurons}, reverse=True))


def prune_cosine_neurons(params: Params, geometry: Geometry, keep: int, omega0: float) -> dict[str, Tensor]:
    """Keep the ``keep`` neurons of each primitive whose part of the density varies most."""
    W1, phase, w2 = params["W1"].double(), omega0 * params["b1"].double(), params["w2"].double()
    semi_axes = (geometry.log_scales.double() - geometry.log_length_scale.double()[:, None]).exp()
    rotations = Geometry(geometry.means.double(), geometry.log_scales.double(), geometry.quats.double()).rotations
    rate = omega0 * ((W1 @ rotations) * semi_axes[:, None, :]).norm(dim=-1)
    advance = omega0 * params["W_t"].double() if "W_t" in params else torch.zeros_like(phase)
    phase = phase + advance / 2
    mean = phase.cos() * ellipsoid_cosine_mean(rate) * sinc(advance / 2)
    square = (1 + (2 * phase).cos() * ellipsoid_cosine_mean(2 * rate) * sinc(advance)) / 2
    order = (w2.square() * (square - mean.square())).argsort(dim=1, descending=True, stable=True)
    kept, gone = order[:, :keep].sort(dim=1).values, order[:, keep:]
    fewer = {name: value.gather(1, kept).contiguous() for name, value in params.items() if name in ("b1", "w2", "W_t")}
    fewer["W1"] = params["W1"].gather(1, kept[..., None].expand(-1, -1, 3)).contiguous()
    fewer["b2"] = (params["b2"].double() + (w2 * mean).gather(1, gone).sum(1, keepdim=True)).to(params["b2"])
    return {**params, **fewer}


def ellipsoid_cosine_mean(r: Tensor) -> Tensor:
    """Return the mean of cos(r.y) over y in the unit ball, for |r| >= 0."""
    small = r < 1e-2
    safe = torch.where(small, torch.ones_like(r), r)
    return torch.where(small, 1 - r * r / 10, 3 * (safe.sin() - safe * safe.cos()) / safe**3)
