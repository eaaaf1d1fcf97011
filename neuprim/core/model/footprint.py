"""What a Gaussian of 3D Gaussian splatting becomes: the ellipsoid of constant f, K = 0, whose image is closest to its
own.

At r standard deviations from its middle, the footprint of a Gaussian of opacity o is alpha = o exp(-r^2/2). A primitive
whose support ends c of them from the middle, and whose chord through the middle has optical depth tau, has D = 1 -
r^2/c^2 there and so alpha = 1 - exp(-tau D^(p + 1/2)). tau is chosen such that both hide as much, the same integral of
alpha over the screen; c such that the squares of their difference are least.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

_LOGITS = torch.linspace(-6, 6, 25, dtype=torch.float64)
"""Of the opacities that are tabulated; beyond, the nearest counts."""
_NODES, _FAR = 160, 5.0  # rings of the footprint, and where it ends: standard deviations
_WIDTHS = (1.45, 4.0)  # where c is looked for
_GOLDEN = (5**0.5 - 1) / 2


def gaussian_support(edge: int, alphas: Tensor, volume: bool = False) -> tuple[Tensor, Tensor]:
    """(N,) c and (N,) tau, float64, of primitives for Gaussians of opacity ``alphas`` (N,), 0..1.

    ``volume``: the Gaussians are densities in space, whose optical depth, not alpha, is a bell on the screen.
    """
    table = _table(edge, volume)
    alphas = alphas.double().clamp(1e-9, 1 - 1e-9)
    where = (torch.logit(alphas).clamp(float(_LOGITS[0]), float(_LOGITS[-1])) - _LOGITS[0]) / (_LOGITS[1] - _LOGITS[0])
    row = where.floor().long().clamp(0, len(_LOGITS) - 2)
    part = (where - row)[:, None]
    found = table[row] * (1 - part) + table[row + 1] * part
    return found[:, 0], -torch.log1p(-alphas) * found[:, 1].exp()


@lru_cache
def _table(edge: int, volume: bool) -> Tensor:
    """(O, 2) c and log(tau / -log(1 - o)) for the tabulated opacities, by a golden section of c."""
    r = (torch.arange(_NODES, dtype=torch.float64) + 0.5) / _NODES * _FAR
    opacity = torch.sigmoid(_LOGITS)[:, None]
    bell = (-r * r / 2).exp()
    target = -torch.expm1(torch.log1p(-opacity) * bell) if volume else opacity * bell

    def best(c: Tensor) -> tuple[Tensor, Tensor]:
        """(O,) what is left of the squares, and log tau, for (O,) c."""
        shape = (1 - (r / c[:, None]).square()).clamp_min(0) ** (edge + 0.5)
        low, high = torch.full_like(c, -12.0), torch.full_like(c, 6.0)
        for _ in range(40):
            middle = (low + high) / 2
            less = ((-torch.expm1(-middle.exp()[:, None] * shape) - target) * r).sum(1) < 0
            low, high = torch.where(less, middle, low), torch.where(less, high, middle)
        error = (-torch.expm1(-high.exp()[:, None] * shape) - target).square()
        return (error * r).sum(1), high

    low, high = (torch.full_like(_LOGITS, width) for width in _WIDTHS)
    for _ in range(22):
        left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        lower = best(left)[0] < best(right)[0]
        low, high = torch.where(lower, low, left), torch.where(lower, right, high)
    c = (low + high) / 2
    return torch.stack([c, best(c)[1] - (-torch.log1p(-opacity[:, 0])).log()], 1)
