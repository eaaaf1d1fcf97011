"""The gain of a density, fused, against its formula in torch and float64."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from neuprim.core.model.densities.cosine import GAIN_LIMIT, apply_density_gain

pytestmark = pytest.mark.usefixtures("either_way")


def formula(w2: Tensor, b2: Tensor, log_gain: Tensor) -> tuple[Tensor, Tensor]:
    g = log_gain.reshape(-1, 1).clamp(-GAIN_LIMIT, GAIN_LIMIT).exp()
    return w2 * g, b2.reshape(-1, 1) * g


def given(neurons: int, dtype: torch.dtype, flat: bool) -> list[Tensor]:
    g = torch.Generator().manual_seed(neurons)
    w2, b2 = (
        torch.randn(8, neurons, generator=g, dtype=torch.float64),
        torch.randn(8, 1, generator=g, dtype=torch.float64),
    )
    log_gain = torch.tensor([0.0, 1.5, -3.0, GAIN_LIMIT, -GAIN_LIMIT, 25.0, -400.0, 1e-9], dtype=torch.float64)[:, None]
    b2[0] = 0.0
    tensors = [w2, b2.reshape(-1) if flat else b2, log_gain.reshape(-1) if flat else log_gain]
    return [x.to(dtype).requires_grad_() for x in tensors]


@pytest.mark.parametrize("flat", [False, True])
@pytest.mark.parametrize("neurons", [0, 2, 8])
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 2e-6), (torch.float64, 1e-14)])
def test_it_is_the_formula_forward_and_backward(dtype: torch.dtype, tolerance: float, neurons: int, flat: bool) -> None:
    """Beyond the limit a gain has no gradient, at it one."""
    mine, exact = (
        given(neurons, dtype, flat),
        [x.detach().double().requires_grad_() for x in given(neurons, dtype, flat)],
    )
    found, wanted = apply_density_gain(*mine), formula(*exact)
    same = formula(*given(neurons, dtype, flat))
    assert all(torch.equal(a, b) for a, b in zip(found, same, strict=True)), (
        "drawn values do not depend on how gradients are found"
    )
    pull = [torch.randn(x.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64) for x in wanted]
    torch.autograd.backward(list(found), [p.to(dtype) for p in pull])
    torch.autograd.backward(list(wanted), [p.to(dtype).double() for p in pull])
    for a, b in zip(mine, exact, strict=True):
        assert a.grad is not None and b.grad is not None and a.grad.shape == b.grad.shape and a.grad.dtype == dtype
        if b.numel():
            rows = b.grad.reshape(len(b), -1).abs().amax(1).clamp_min(1e-30)  # gains are eighteen decades apart
            assert ((a.grad - b.grad).reshape(len(b), -1).abs().amax(1) <= 8 * tolerance * rows).all()
