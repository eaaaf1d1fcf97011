"""The training step's own kernels for a card, on Warp's CPU blocks: Adam, and L1 + SSIM."""

from __future__ import annotations

import math

import pytest
import torch

from neuprim.core.train.losses import photometric_reference
from neuprim.core.train.optimizer import adam_step_reference

pytest.importorskip("warp", reason="the cuda backend's kernels need Warp")

from neuprim.core.train.kernels_warp import adam_rows, ssim_loss_with_gradient

BETAS = (0.9, 0.999)
ROWS = 23


def parameters(generator: torch.Generator) -> list[torch.Tensor]:
    """Of several widths."""
    shapes = [(ROWS, 3), (ROWS, 1), (ROWS, 8, 3), (ROWS,), (ROWS, 2)]
    return [torch.randn(shape, generator=generator) for shape in shapes]


def test_adam_is_the_reference() -> None:
    generator = torch.Generator().manual_seed(0)
    values = parameters(generator)
    expected = [v.double() for v in values]
    moments = [[torch.zeros_like(v) for v in values] for _ in range(2)]
    doubles = [[torch.zeros_like(v) for v in expected] for _ in range(2)]
    age = torch.randint(0, 40_000, (ROWS,), generator=generator)
    age[:6] = 0  # fresh rows beside old ones
    rates = [10 ** -float(torch.rand(1, generator=generator) * 3) for _ in values]
    refused = torch.zeros(1, dtype=torch.int32)
    for _ in range(20):
        grads = [
            torch.randn(v.shape, generator=generator) * 10 ** float(torch.randn(1, generator=generator)) for v in values
        ]
        before = age.clone()
        adam_rows(values, grads, *moments, torch.tensor(rates), age, BETAS, refused)
        assert not refused and torch.equal(age, before + 1)
        for k, grad in enumerate(grads):
            adam_step_reference(expected[k], grad.double(), doubles[0][k], doubles[1][k], rates[k], age)
    for value, double, rate in zip(values, expected, rates, strict=True):
        assert float((value - double).abs().max()) <= 20 * (2e-6 * rate + 1.2e-7 * float(double.abs().max()))


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("which", [0, 2, 4])
def test_adam_changes_nothing_where_a_gradient_is_not_finite(bad: float, which: int) -> None:
    generator = torch.Generator().manual_seed(1)
    values = parameters(generator)
    grads, moments = parameters(generator), [parameters(generator), [m.square() for m in parameters(generator)]]
    grads[which].view(-1)[-1] = bad
    before = [x.clone() for x in (*values, *moments[0], *moments[1])]
    kept = torch.full((ROWS,), 5)
    refused = torch.zeros(1, dtype=torch.int32)
    adam_rows(values, grads, *moments, torch.full((len(values),), 0.1), kept, BETAS, refused)
    assert refused and torch.equal(kept, torch.full((ROWS,), 5))
    assert all(torch.equal(a, b) for a, b in zip(before, (*values, *moments[0], *moments[1]), strict=True))


@pytest.mark.parametrize("shape", [(11, 11, 3), (40, 57, 3), (64, 33, 1), (12, 30, 5)])
def test_similarity_and_its_gradient_are_those_of_float64(shape: tuple[int, int, int]) -> None:
    generator = torch.Generator().manual_seed(2)
    truth = torch.rand(*shape, generator=generator)
    rendered = (0.7 * truth + 0.3 * torch.rand(*shape, generator=generator)).requires_grad_()
    means, grad = ssim_loss_with_gradient(rendered, truth, 0.2)
    exact = rendered.detach().double().requires_grad_()
    loss, parts = photometric_reference(exact, truth.double(), 0.2)
    loss.backward()
    assert exact.grad is not None
    assert means.tolist() == pytest.approx([float(parts["l1"]), float(parts["ssim"])], abs=1e-7)
    assert float((grad - exact.grad).abs().max()) <= 3e-6 * float(exact.grad.abs().max())
