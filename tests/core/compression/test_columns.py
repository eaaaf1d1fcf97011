"""Codes and what they stand for: columns between two ends, orientations, places on a curve."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor

from neuprim.core.compression.quantizers import (
    MAX_BITS,
    ColumnQuantizer,
    RotationQuantizer,
    columns_of_step,
    fit_columns,
    snap_to_zero,
)
from neuprim.core.compression.sections import morton_decode, morton_encode

finite = st.floats(width=32, allow_nan=False, allow_infinity=False)


def columns(bits: int, low: float, high: float) -> ColumnQuantizer:
    return ColumnQuantizer(torch.tensor([bits]), torch.tensor([low]), torch.tensor([high]))


# ---------------------------------------------------------------- columns


@given(finite, finite, st.integers(1, 16), st.integers(0, 2**16 - 1))
def test_a_value_is_the_float32_nearest_to_the_fraction(a: float, b: float, bits: int, code: int) -> None:
    """To within the rounding of double precision, which shows only where two float32 are equally near."""
    low, high = sorted((a, b))
    m = 2**bits - 1
    code = min(code, m)
    made = columns(bits, low, high).values(torch.tensor([[code]]))[0, 0]
    exact = (Fraction(low) * (m - code) + Fraction(high) * code) / m
    assert low <= float(made) <= high
    near = np.float32(float(exact))
    off, least = abs(Fraction(float(made)) - exact), abs(Fraction(float(near)) - exact)
    assert off <= least * (1 + Fraction(1, 2**20)) + Fraction(1, 2**150)


@given(st.lists(finite, min_size=1, max_size=40), st.integers(1, 16))
def test_what_was_decoded_is_decoded_again(values: list[float], bits: int) -> None:
    x = torch.tensor(values)[:, None]
    first = fit_columns(x, [bits])
    once = first.values(first.codes(x))
    second = fit_columns(once, [bits])
    assert torch.equal(second.values(second.codes(once)), once)


@pytest.mark.parametrize("bits", [1, 4, 8, 12, 16])
def test_errors_are_at_most_half_a_step_where_nothing_is_clipped(bits: int) -> None:
    x = torch.randn(500, 3, generator=torch.Generator().manual_seed(0))
    x = x * torch.tensor([1.0, 100.0, 1e-3]) + torch.tensor([0.0, 5.0, 1.0])
    made = fit_columns(x, [bits] * 3, clips=(0.0,))
    assert torch.equal(made.low, x.amin(0)) and torch.equal(made.high, x.amax(0))
    half = (made.high - made.low).double() / (2**bits - 1) / 2
    error = (made.values(made.codes(x)).double() - x.double()).abs().amax(0)
    assert bool((error <= half * 1.001 + 1e-7 * x.abs().amax(0)).all())
    assert bool((error > half * 0.5).all())


@given(st.lists(finite, min_size=1, max_size=30), st.floats(1e-30, 1e30), st.floats(0, 1))
def test_even_steps_reach_every_number_and_pass_through_one_place(
    values: list[float], step: float, place: float
) -> None:
    x = torch.tensor(values)[:, None]
    through = (1 - place) * float(x.min()) + place * float(x.max())
    made = columns_of_step(x, torch.tensor([step]), through)
    assert 1 <= int(made.bits) <= MAX_BITS and -torch.inf < float(made.low) <= float(made.high) < torch.inf
    codes = made.codes(x)
    assert int(codes.max()) <= int(made.last) and int(codes.min()) >= 0
    size, width = float(x.double().abs().max()), float(x.double().max() - x.double().min())
    taken = max(step, width / 2 ** (MAX_BITS - 1))  # of what 20 bits cannot say the step is longer
    off = (made.values(codes).double() - x.double()).abs().max()
    assert float(off) <= 0.5 * taken * (1 + 1e-3) + 5e-7 * size + 1e-40
    near = (made.values(made.codes(torch.tensor([[through]], dtype=torch.float64))).double() - through).abs()
    assert float(near) <= 1e-3 * taken + 5e-7 * size + 1e-40  # ends are float32


def test_gradients_go_straight_through() -> None:
    x = torch.randn(6, 2, requires_grad=True)
    made = fit_columns(x, [3, 3])
    out = made.fake_quantize(x)
    assert torch.equal(out.detach(), made.values(made.codes(x))) and not torch.equal(out.detach(), x.detach())
    (grad,) = torch.autograd.grad((out * torch.arange(12.0).reshape(6, 2)).sum(), x)
    assert torch.equal(grad, torch.arange(12.0).reshape(6, 2))


# ---------------------------------------------------------------- orientations


def angle(a: Tensor, b: Tensor) -> Tensor:
    """Radians between orientations."""
    a, b = a.double(), b.double()
    return 2 * ((a * b).sum(1).abs() / a.norm(dim=1) / b.norm(dim=1)).clamp_max(1).acos()


@pytest.mark.parametrize("bits", [3, 4, 6, 8, 11, 16])
def test_orientations_come_back_within_steps_and_again_as_they_were(bits: int) -> None:
    q = torch.randn(20_000, 4, generator=torch.Generator().manual_seed(bits))
    made = RotationQuantizer(bits)
    codes = made.codes(q)
    assert codes.min() >= 0 and codes[:, 0].max() <= 3 and codes[:, 1:].max() <= 2 * made.half
    once = made.values(codes)
    assert torch.equal(made.codes(once), codes) and torch.equal(made.values(made.codes(once)), once)
    assert float((once.norm(dim=1) - 1).abs().max()) < 1e-6
    assert float(angle(q, once).max()) < 4.0 / made.half


def test_ties_between_components_are_coded_as_they_were() -> None:
    """Where two or more components are equally large, which is the largest must not depend on the last bit."""
    signs = torch.tensor(list(itertools.product((-1.0, 0.0, 1.0), repeat=4)))
    signs = signs[signs.abs().sum(1) > 0]
    noise = 1e-3 * torch.randn(50, *signs.shape, generator=torch.Generator().manual_seed(0))
    q = torch.cat([signs, (signs + noise).reshape(-1, 4)])
    for bits in range(3, 17):
        made = RotationQuantizer(bits)
        once = made.values(made.codes(q))
        assert torch.equal(made.values(made.codes(once)), once)


def test_rounded_orientations_keep_norm_sign_and_gradient() -> None:
    q = (3 * torch.randn(50, 4, generator=torch.Generator().manual_seed(0))).requires_grad_()
    out = RotationQuantizer(5).fake_quantize(q)
    assert torch.allclose(out.norm(dim=1), q.norm(dim=1)) and bool(((out * q).sum(1) > 0).all())
    assert 0 < float(angle(q.detach(), out.detach()).max()) < 0.3
    (grad,) = torch.autograd.grad(out.sum(), q)
    assert torch.equal(grad, torch.ones_like(q))


# ---------------------------------------------------------------- the curve


@pytest.mark.parametrize("bits", [1, 7, 16, 20])
def test_the_curve_and_back(bits: int) -> None:
    cells = np.random.default_rng(0).integers(0, 2**bits, (200, 3))
    assert (morton_decode(morton_encode(cells, bits), bits) == cells).all()
    assert morton_encode(np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0]]), max(bits, 2)).tolist() == [1, 2, 4, 8]


@given(st.integers(0, 2**31 - 1), st.integers(1, 16), st.floats(-6, 6), st.floats(0, 1))
def test_columns_with_a_zero_bring_it_back_and_are_coded_again_as_they_were(
    seed: int, bits: int, size: float, share: float
) -> None:
    generator = torch.Generator().manual_seed(seed)
    x = (torch.randn(60, 4, generator=generator) + torch.randn(4, generator=generator)) * 10.0**size
    x[torch.rand(60, 4, generator=generator) < share] = 0.0
    x[0] = 0.0
    plain = fit_columns(x, [bits] * 4)
    columns = snap_to_zero(plain)
    back = columns.values(columns.codes(x))
    assert bool((back[x == 0] == 0).all())
    low, high = plain.low.double().clamp(max=0), plain.high.double().clamp(min=0)
    off = (back.double() - x.double().clamp(low, high)).abs()
    assert bool((off <= (2.6 / columns.last + 2.0 ** (bits - 22)) * (high - low)).all())
    again = snap_to_zero(fit_columns(back, [bits] * 4))
    assert torch.equal(again.values(again.codes(back)), back)
