"""Custom operations with and without a gradient."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.threads import apply_kernel_operation


class _Cubed(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, factor: float) -> Tensor:  # type: ignore[override]
        ctx.set_materialize_grads(False)
        ctx.save_for_backward(x)
        ctx.factor = factor
        return factor * x**3

    @staticmethod
    def backward(ctx: Any, pulled: Tensor) -> tuple[Any, ...]:  # type: ignore[override]
        (x,) = ctx.saved_tensors
        return 3 * ctx.factor * x.square() * pulled, None


def test_a_gradient_where_one_is_asked_for() -> None:
    x = torch.tensor([1.0, -2.0], requires_grad=True)
    found = apply_kernel_operation(_Cubed, x, 2.0)
    found.sum().backward()
    assert found.tolist() == [2.0, -16.0] and x.grad is not None and x.grad.tolist() == [6.0, 24.0]


def test_else_numbers_alone() -> None:
    x = torch.tensor([1.0, -2.0], requires_grad=True)
    with torch.no_grad():
        silent = apply_kernel_operation(_Cubed, x, 2.0)
    for found in (silent, apply_kernel_operation(_Cubed, x.detach(), 2.0)):
        assert found.tolist() == [2.0, -16.0] and not found.requires_grad and found.grad_fn is None
