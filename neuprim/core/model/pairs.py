"""Where rays meet primitives: what a closed form is asked about."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from neuprim.core.model.geometry import Geometry


@dataclass(frozen=True)
class Pairs:
    """M chords, one for each ray and primitive that meet; float64, differentiable. Lengths are in m, the longest
    semi-axis.

    Attributes:
        prim: (M,) int64 rows of the primitives.
        direction: (M, 3) unit vectors along the rays, scene axes.
        local: (M, 3) middles of the chords, (x - mu)/m, scene axes.
        half: (M,) half lengths of the chords, in m.
        origin: (M, 3) or (3,) starts of the rays, scene units.
        near, far, middle: (M,) ends and middles of the chords, as ray distances in m.
        m: (M,) scene units.
        whitened, pace: (M, 3) middles in whitened space, and what a ray distance of 1 m moves a point there.
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
    def of(cls, geometry: Geometry, prim: Tensor, origin: Tensor, direction: Tensor, t0: Tensor, t1: Tensor) -> Pairs:
        """Chords ``t0`` to ``t1`` (M,) of rays, or parts of them, in scene units."""
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
        """(M,) each: c0, c1, c2 of 1 - |y|^2 = c0 + c1 u + c2 u^2 along the chords, u in [-1, 1]."""
        step = self.half[:, None] * self.pace
        return 1 - self.whitened.square().sum(-1), -2 * (self.whitened * step).sum(-1), -step.square().sum(-1)

    @property
    def points(self) -> Tensor:
        """(M, 3) middles of the chords, scene units."""
        return self.origin + (self.middle * self.m)[:, None] * self.direction
