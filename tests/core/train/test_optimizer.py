"""Adam with a step count per row."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.compute.threads import limit_threads
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.schema import ParameterSpec
from neuprim.core.train.optimizer import RowAdam, adam_step_reference

SPECS = tuple(
    ParameterSpec(n, s, 0.0, lambda c: torch.zeros(0))
    for n, s in (("means", (3,)), ("W1", (4, 3)), ("b2", (1,)), ("none", (0, 3)))
)
RATES = {"means": 1e-2, "W1": 3e-3, "b2": 0.1, "none": 1.0}


def params(count: int = 7, seed: int = 0, dtype: torch.dtype = torch.float32) -> dict[str, Tensor]:
    g = torch.Generator().manual_seed(seed)
    return {
        s.name: torch.randn(count, *s.shape, generator=g, dtype=torch.float64).to(dtype).requires_grad_() for s in SPECS
    }


def set_grads(p: dict[str, Tensor], seed: int) -> None:
    """Gradients of very different sizes, some exactly zero."""
    g = torch.Generator().manual_seed(seed)
    for v in p.values():
        grad = torch.randn(v.shape, generator=g, dtype=torch.float64) * 10.0 ** torch.randint(
            -12, 3, v.shape, generator=g
        )
        v.grad = torch.where(torch.rand(v.shape, generator=g) < 0.2, torch.zeros_like(grad), grad).to(v.dtype)


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("beta2", [0.999, 0.99])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-5), (torch.float64, 1e-12)])
def test_equals_torch_adam(dtype: torch.dtype, tolerance: float, beta2: float) -> None:
    mine, theirs = params(dtype=dtype), params(dtype=dtype)
    optimizer = RowAdam(SPECS, mine, beta2)
    adam = torch.optim.Adam([{"params": [theirs[n]], "lr": RATES[n]} for n in theirs], betas=(0.9, beta2), eps=1e-15)
    for step in range(20):
        set_grads(mine, step)
        set_grads(theirs, step)
        optimizer.step(mine, RATES)
        adam.step()
        for name in mine:
            if mine[name].numel():
                bound = (
                    tolerance * RATES[name] * (step + 1) + 2 * torch.finfo(dtype).eps * (step + 1) ** 0.5
                )  # of the steps, and of the value
                assert (mine[name] - theirs[name]).abs().amax() <= bound, (step, name)
    assert (mine["means"] - params(dtype=dtype)["means"]).abs().max() > 0.05
    assert optimizer.age.tolist() == [20] * 7


@pytest.mark.usefixtures("either_way")
def test_it_equals_the_reference_step() -> None:
    """More rows than one chunk, rows of different ages, decaying rates."""
    p, q = params(9000, 1), params(9000, 1)
    optimizer = RowAdam(SPECS, p)
    ages = torch.arange(9000) % 50
    optimizer.age = ages.clone()
    m, v = ({n: torch.zeros_like(x.detach()).double() for n, x in q.items()} for _ in range(2))
    exact = {n: x.detach().double() for n, x in q.items()}
    peak = {n: torch.zeros_like(x) for n, x in exact.items()}
    for step in range(5):
        set_grads(p, step)
        rates = {n: r * 0.8**step for n, r in RATES.items()}
        optimizer.step(p, rates)
        for n in exact:
            grad = p[n].grad
            assert grad is not None
            peak[n] = torch.maximum(peak[n], grad.double().abs())
            adam_step_reference(exact[n], grad.double(), m[n], v[n], rates[n], ages + step + 1)
    for n in ("means", "W1", "b2"):
        assert (p[n].detach() - exact[n]).abs().max() <= 1e-5 * RATES[n] * 5 + 1e-6
        assert bool(((optimizer.m[n].double() - m[n]).abs() <= 1e-6 * peak[n]).all())
        assert bool(((optimizer.v[n].double() - v[n]).abs() <= 1e-6 * peak[n] ** 2 + 1e-37).all())


@pytest.mark.usefixtures("either_way")
def test_fresh_rows_start_anew_and_the_others_go_on() -> None:
    p = params(5)
    optimizer = RowAdam(SPECS, p)
    for step in range(30):
        set_grads(p, step)
        optimizer.step(p, RATES)
    rows, fresh = torch.tensor([4, 1, 1, 0]), torch.tensor([False, False, True, False])
    old_m = optimizer.m["means"].clone()
    optimizer.select(rows, fresh)
    assert optimizer.age.tolist() == [30, 30, 0, 30]
    assert torch.equal(optimizer.m["means"][[0, 1, 3]], old_m[[4, 1, 0]])
    assert all(bool((t["W1"][2] == 0).all()) for t in (optimizer.m, optimizer.v))

    # row 2 now moves exactly as a row of a new optimiser, row 1 exactly as if nothing had happened
    after = {n: v.detach()[rows].clone().requires_grad_() for n, v in p.items()}
    alone = {n: v.detach()[2:3].clone().requires_grad_() for n, v in after.items()}
    new = RowAdam(SPECS, alone)
    kept = {n: v.detach().clone().requires_grad_() for n, v in p.items()}
    for step in range(3):
        set_grads(after, 100 + step)
        for n in alone:
            grad = after[n].grad
            assert grad is not None
            alone[n].grad = grad[2:3].clone()
        optimizer.step(after, RATES)
        new.step(alone, RATES)
    for n in ("means", "W1", "b2"):
        assert torch.equal(after[n][2:3], alone[n])
        assert not torch.equal(after[n], kept[n][rows])
    assert optimizer.age.tolist() == [33, 33, 3, 33]


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("value", [float("nan"), float("inf")])
@pytest.mark.parametrize("name", ["means", "W1", "b2"])
def test_a_non_finite_gradient_is_named_and_changes_nothing(name: str, value: float) -> None:
    p = params()
    optimizer = RowAdam(SPECS, p)
    set_grads(p, 0)
    optimizer.step(p, RATES)
    before = [x.detach().clone() for x in (*p.values(), *optimizer.state().values())]
    set_grads(p, 1)
    grad = p[name].grad
    assert grad is not None
    grad[3].view(-1)[-1] = value
    with pytest.raises(NonFiniteError, match=rf"gradient of {name} of primitive 3\b"):
        optimizer.step(p, RATES)
    assert all(torch.equal(a, b) for a, b in zip(before, (*p.values(), *optimizer.state().values()), strict=True))


@pytest.mark.usefixtures("either_way")
def test_large_finite_gradients_are_allowed() -> None:
    p = params()
    for v in p.values():
        v.grad = torch.full_like(v, 1e19)
    p["b2"].grad = torch.full_like(
        p["b2"], 3e38
    )  # the sum overflows, no value does; nor is it squared into anything but infinity
    RowAdam(SPECS, p).step(p, RATES)
    assert all(bool(torch.isfinite(v).all()) for v in p.values())


@pytest.mark.usefixtures("either_way")
def test_parameters_without_a_gradient_stay() -> None:
    p = params()
    optimizer = RowAdam(SPECS, p)
    set_grads(p, 0)
    p["W1"].grad = None
    before = p["W1"].detach().clone()
    optimizer.step(p, RATES)
    assert torch.equal(p["W1"], before)
    assert optimizer.m["W1"].abs().max() == 0


@pytest.mark.usefixtures("either_way")
def test_values_stay_above_their_least_and_rise_again() -> None:
    specs = (replace(SPECS[0], low=0.0), *SPECS[1:])
    bound = {name: torch.full_like(v, 0.01).requires_grad_() for name, v in params().items()}
    optimizer = RowAdam(specs, bound)
    for sign in (1.0, -1.0):
        for _ in range(20):
            for v in bound.values():
                v.grad = torch.full_like(v, sign)
            optimizer.step(bound, RATES)
        if sign > 0:
            assert bound["means"].eq(0).all() and bound["b2"].lt(-1).all()
    assert bound["means"].gt(0.02).all()


def test_it_does_not_depend_on_the_number_of_threads() -> None:
    """More rows than one unit of work, of many ages."""
    states = []
    for threads in (1, 2, 5):
        p = params(30_000, 2)
        optimizer = RowAdam(SPECS, p, 0.99)
        optimizer.age = torch.arange(30_000) % 97 // 3
        with limit_threads(threads):
            for step in range(3):
                set_grads(p, step)
                optimizer.step(p, RATES)
        states.append([*(x.detach() for x in p.values()), *optimizer.state().values()])
    assert all(torch.equal(a, b) for state in states[1:] for a, b in zip(states[0], state, strict=True))


@pytest.mark.usefixtures("either_way")
@pytest.mark.parametrize("beta2", [0.0, 0.9, 0.99, 0.99999])
def test_corrections_are_those_of_every_age(beta2: float) -> None:
    """From the first step to ages beyond the budget of any run, rows side by side."""
    ages = torch.tensor([0, 0, 1, 2, 3, 3, 1000, 65_534, 65_535, 65_536, 1_000_000, 7])
    p = params(len(ages), 3)
    exact = {n: v.detach().double() for n, v in p.items()}
    optimizer = RowAdam(SPECS, p, beta2)
    optimizer.age = ages.clone()
    m, v = ({n: torch.zeros_like(x) for n, x in exact.items()} for _ in range(2))
    set_grads(p, 4)
    optimizer.step(p, RATES)
    for n in ("means", "W1", "b2"):
        grad = p[n].grad
        assert grad is not None
        before = exact[n].clone()
        adam_step_reference(exact[n], grad.double(), m[n], v[n], RATES[n], ages + 1, beta2)
        step = (exact[n] - before).abs()
        assert ((p[n].detach() - exact[n]).abs() <= 1e-5 * step + 1e-6 * before.abs() + 1e-30).all()
