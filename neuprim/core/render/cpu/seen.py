"""How much of an ellipsoid can be seen: rays close to its rim cross too little of it to reach ``alpha_min``, and are
not worth evaluating.

A chord whose point nearest to the centre has |y|^2 = 1 - D crosses (1 - |y|^2)^p with an integral of N_p D^p times half
its length, and half its length is at most s D^(1/2), with s the longest half chord that a ray of the view has. No
cosine exceeds its amplitude, so that an optical depth is at most F N_p s D^(p + 1/2), F = b2 + sum |w2|. Rays below the
depth of ``alpha_min`` count as empty in every backend; they are those that pass outside the same ellipsoid, smaller by
r = (1 - D)^(1/2). What is drawn, and every gradient, stays what it is but for rounding.

s and F are of the frame's own numbers, in float64. The bound is met by a ball of constant density, so that the depth
asked for is a little less than that of ``alpha_min``: what float32 says of a chord is then no question.
"""

from __future__ import annotations

import numpy as np

from neuprim.core.compute.kernels import strict
from neuprim.core.model.edge import EDGES, NORMS

__all__ = ["POWERS", "ROUNDING", "WORTH", "WORTHS", "depth_that_counts", "seen_square", "too_faint"]

ROUNDING = 0.99
"""Share of the depth of ``alpha_min`` that a chord must be able to reach."""

WORTH = 0.01
"""Smaller D than this are not worth a smaller silhouette, and are where float32 knows D least."""

POWERS = (2.0, 2 / 3, 2 / 5)
"""1/(p + 1/2)."""

WORTHS = tuple(WORTH ** (p + 0.5) for p in EDGES)
"""The share of the depth asked for in the largest, below which D is below :data:`WORTH`."""


def depth_that_counts(alpha_min: float) -> float:
    """The optical depth that a chord must be able to reach: that of ``alpha_min``, but for rounding."""
    return -float(np.log1p(-alpha_min)) * ROUNDING


@strict
def too_faint(most, edge, least):  # type: ignore[no-untyped-def]
    """Whether no chord can reach the depth ``least``, however long: no half chord is longer than the longest
    semi-axis."""
    return most <= 0.0 or most * NORMS[edge] <= least


@strict
def seen_square(most, longest, edge, least):  # type: ignore[no-untyped-def]
    """r^2 of the part of an ellipsoid that can be seen, in units of its semi-axes: 1 for all of it, 0 for nothing.

    ``most``: F, positive; ``longest``: s, in units of the longest semi-axis; ``least``: from :func:`depth_that_counts`.
    Rounded to float32, so that two backends whose logarithms differ in the last place agree.
    """
    share = least / (most * NORMS[edge] * longest)
    if share >= 1.0:
        return 0.0
    if share <= WORTHS[edge]:
        return 1.0
    return np.float64(np.float32(1.0 - np.exp(np.log(share) * POWERS[edge])))
