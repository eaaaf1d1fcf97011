"""Ellipsoids (centres, semi-axes, orientations), and chords: the parts of rays inside ellipsoids."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from neuprim.core.model.schema import InitContext, ParameterSpec
from neuprim.core.model.tensors import PrimitiveTensors, Shapes

__all__ = ["Geometry"]


def quaternion_to_matrix(quats: Tensor) -> Tensor:
    """Return rotation matrices (..., 3, 3) of wxyz quaternions (..., 4) of any norm; NaN for a zero quaternion."""
    w, x, y, z = (quats / quats.norm(dim=-1, keepdim=True)).unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, -1).reshape(*quats.shape[:-1], 3, 3)


@dataclass(frozen=True)
class Geometry(PrimitiveTensors):
    """N ellipsoids: centres, semi-axes and orientations.

    Attributes:
        means: (N, 3) centres, scene units.
        log_scales: (N, 3) natural logarithms of the semi-axes, scene units.
        quats: (N, 4) orientations as quaternions wxyz, of any non-zero norm.
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
        """Semi-axes, (N, 3), scene units."""
        return self.log_scales.exp()

    @property
    def log_length_scale(self) -> Tensor:
        """Natural logarithms of the longest semi-axes, (N,). Of equally long axes, only the first gets the gradient."""
        first = self.log_scales.argmax(dim=-1, keepdim=True)
        return self.log_scales.gather(-1, first)[..., 0]

    @property
    def length_scale(self) -> Tensor:
        """Longest semi-axes m, (N,), scene units. Density and colour of a primitive use m as the unit of length."""
        return self.log_length_scale.exp()

    @property
    def detached_length_scale(self) -> Tensor:
        """Longest semi-axes, (N,), scene units, without gradient; five times as fast as :attr:`length_scale`."""
        return self.log_scales.detach().amax(-1).exp()

    @property
    def rotations(self) -> Tensor:
        """Rotation matrices, (N, 3, 3); the columns are the axes of the ellipsoids in scene coordinates."""
        return quaternion_to_matrix(self.quats)

    def double(self) -> Geometry:
        """Return the ellipsoids in float64."""
        return Geometry(self.means.double(), self.log_scales.double(), self.quats.double())

    def __getitem__(self, rows: Tensor | slice) -> Geometry:
        return Geometry(self.means[rows], self.log_scales[rows], self.quats[rows])


def _initial_log_scales(ctx: InitContext) -> Tensor:
    return (ctx.scales[:, None].repeat(1, 3) if ctx.axes is None else ctx.axes).float().log()


def _initial_quats(ctx: InitContext) -> Tensor:
    if ctx.quats is not None:
        return ctx.quats.float()
    q = torch.zeros(ctx.count, 4)
    q[:, 0] = 1.0
    return q


GEOMETRY_SPECS: tuple[ParameterSpec, ...] = (
    ParameterSpec("means", (3,), 7e-4, lambda c: c.means.float(), lr_unit="extent"),
    ParameterSpec("log_scales", (3,), 2e-2, _initial_log_scales),
    ParameterSpec("quats", (4,), 1e-2, _initial_quats),
)
"""Specifications of the ellipsoids' parameters, ten values per primitive. They come first in every model."""


@dataclass(frozen=True)
class PrimitiveChords:
    """M chords, each the part of one ray inside one primitive's ellipsoid; float64, differentiable.

    The unit of length is m, the longest semi-axis of the primitive, unless stated.

    Attributes:
        prim: (M,) int64 indices of the primitives.
        direction: (M, 3) unit vectors along the rays, scene axes.
        local: (M, 3) middles x of the chords as (x - mu)/m, mu the primitive's centre, scene axes.
        half: (M,) half lengths of the chords, in m.
        origin: (M, 3) or (3,) starts of the rays, scene units.
        near, far, middle: (M,) ends and middles of the chords, as ray distances in m.
        m: (M,) longest semi-axes, scene units.
        whitened: (M, 3) middles of the chords in whitened space, where the ellipsoid is the unit ball.
        pace: (M, 3) change of the whitened position when the ray distance grows by m.
    """

    prim: Tensor
    direction: Tensor
    local: Tensor
    half: Tensor
    origin: Tensor
    near: Tensor
    far: Tensor
    middle: Tensor
    m: Tensor
    whitened: Tensor
    pace: Tensor

    @classmethod
    def of(
        cls, geometry: Geometry, prim: Tensor, origin: Tensor, direction: Tensor, t0: Tensor, t1: Tensor
    ) -> PrimitiveChords:
        """Return the M chords (or parts of chords) between the ray distances ``t0`` and ``t1``, (M,), scene units.

        ``prim`` (M,) are the indices of the primitives in ``geometry``. The rays start at ``origin``, (M, 3) or (3,),
        and have the unit vectors ``direction`` (M, 3).
        """
        m = geometry.length_scale.double()[prim]
        middle = (t0 + t1) / 2
        local = (origin + middle[:, None] * direction - geometry.means.double()[prim]) / m[:, None]
        axes = (geometry.log_scales.double() - geometry.log_length_scale.double()[:, None]).exp()
        whiten = geometry.rotations.double()[prim].transpose(1, 2) / axes[prim][:, :, None]
        whitened, pace = ((whiten @ x[:, :, None])[..., 0] for x in (local, direction))
        return cls(prim, direction, local, (t1 - t0) / (2 * m), origin, t0 / m, t1 / m, middle / m, m, whitened, pace)

    def __len__(self) -> int:
        return len(self.prim)

    @property
    def origins(self) -> Tensor:
        """(M, 3) starts of the rays, scene units."""
        return self.origin.expand_as(self.direction)

    @property
    def ends(self) -> tuple[Tensor, Tensor]:
        """(M,) ray distances t0 and t1 at which the chords start and end, scene units."""
        return self.near * self.m, self.far * self.m

    @property
    def support(self) -> tuple[Tensor, Tensor, Tensor]:
        """Coefficients c0, c1, c2, (M,) each, of 1 - |y|^2 = c0 + c1 u + c2 u^2 along the chords.

        y is the position in whitened space, where the ellipsoid is the unit ball, so |y| = 1 on its boundary. u runs
        from -1 at a chord's start to 1 at the chord's end.
        """
        step = self.half[:, None] * self.pace
        return 1 - self.whitened.square().sum(-1), -2 * (self.whitened * step).sum(-1), -step.square().sum(-1)

    @property
    def points(self) -> Tensor:
        """(M, 3) middles of the chords, scene units."""
        return self.origin + (self.middle * self.m)[:, None] * self.direction
