"""A part of time taken away: what is left is what the part did in the mean over the sequence.

Means are over xi in 0..1; where primitives live in windows, over their lives, each time counting as much as the window
lets through. A phase that advances by a over the sequence, cos(phi + xi a), is in the mean R cos(phi + psi) with R e^(i
psi) the mean of e^(i xi a). A window leaves its mean behind. A motion leaves the mean place.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import Params

__all__ = ["stilled"]

_TIMES = 128
"""At which means are taken, the middles of as many equal parts of the sequence."""

_MIDDLE = 0.5
"""The time about which primitives without a window move."""


def stilled(params: Params, geometry: Geometry, part: str, omega0: float) -> dict[str, Tensor]:
    """The tensors of a :class:`~neuprim.tasks.dynamic.density.TimeDensity` without what the part did; those of the part
    are still among them.

    With "motion", and with "window" where there is a motion, which is then about the middle of the sequence, "means"
    are there, too.
    """
    return {
        **params,
        **{"phase": _phase, "offset": _offset, "window": _window, "motion": _motion}[part](params, geometry, omega0),
    }


def _times(like: Tensor) -> Tensor:
    return (torch.arange(_TIMES, dtype=torch.float64, device=like.device) + 0.5) / _TIMES


def _let_through(params: Params, xi: Tensor) -> Tensor:
    """(N, 1) factor of the windows at a time."""
    u = (xi - params["window_center"].double()) / params["log_window"].double().exp()
    return (1 - u * u).clamp_min(0.0).square()


def _weights(params: Params) -> list[tuple[Tensor, Tensor]]:
    """(time, (N, 1) weight of it in a mean), weights adding up to 1."""
    times = _times(params["b1"])
    if "window_center" not in params:
        even = torch.full_like(params["b2"].double(), 1.0 / _TIMES)
        return [(xi, even) for xi in times]
    factors = [_let_through(params, xi) for xi in times]
    total = torch.stack(factors).sum(0)
    lives = total > 0
    return [
        (xi, torch.where(lives, f / total.where(lives, torch.ones_like(total)), 1.0 / _TIMES))
        for xi, f in zip(times, factors, strict=True)
    ]


def _phase(params: Params, geometry: Geometry, omega0: float) -> dict[str, Tensor]:
    advance = omega0 * params["W_t"].double()
    real, imaginary = torch.zeros_like(advance), torch.zeros_like(advance)
    for xi, weight in _weights(params):
        real += weight * (xi * advance).cos()
        imaginary += weight * (xi * advance).sin()
    b1 = params["b1"].double() + torch.atan2(imaginary, real) / omega0
    w2 = params["w2"].double() * torch.hypot(real, imaginary)
    return {"b1": b1.to(params["b1"]), "w2": w2.to(params["w2"])}


def _offset(params: Params, geometry: Geometry, omega0: float) -> dict[str, Tensor]:
    cosines, sines = params["offset_cos"].double(), params["offset_sin"].double()
    order = math.pi * torch.arange(1, cosines.shape[1] + 1, dtype=torch.float64, device=cosines.device)
    b2 = params["b2"].double()
    for xi, weight in _weights(params):
        b2 = b2 + weight * (cosines @ (xi * order).cos() + sines @ (xi * order).sin())[:, None]
    return {"b2": b2.to(params["b2"])}


def _window(params: Params, geometry: Geometry, omega0: float) -> dict[str, Tensor]:
    mean = torch.stack([_let_through(params, xi) for xi in _times(params["b1"])]).mean(0)
    faded = {
        name: (params[name].double() * mean).to(params[name])
        for name in ("w2", "b2", "offset_cos", "offset_sin")
        if name in params
    }
    if "velocity" not in params:
        return faded
    later = _MIDDLE - params["window_center"].double()
    velocity, acceleration = params["velocity"].double(), params["acceleration"].double()
    means = geometry.means.double() + (velocity + acceleration * later) * later
    return {
        **faded,
        "means": means.to(geometry.means),
        "velocity": (velocity + 2 * acceleration * later).to(params["velocity"]),
    }


def _motion(params: Params, geometry: Geometry, omega0: float) -> dict[str, Tensor]:
    velocity, acceleration = params["velocity"].double(), params["acceleration"].double()
    center = params["window_center"].double() if "window_center" in params else _MIDDLE
    means = geometry.means.double()
    for xi, weight in _weights(params):
        later = xi - center
        means = means + weight * (velocity + acceleration * later) * later
    return {"means": means.to(geometry.means)}
