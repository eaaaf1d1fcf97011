"""Which primitives a backend in torch refuses, by name: the kernels check while they prepare, with the same words."""

from __future__ import annotations

import torch

from neuprim.core.errors import NonFiniteError
from neuprim.core.model.primitives import Lowered

__all__ = ["refuse_non_finite"]


def refuse_non_finite(lowered: Lowered) -> None:
    """Raise for the first primitive with a NaN, an infinite number, a zero quaternion or scales beyond the range.

    Raises:
        NonFiniteError: names parameter and primitive.
    """
    g = lowered.geometry
    tensors = {"means": g.means, "log_scales": g.log_scales, "quats": g.quats}
    tensors |= lowered.density.tensors() | lowered.colour.tensors()
    with torch.no_grad():
        for name, value in tensors.items():
            if value.numel() and not bool(torch.isfinite(value).all()):
                row = int((~torch.isfinite(value.reshape(g.count, -1)).all(dim=1)).nonzero()[0])
                raise NonFiniteError(f"{name} of primitive {row} is not finite: {value[row].flatten()[:8].tolist()}")
        zero = (g.quats == 0).all(dim=-1)
        if bool(zero.any()):
            raise NonFiniteError(f"quats of primitive {int(zero.nonzero()[0])} is zero; expected a non-zero quaternion")
        logs = g.log_scales.double()
        top = logs.amax(dim=-1, keepdim=True) if g.count else logs
        beyond = (
            (top.exp() > torch.finfo(torch.float32).max)
            | (top.exp() == 0)
            | ((logs - top).exp() == 0).any(dim=-1, keepdim=True)
        )
        if bool(beyond.any()):
            row = int(beyond[:, 0].nonzero()[0])
            raise NonFiniteError(
                f"log_scales of primitive {row} is {g.log_scales[row].tolist()}: the semi-axes leave the range of float32"
            )
