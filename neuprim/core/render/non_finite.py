"""Refusal of primitives with numbers that are not finite, by name."""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from neuprim.core.errors import NonFiniteError
from neuprim.core.model.primitives import Lowered


def non_finite_error(tensors: Mapping[str, Tensor], row: int) -> NonFiniteError:
    """Return the error for primitive ``row``, which is not finite or leaves the range of float32."""
    for name, value in tensors.items():
        if not bool(torch.isfinite(value[row]).all()):
            return NonFiniteError(f"{name} of primitive {row} is not finite: {value[row].flatten()[:8].tolist()}")
    if not bool(tensors["quats"][row].any()):
        return NonFiniteError(f"quats of primitive {row} is zero; expected a non-zero quaternion")
    scale = tensors["log_scales"][row].tolist()
    return NonFiniteError(
        f"log_scales of primitive {row} is {scale}: the semi-axes or weights leave the range of float32"
    )


def refuse_non_finite(lowered: Lowered) -> None:
    """Raise NonFiniteError for the first primitive with a number, quaternion or scale that cannot be drawn.

    The kernels check the same while they prepare a frame.
    """
    g = lowered.geometry
    if not g.count:
        return
    tensors = {"means": g.means, "log_scales": g.log_scales, "quats": g.quats}
    tensors |= lowered.density.tensors() | lowered.colour.tensors()
    with torch.no_grad():
        logs = g.log_scales.double()
        top = logs.amax(dim=-1)
        bad = (g.quats == 0).all(dim=-1) | (top.exp() > torch.finfo(torch.float32).max) | (top.exp() == 0)
        bad |= ((logs - top[:, None]).exp() == 0).any(dim=-1)
        for value in tensors.values():
            if value.numel():
                bad |= ~torch.isfinite(value.reshape(g.count, -1)).all(dim=1)
        if bool(bad.any()):
            raise non_finite_error(tensors, int(bad.nonzero()[0]))


def refuse_non_finite_colours(tensors: Mapping[str, Tensor], named: Mapping[str, Tensor] | None = None) -> None:
    """Raise NonFiniteError for colours, which the per-primitive kernels do not read; waits for a GPU.

    ``named``: all tensors of the frame; the first of them that is not finite is the cause.
    """
    total = sum(tensor.detach().sum(dtype=torch.float64) for tensor in tensors.values())
    if math.isfinite(total):  # one number, so that a GPU is waited for once
        return
    for value in tensors.values():
        bad = ~torch.isfinite(value).reshape(len(value), -1).all(dim=1)
        if bool(bad.any()):
            raise non_finite_error(tensors if named is None else named, int(bad.nonzero()[0]))
