"""The box of a simulation, its staggered grid, and the pressure projection that is exact for it.

Marker-and-cell layout (Harlow and Welch 1965): scalars at the cells' centres, each velocity component at the centres of
the faces that it crosses. Divergence and gradient are differences over one cell, and their product, the 7-point
Laplacian, is a sum of one tridiagonal matrix per axis. Diagonalising these three small matrices solves Poisson's
equation directly (Lynch, Rice and Thomas 1964, "Direct solution of partial difference equations by tensor product
methods"): no iteration, no tolerance, and any mix of solid and open ends, where a cosine transform would need another
variant for each.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

__all__ = ["Box", "Faces", "divergence", "expansion_flow", "project", "to_centres", "to_faces"]

Faces = tuple[Tensor, Tensor, Tensor]
"""Velocity in world units per second: x component (X+1, Y, Z), y component (X, Y+1, Z), z component (X, Y, Z+1);
float32."""


@dataclass(frozen=True)
class Box:
    """X x Y x Z cubic cells over a solid ground; z is up.

    The box is centred at x = y = 0 and stands on z = 0. At an open end the pressure beyond is zero, and air goes in and
    out; through a solid one nothing flows.

    Attributes:
        shape: cells per axis.
        cell: edge of a cell in world units.
        open_sides, open_top: False makes them solid, as the ground always is.
    """

    shape: tuple[int, int, int]
    cell: float
    open_sides: bool = True
    open_top: bool = True

    @property
    def ends(self) -> tuple[tuple[bool, bool], ...]:
        """Whether the lower and the upper end of each axis are open."""
        return (self.open_sides,) * 2, (self.open_sides,) * 2, (False, self.open_top)

    def axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """World coordinates of the cells' centres: (X, 1, 1), (1, Y, 1) and (1, 1, Z), float32; they broadcast against
        fields."""
        x, y, z = (torch.arange(n, dtype=torch.float32) + 0.5 for n in self.shape)
        x, y = x - self.shape[0] / 2, y - self.shape[1] / 2
        return (x * self.cell).reshape(-1, 1, 1), (y * self.cell).reshape(1, -1, 1), (z * self.cell).reshape(1, 1, -1)

    def still(self) -> Faces:
        """Air at rest."""
        x, y, z = self.shape
        return torch.zeros(x + 1, y, z), torch.zeros(x, y + 1, z), torch.zeros(x, y, z + 1)

    @cached_property
    def _modes(self) -> tuple[tuple[Tensor, ...], Tensor]:
        """Eigenvectors (n, n) of each axis' second difference, in columns, and (X, Y, Z) one over the Laplacian's
        eigenvalues."""
        vectors, total = [], torch.zeros(self.shape, dtype=torch.float64)
        for axis, (count, (low, high)) in enumerate(zip(self.shape, self.ends, strict=True)):
            second = torch.diag(torch.full((count,), -2.0, dtype=torch.float64))
            second += torch.diag(torch.ones(count - 1, dtype=torch.float64), 1) + torch.diag(
                torch.ones(count - 1, dtype=torch.float64), -1
            )
            second[0, 0] += not low  # beyond a solid end the pressure repeats, so that its gradient there is zero
            second[-1, -1] += not high
            values, columns = torch.linalg.eigh(second)
            vectors.append(columns)
            total += values.reshape([-1 if a == axis else 1 for a in range(3)]) / self.cell**2
        free = total.abs() < 1e-9 / self.cell**2  # a closed box leaves the pressure's mean free
        return tuple(vectors), torch.where(free, 0.0, 1 / torch.where(free, 1.0, total))

    def solve(self, right: Tensor) -> Tensor:
        """(X, Y, Z) float64: the pressure whose Laplacian is ``right`` (in a closed box: ``right`` less its mean)."""
        (x, y, z), inverse = self._modes
        return _along_axes(_along_axes(right.double(), x.T, y.T, z.T) * inverse, x, y, z)


def _along_axes(field: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """A matrix applied along each axis of a field (X, Y, Z)."""
    field = torch.matmul(y, torch.matmul(field, z.T))
    return torch.matmul(x, field.reshape(field.shape[0], -1)).reshape(field.shape)


def divergence(velocity: Faces, box: Box) -> Tensor:
    """(X, Y, Z) float64, in 1/s: what flows out of each cell per volume."""
    u, v, w = (component.double() for component in velocity)
    return ((u[1:] - u[:-1]) + (v[:, 1:] - v[:, :-1]) + (w[:, :, 1:] - w[:, :, :-1])) / box.cell


def project(velocity: Faces, box: Box) -> Faces:
    """The divergence-free part of a flow: ``u - grad p`` with ``laplace p = div u``, and nothing through solid ends
    (Stam 1999)."""
    velocity = _closed(velocity, box)
    return _less_gradient(velocity, box.solve(divergence(velocity, box)), box)


def expansion_flow(source: Tensor, box: Box) -> Faces:
    """The irrotational flow with divergence ``source`` (X, Y, Z) in 1/s: how gas that is heated pushes the rest away.

    Kept apart from the divergence-free flow: added for transport alone, it does not outlast its cause.
    """
    return _less_gradient(box.still(), -box.solve(source), box)


def to_centres(velocity: Faces) -> Tensor:
    """(3, X, Y, Z) velocity at the cells' centres, the mean of opposite faces."""
    u, v, w = velocity
    return torch.stack([u[1:] + u[:-1], v[:, 1:] + v[:, :-1], w[:, :, 1:] + w[:, :, :-1]]).mul_(0.5)


def to_faces(centred: Tensor) -> Faces:
    """Faces between two cells get the mean of both, those at the ends the cell's own."""
    parts = []
    for axis, field in enumerate(centred):
        first, last = field.narrow(axis, 0, 1), field.narrow(axis, -1, 1)
        count = field.shape[axis] - 1
        parts.append(
            torch.cat([first, (field.narrow(axis, 0, count) + field.narrow(axis, 1, count)).mul_(0.5), last], axis)
        )
    return parts[0], parts[1], parts[2]


def _closed(velocity: Faces, box: Box) -> Faces:
    closed = tuple(component.clone() for component in velocity)
    for axis, (component, (low, high)) in enumerate(zip(closed, box.ends, strict=True)):
        component.narrow(axis, 0, 1).mul_(low)
        component.narrow(axis, -1, 1).mul_(high)
    return closed[0], closed[1], closed[2]


def _less_gradient(velocity: Faces, pressure: Tensor, box: Box) -> Faces:
    """``velocity - grad pressure``, in float32; solid ends keep their values."""
    parts = []
    for axis, (component, (low, high)) in enumerate(zip(velocity, box.ends, strict=True)):
        first, last = pressure.narrow(axis, 0, 1), pressure.narrow(axis, -1, 1)
        slope = torch.cat([first * low, pressure.diff(dim=axis), last * -float(high)], axis) / box.cell
        parts.append((component.double() - slope).float())
    return parts[0], parts[1], parts[2]
