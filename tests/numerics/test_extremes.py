"""The coarse sweep of the named extremes, and the oracle behind it against fifty digits."""

from __future__ import annotations

import numpy as np
import pytest

from neuprim.core.model.edge import EDGES
from tests.backends import SLOW_HERE
from tests.numerics.extremes.measure import integrals
from tests.numerics.extremes.oracle import mp_integral
from tests.numerics.extremes.regions import REGIONS, Region
from tests.numerics.extremes.sweep import measure

COARSE = 3
NETWORKS = [r for r in REGIONS if r.name.startswith("colour network")]
SINGLE = [r for r in REGIONS if not r.whole and r not in NETWORKS]  # those have no densities of their own
EVERY = [
    pytest.param(
        r, edge, marks=[pytest.mark.slow] if edge == 1 and r in NETWORKS else []
    )  # their kernels are those of edge 2 but for a polynomial
    for edge in EDGES
    for r in REGIONS
    if edge in r.edges
]


@pytest.mark.parametrize(("region", "edge"), EVERY, ids=lambda x: getattr(x, "name", f"edge {x}"))
def test_bounds_hold(region: Region, edge: int) -> None:
    # kernels of their own, and nothing else that is new
    left_out = SLOW_HERE if edge == 1 or (edge and region in NETWORKS) else ()
    for result in measure(region, edge, 1 if region.whole or edge else COARSE, left_out):
        assert not result.broken, f"{result.label}: {result.broken}"


@pytest.mark.parametrize("edge", EDGES)
@pytest.mark.parametrize("region", SINGLE, ids=lambda r: r.name)
def test_the_oracle_agrees_with_fifty_digits(region: Region, edge: int) -> None:
    """Another form of the integral, on the three most different pixels of a case: the largest and smallest D and the
    largest I."""
    case = region.case(0, edge)
    exact = integrals(case)
    hit = exact.hit & (exact.D > 1e-12)
    picks = {int(np.argmax(np.where(hit, key, -np.inf))) for key in (exact.D, -exact.D, np.abs(exact.depth))}
    for at in picks:
        y, x = divmod(at, case.camera.width)
        depth, scale = mp_integral(case.tensors, 0, case.camera, case.settings.near, x, y, edge)
        assert scale > 0
        # what longdouble leaves at distance/radius 1e5 x axis ratio 1e4, over the chord's own D
        share = 2e-9 / float(exact.D[y, x])
        assert abs(float(depth - mp_number(exact.depth[y, x]))) <= share * float(scale)
        assert abs(float(scale - mp_number(exact.scale[y, x]))) <= share * float(scale)


def mp_number(value: np.longdouble) -> object:
    import mpmath

    high = float(value)
    return mpmath.mpf(high) + mpmath.mpf(float(value - np.longdouble(high)))
