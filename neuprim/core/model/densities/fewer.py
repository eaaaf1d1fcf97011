"""A cosine density with fewer neurons: those that matter most stay as they are, the others leave their mean behind.

Over an ellipsoid with semi-axes s and orientation R, x~ = R diag(s/m) y with y in the unit ball, a neuron's cosine has

    mean of cos(phi + r.y) = cos(phi) b(|r|),   b(r) = 3 (sin r - r cos r)/r^3,   phi = omega0 b1,   r = omega0
    diag(s/m) R^T W1

and its variance follows from the mean of cos^2 = (1 + cos 2(.))/2. Where phases advance in time, phi + xi a for xi in
0..1, b gets the factor sinc(a/2) and phi the middle of the sequence, phi + a/2. Means are those of a hard edge; a soft
one weighs the middle more.
"""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.model.edge import sinc
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.schema import Params

__all__ = ["ball_mean", "prune_neurons", "smaller_neuron_counts"]


def smaller_neuron_counts(neurons: int) -> tuple[int, ...]:
    """Three quarters, a half and a quarter of so many neurons, and none."""
    return tuple(sorted({neurons * part // 4 for part in range(4)} - {neurons}, reverse=True))


def prune_neurons(params: Params, geometry: Geometry, keep: int, omega0: float) -> dict[str, Tensor]:
    """The tensors with ``keep`` neurons for each primitive, those whose part of the density varies most; others pass
    through.

    Args:
        params: W1 (N, K, 3), b1 (N, K), w2 (N, K), b2 (N, 1), and W_t (N, K) where phases advance in time.
    """
    W1, phase, w2 = params["W1"].double(), omega0 * params["b1"].double(), params["w2"].double()
    semi_axes = (geometry.log_scales.double() - geometry.log_length_scale.double()[:, None]).exp()
    rotations = Geometry(geometry.means.double(), geometry.log_scales.double(), geometry.quats.double()).rotations
    rate = omega0 * ((W1 @ rotations) * semi_axes[:, None, :]).norm(dim=-1)
    advance = omega0 * params["W_t"].double() if "W_t" in params else torch.zeros_like(phase)
    phase = phase + advance / 2
    mean = phase.cos() * ball_mean(rate) * sinc(advance / 2)
    square = (1 + (2 * phase).cos() * ball_mean(2 * rate) * sinc(advance)) / 2
    order = (w2.square() * (square - mean.square())).argsort(dim=1, descending=True, stable=True)
    kept, gone = order[:, :keep].sort(dim=1).values, order[:, keep:]
    fewer = {name: value.gather(1, kept).contiguous() for name, value in params.items() if name in ("b1", "w2", "W_t")}
    fewer["W1"] = params["W1"].gather(1, kept[..., None].expand(-1, -1, 3)).contiguous()
    fewer["b2"] = (params["b2"].double() + (w2 * mean).gather(1, gone).sum(1, keepdim=True)).to(params["b2"])
    return {**params, **fewer}


def ball_mean(r: Tensor) -> Tensor:
    """Mean of cos(r.y) over y in the unit ball, of |r| >= 0."""
    small = r < 1e-2
    safe = torch.where(small, torch.ones_like(r), r)
    return torch.where(small, 1 - r * r / 10, 3 * (safe.sin() - safe * safe.cos()) / safe**3)
