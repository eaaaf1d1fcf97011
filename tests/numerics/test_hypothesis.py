"""Hypothesis looks for primitives and cameras that break a bound; what it and the sweep found is kept by name."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, assume, given, settings
from hypothesis import strategies as st

from tests.backends import FAST
from tests.numerics.extremes.draw import aimed, normalised, primitive
from tests.numerics.extremes.measure import OPEN, Case, compare, gradients, integral_errors
from tests.numerics.extremes.oracle import long_integrals
from tests.numerics.extremes.regions import FORWARD, REGIONS, THIN


@dataclass(frozen=True)
class Draw:
    """One primitive and camera by their proportions; see ``tests/numerics/extremes/draw.py`` for the meaning."""

    seed: int
    distance: float
    ratio: float
    kind: str
    neurons: int
    rate: float
    pixels: float
    off: float
    depth: float
    offset: float


FOUND: dict[str, Draw] = {
    "the camera inside a needle, nearly two thin radii off its centre": Draw(
        seed=0,
        distance=0.01,
        ratio=10.0**2.25,
        kind="needle",
        neurons=0,
        rate=0.0,
        pixels=1.0,
        off=1.0,
        depth=1.0,
        offset=1.0,
    )
}
"""What hypothesis found."""

SWEPT: dict[str, tuple[str, int]] = {
    "the quaternion's norm rounded to float32": ("axis ratio 10000, needle", 5),
    "a slanted needle, whose two offset terms cancel": ("axis ratio 100, needle", 5),
    "a slanted needle from afar": ("needles and discs, far", 15),
    "a disc around the camera": ("needles and discs, inside or near", 20),
    "the camera a few radii from a wide view's rim": ("field of view 160", 21),
    "a rim pixel with D = 4e-6": ("grazing", 1),
}
"""What the sweep found: region and number of the case."""


def powers(low: float, high: float) -> st.SearchStrategy[float]:
    """10^x, uniform in x."""
    return st.floats(math.log10(low), math.log10(high)).map(lambda x: 10.0**x)


DRAWS = st.builds(
    Draw,
    seed=st.integers(0, 2**32 - 1),
    distance=powers(1e-2, 1e5),
    ratio=powers(1.2, 1e4),
    kind=st.sampled_from(["needle", "disc", "any"]),
    neurons=st.integers(0, 16),
    rate=st.one_of(st.just(0.0), powers(1e-12, 1e3)),
    pixels=powers(1e-3, 1e4),
    off=st.one_of(st.just(0.0), powers(1e-1, 1e3)),
    depth=powers(1e-6, 1.0),
    offset=st.floats(-1.0, 1.0),
)


def case(d: Draw) -> Case | None:
    """The case a draw describes; None where the view misses the primitive."""
    rng = np.random.default_rng(d.seed)
    t = primitive(rng, d.ratio, d.kind, d.neurons)
    t["b2"] = torch.full_like(t["b2"], d.offset)
    if d.neurons == 0 and abs(d.offset) < 1e-3:
        return None
    camera = aimed(rng, t, d.distance, d.pixels, None, d.off)
    exact = long_integrals(t, 0, camera, OPEN.near)
    if not bool((exact.hit & (exact.D > 0.01)).any()):
        return None
    return Case(normalised(t, exact, d.rate, d.depth), camera, OPEN).cast("float32")


def check(d: Draw, backend: str = "cpu") -> None:
    found = case(d)
    if found is None:
        assume(False)
        return
    drawn = found.for_backend(backend)
    errors = integral_errors(drawn, backend)
    assert errors.forward <= FORWARD, f"error/S {errors.forward:.2g}, drawn in float64: {errors.wide}"
    assert errors.thin <= THIN, f"thin {errors.thin:.2g}, drawn in float64: {errors.wide}"
    for name, value in gradients(drawn, backend, 0)[0].items():
        assert torch.isfinite(value).all(), name


OTHERS = [name for name in FAST if name != "cpu"]
COMMON = {"derandomize": True, "deadline": None, "database": None, "suppress_health_check": list(HealthCheck)}


@settings(max_examples=60, **COMMON)  # type: ignore[arg-type]
@given(DRAWS)
def test_bounds_hold_wherever_hypothesis_looks(d: Draw) -> None:
    check(d)


@pytest.mark.parametrize("backend", OTHERS)
@settings(max_examples=30, **COMMON)  # type: ignore[arg-type]
@given(d=DRAWS)
def test_bounds_hold_on_other_backends(backend: str, d: Draw) -> None:
    check(d, backend)


@pytest.mark.slow
@settings(max_examples=5000, **COMMON)  # type: ignore[arg-type]
@given(DRAWS)
def test_bounds_hold_wherever_hypothesis_looks_for_long(d: Draw) -> None:
    check(d)


@pytest.mark.parametrize("backend", FAST)
def test_found_cases_stay_mended(backend: str) -> None:
    for name, found in FOUND.items():
        assert case(found) is not None, f"{name}: the case must draw something"
        check(found, backend)


@pytest.mark.parametrize("backend", FAST)
@pytest.mark.parametrize("name", SWEPT)
def test_swept_cases_stay_mended(name: str, backend: str) -> None:
    region_name, number = SWEPT[name]
    region = next(r for r in REGIONS if r.name == region_name)
    errors = compare(region.case(number), backend, "float32", region.whole, gradients=True)
    assert errors.hits > 0
    assert errors.forward <= region.forward and errors.thin <= region.thin and errors.gradient <= region.gradient, (
        errors
    )
