"""Ellipsoids: centre, log semi-axes, orientation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from neuprim.core.model.schema import InitContext, ParameterSpec
from neuprim.core.model.tensors import Shaped, Shapes


def quaternion_to_matrix(quats: Tensor) -> Tensor:
    """Rotation matrices (..., 3, 3) of wxyz quaternions (..., 4), normalised on use; NaN of a zero quaternion."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3)


@dataclass(frozen=True)
class Geometry(Shaped):
    """N ellipsoids of hard support (radius 1 in whitened space).

    Attributes:
        means: (N, 3) centres, scene units.
        log_scales: (N, 3) natural logarithm of the semi-axes, scene units.
        quats: (N, 4) wxyz, any non-zero norm.
    """

    shapes: ClassVar[Shapes] = {"means": (("N", 3),), "log_scales": (("N", 3),), "quats": (("N", 4),)}

    means: Tensor
    log_scales: Tensor
    quats: Tensor

    @property
    def count(self) -> int:
        return int(self.means.shape[0])

    @property
    def scales(self) -> Tensor:
        """(N, 3) semi-axes."""
        return self.log_scales.exp()

    @property
    def log_length_scale(self) -> Tensor:
        """(N,) logarithm of m = max semi-axis; a tie sends its gradient to the first axis, in every backend."""
        first = self.log_scales.argmax(dim=-1, keepdim=True)
        return self.log_scales.gather(-1, first)[..., 0]

    @property
    def length_scale(self) -> Tensor:
        """(N,) m, the field's length scale."""
        return self.log_length_scale.exp()

    @property
    def rotations(self) -> Tensor:
        """(N, 3, 3), columns are the ellipsoid's axes in scene coordinates."""
        return quaternion_to_matrix(self.quats)

    def __getitem__(self, rows: Tensor | slice) -> Geometry:
        return Geometry(self.means[rows], self.log_scales[rows], self.quats[rows])


def _semi_axes(ctx: InitContext) -> Tensor:
    return (ctx.scales[:, None].repeat(1, 3) if ctx.axes is None else ctx.axes).float().log()


def _orientation(ctx: InitContext) -> Tensor:
    if ctx.quats is not None:
        return ctx.quats.float()
    q = torch.zeros(ctx.count, 4)
    q[:, 0] = 1.0
    return q


GEOMETRY_SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("means", (3,), 7e-4, lambda c: c.means.float(), lr_unit="extent"),
    ParameterSpec("log_scales", (3,), 2e-2, _semi_axes),
    ParameterSpec("quats", (4,), 1e-2, _orientation),
)
"""Every model starts with these ten numbers per primitive."""
