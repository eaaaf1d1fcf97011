"""Compiled row operations, forward and backward: some rows of many tensors, and the gain of a density."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from neuprim.core.model.cosine import GAIN_LIMIT, apply_density_gain
from neuprim.core.model.rows import take_primitive_rows

pytestmark = pytest.mark.usefixtures("either_way")

ROWS = {"some": [1, 2, 5, 8], "all": list(range(9)), "none": [], "the first": [0], "the last": [8]}


def tensors(dtype: torch.dtype) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(0)
    shapes: dict[str, tuple[int, ...]] = {"means": (3,), "W1": (2, 3), "b2": (1,), "scalar": (), "nothing": (0, 3)}
    wide = {n: torch.randn(9, *s, generator=g, dtype=torch.float64) for n, s in shapes.items()}
    return {n: x.to(dtype).requires_grad_() for n, x in wide.items()}


def pull(taken: dict[str, Tensor]) -> None:
    g = torch.Generator().manual_seed(1)
    weights = {n: torch.randn(x.shape, generator=g, dtype=torch.float64).to(x) for n, x in taken.items()}
    sum(((weights[n] * x).sum() for n, x in taken.items()), torch.zeros(())).backward()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("case", ROWS)
def test_it_is_index_select(case: str, dtype: torch.dtype) -> None:
    rows, mine, theirs = torch.tensor(ROWS[case], dtype=torch.int64), tensors(dtype), tensors(dtype)
    taken, wanted = take_primitive_rows(mine, rows), {n: x.index_select(0, rows) for n, x in theirs.items()}
    assert list(taken) == list(mine)
    assert all(torch.equal(taken[n], wanted[n]) and taken[n].dtype == dtype for n in wanted)
    pull(taken)
    pull(wanted)
    for name in mine:
        found, expected = mine[name].grad, theirs[name].grad
        assert found is not None and expected is not None and torch.equal(found, expected), name


def test_strides_do_not_matter_and_what_nothing_is_asked_of_has_no_gradient() -> None:
    wide = torch.randn(3, 9, generator=torch.Generator().manual_seed(2))
    turned, unused = wide.t().requires_grad_(), torch.ones(9, 2, requires_grad=True)
    rows = torch.tensor([0, 4])
    taken = take_primitive_rows({"turned": turned, "unused": unused}, rows)
    assert torch.equal(taken["turned"], wide.t()[rows])
    taken["turned"].sum().backward()  # an expanded gradient, of stride 0
    assert turned.grad is not None and turned.grad.sum(1).tolist() == [3, 0, 0, 0, 3, 0, 0, 0, 0]
    assert unused.grad is None


@pytest.mark.parametrize("count", [3, 5000])
def test_without_a_gradient_few_and_many_rows(count: int) -> None:
    g = torch.Generator().manual_seed(3)
    mine = {"means": torch.randn(6000, 3, generator=g), "nothing": torch.zeros(6000, 0, 3)}
    mine["b2"] = torch.randn(6000, generator=g).requires_grad_()
    rows = torch.randperm(6000, generator=g)[:count].sort().values
    with torch.no_grad():
        taken = take_primitive_rows(mine, rows)
    assert all(torch.equal(taken[n], x[rows]) and not taken[n].requires_grad for n, x in mine.items())


def formula(w2: Tensor, b2: Tensor, log_gain: Tensor) -> tuple[Tensor, Tensor]:
    g = log_gain.reshape(-1, 1).clamp(-GAIN_LIMIT, GAIN_LIMIT).exp()
    return w2 * g, b2.reshape(-1, 1) * g


def given(neurons: int, dtype: torch.dtype, flat: bool) -> list[Tensor]:
    g = torch.Generator().manual_seed(neurons)
    w2, b2 = (torch.randn(8, n, generator=g, dtype=torch.float64) for n in (neurons, 1))
    log_gain = torch.tensor([0.0, 1.5, -3.0, GAIN_LIMIT, -GAIN_LIMIT, 25.0, -400.0, 1e-9], dtype=torch.float64)[:, None]
    b2[0] = 0.0
    tensors = [w2, b2.reshape(-1) if flat else b2, log_gain.reshape(-1) if flat else log_gain]
    return [x.to(dtype).requires_grad_() for x in tensors]


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("neurons", [0, 2, 8])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-6), (torch.float64, 1e-14)])
def test_it_is_the_formula_forward_and_backward(dtype: torch.dtype, tolerance: float, neurons: int, flat: bool) -> None:
    """Beyond the limit a gain has no gradient, at it one."""
    mine = given(neurons, dtype, flat)
    exact = [x.detach().double().requires_grad_() for x in mine]
    found, wanted = apply_density_gain(*mine), formula(*exact)
    # drawn values do not depend on how gradients are found
    assert all(torch.equal(a, b) for a, b in zip(found, formula(*mine), strict=True))
    pull = [torch.randn(x.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64) for x in wanted]
    torch.autograd.backward(list(found), [p.to(dtype) for p in pull])
    torch.autograd.backward(list(wanted), [p.to(dtype).double() for p in pull])
    for a, b in zip(mine, exact, strict=True):
        assert a.grad is not None and b.grad is not None and a.grad.shape == b.grad.shape and a.grad.dtype == dtype
        if b.numel():
            rows = b.grad.reshape(len(b), -1).abs().amax(1).clamp_min(1e-30)  # gains are eighteen decades apart
            assert ((a.grad - b.grad).reshape(len(b), -1).abs().amax(1) <= 8 * tolerance * rows).all()
