"""Autograd operations without their bookkeeping where no gradient is needed."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


class _ForwardKernelContext:
    """Takes what a forward pass saves for a backward pass that will not come."""

    def save_for_backward(self, *tensors: Tensor) -> None:
        pass

    def set_materialize_grads(self, value: bool) -> None:
        pass


def kernel_needs_grad(*arguments: Any) -> bool:
    """Whether somebody asks for a gradient with respect to one of them."""
    return torch.is_grad_enabled() and any(isinstance(x, Tensor) and x.requires_grad for x in arguments)


def apply_kernel_operation(operation: type[torch.autograd.Function], *arguments: Any) -> Any:
    """``operation.apply(*arguments)``, or its forward pass alone where no gradient is asked for."""
    if kernel_needs_grad(*arguments):
        return operation.apply(*arguments)
    return operation.forward(_ForwardKernelContext(), *arguments)
