"""Fluid solver for smoke and fire: staggered grid in a box, semi-Lagrangian advection, combustion, exact projection.

The grid has the marker-and-cell layout (Harlow and Welch 1965): scalars are stored at the centres of cells, velocity
components at the centres of the faces that they cross. Divergence and gradient are differences over one cell. The
divergence of a gradient, the 7-point Laplacian, is therefore a sum of one tridiagonal matrix per axis. Diagonalising
these three small matrices solves the pressure's Poisson equation directly (Lynch, Rice and Thomas 1964, "Direct
solution of partial difference equations by tensor product methods"). The solution needs no iteration and no tolerance,
and allows any combination of solid and open ends.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor
from torch.nn.functional import embedding_bag

Faces = tuple[Tensor, Tensor, Tensor]
"""Velocity in world units per second, float32: components (X+1, Y, Z), (X, Y+1, Z) and (X, Y, Z+1)."""

Job = TypeVar("Job")

_ENDS = ((True, True), (True, True), (False, True))
"""Per axis x, y, z: whether gas can flow through the lower and the upper end of the box. Only the ground is solid."""


@dataclass(frozen=True)
class SmokeBox:
    """Simulation box of X x Y x Z cubic cells over a solid ground; z is up.

    The box is centred at x = y = 0 and stands on z = 0. Air can flow in and out through the sides and the top, because
    the pressure outside is zero. Nothing flows through the ground. ``cell`` is the edge of a cell in world units.
    """

    shape: tuple[int, int, int]
    cell: float

    def axes(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return float32 world coordinates of cell centres, (X, 1, 1), (1, Y, 1) and (1, 1, Z)."""
        x, y, z = (torch.arange(n, dtype=torch.float32) + 0.5 for n in self.shape)
        x, y = x - self.shape[0] / 2, y - self.shape[1] / 2
        return (x * self.cell).reshape(-1, 1, 1), (y * self.cell).reshape(1, -1, 1), (z * self.cell).reshape(1, 1, -1)

    def air_at_rest(self) -> Faces:
        x, y, z = self.shape
        return torch.zeros(x + 1, y, z), torch.zeros(x, y + 1, z), torch.zeros(x, y, z + 1)

    @cached_property
    def _modes(self) -> tuple[tuple[Tensor, ...], Tensor]:
        """Eigenvectors of the second-difference matrix of each axis, and inverse eigenvalues of the box's Laplacian.

        The eigenvectors are the columns of three (n, n) matrices. The inverse eigenvalues are (X, Y, Z).
        """
        vectors, total = [], torch.zeros(self.shape, dtype=torch.float64)
        for axis, (count, (low, high)) in enumerate(zip(self.shape, _ENDS, strict=True)):
            side = torch.ones(count - 1, dtype=torch.float64)
            second = torch.diag(torch.full((count,), -2.0, dtype=torch.float64))
            second += torch.diag(side, 1) + torch.diag(side, -1)
            second[0, 0] += not low  # beyond a solid end the pressure repeats, so that its gradient there is zero
            second[-1, -1] += not high
            values, columns = torch.linalg.eigh(second)
            vectors.append(columns)
            total += values.reshape([-1 if a == axis else 1 for a in range(3)]) / self.cell**2
        return tuple(vectors), 1 / total

    def solve_pressure(self, right: Tensor) -> Tensor:
        """Solve Poisson's equation: return the (X, Y, Z) float64 pressure whose Laplacian is ``right``."""
        (x, y, z), inverse = self._modes
        return _apply_smoke_solver_modes(_apply_smoke_solver_modes(right.double(), x.T, y.T, z.T) * inverse, x, y, z)


def _apply_smoke_solver_modes(field: Tensor, x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    field = torch.matmul(y, torch.matmul(field, z.T))
    return torch.matmul(x, field.reshape(field.shape[0], -1)).reshape(field.shape)


def flow_divergence(velocity: Faces, box: SmokeBox) -> Tensor:
    """Return the (X, Y, Z) float64 divergence, 1/s: the net outflow of each cell per volume."""
    u, v, w = (component.double() for component in velocity)
    return ((u[1:] - u[:-1]) + (v[:, 1:] - v[:, :-1]) + (w[:, :, 1:] - w[:, :, :-1])) / box.cell


def project_velocity(velocity: Faces, box: SmokeBox) -> Faces:
    """Return the divergence-free part u - grad p of the flow u; the pressure p solves laplace p = div u.

    No gas crosses the ground.
    """
    u, v, w = velocity
    w = w.clone()
    w[:, :, 0] = 0
    return _subtract_gradient((u, v, w), box.solve_pressure(flow_divergence((u, v, w), box)), box)


def expansion_flow(source: Tensor, box: SmokeBox) -> Faces:
    """Return the irrotational flow with divergence ``source`` (X, Y, Z), 1/s, e.g. of heated gas that expands.

    The solver adds this flow to the velocity for advection only. The stored velocity remains divergence-free, so that
    the expansion ends as soon as ``source`` is 0.
    """
    return _subtract_gradient(box.air_at_rest(), -box.solve_pressure(source), box)


def _subtract_gradient(velocity: Faces, pressure: Tensor, box: SmokeBox) -> Faces:
    """Return velocity - grad pressure on the cell faces, float32. Faces on the ground keep their velocity."""
    parts = []
    for axis, (component, (low, high)) in enumerate(zip(velocity, _ENDS, strict=True)):
        first, last = pressure.narrow(axis, 0, 1), pressure.narrow(axis, -1, 1)
        slope = torch.cat([first * low, pressure.diff(dim=axis), last * -float(high)], axis) / box.cell
        parts.append((component.double() - slope).float())
    return parts[0], parts[1], parts[2]


def _smoke_solver_flow_at_centres(velocity: Faces) -> Tensor:
    """Return the (3, X, Y, Z) velocity at cell centres: the mean of the values on the two opposite faces."""
    u, v, w = velocity
    return torch.stack([u[1:] + u[:-1], v[:, 1:] + v[:, :-1], w[:, :, 1:] + w[:, :, :-1]]).mul_(0.5)


def _smoke_solver_flow_at_faces(centred: Tensor) -> Faces:
    """Return the velocity on cell faces: the mean of the two adjacent cells of ``centred`` (3, X, Y, Z).

    A face at an end of the box has the value of its only adjacent cell.
    """
    parts = []
    for axis, field in enumerate(centred):
        first, last, count = field.narrow(axis, 0, 1), field.narrow(axis, -1, 1), field.shape[axis] - 1
        between = (field.narrow(axis, 0, count) + field.narrow(axis, 1, count)).mul_(0.5)
        parts.append(torch.cat([first, between, last], axis))
    return parts[0], parts[1], parts[2]


# ---------------------------------------------------------------- the gas


@dataclass(frozen=True)
class GasProperties:
    """Properties of the gas and settings of the solver.

    Attributes:
        buoyancy: upward acceleration at temperature 1.
        weight: downward acceleration at density 1.
        confinement: strength of vorticity confinement; 0 is no confinement, values above 1 give noise.
        cooling, dissipation, drag: relative losses of temperature, density and velocity per second.
        radiation: further loss of temperature per second, proportional to the fourth power of the temperature; the
            value is the loss at temperature 1.
        burn: fuel burnt per second. It does not depend on the concentration, so a flame burns for 1 / burn seconds.
        heat, soot, expansion: temperature, density and volume produced per unit of burnt fuel.
        smoothing: 0..1; each step blends face velocities by this share with the mean of the adjacent cells' velocities.
        cfl: cells that gas may cross in one step; faster gas leads to more steps per frame.
        most_steps: maximum number of steps per frame, even if gas then crosses more than ``cfl`` cells in a step.
    """

    buoyancy: float = 2.0
    weight: float = 0.1
    confinement: float = 0.3
    cooling: float = 0.3
    radiation: float = 0.0
    dissipation: float = 0.1
    drag: float = 0.0
    burn: float = 2.0
    heat: float = 0.0
    soot: float = 0.0
    expansion: float = 0.0
    smoothing: float = 0.1
    cfl: float = 3.0
    most_steps: int = 2


@dataclass(frozen=True)
class GasState:
    """State of the gas ``time`` seconds after the start.

    Attributes:
        velocity: divergence-free velocity, stored on the faces of the cells.
        density, temperature, fuel: (X, Y, Z) float32. Fuel is the reaction coordinate: 1 for fuel that leaves the
            source, 0 for burnt fuel.
        colour: (3, X, Y, Z) albedo times density, so that mixed smoke has a weighted mean albedo; or None.
    """

    velocity: Faces
    density: Tensor
    temperature: Tensor
    fuel: Tensor
    colour: Tensor | None = None
    time: float = 0.0

    @staticmethod
    def clear_air(box: SmokeBox, coloured: bool = False) -> GasState:
        """Return the initial state of a box: clear, cold air at rest."""
        zeros = torch.zeros(box.shape)
        return GasState(box.air_at_rest(), zeros, zeros, zeros, torch.zeros(3, *box.shape) if coloured else None)


class GasSource(NamedTuple):
    """A region of the box in which the gas approaches given values. Quantities that are None do not change.

    Attributes:
        where: slices of the cells of the region.
        rate: (x, y, z) per second; in a time t, the difference between gas and given value is multiplied by
            exp(-rate * t).
        density, temperature, fuel: the given values, as numbers or as fields over the region ``where``.
        colour: albedo of the smoke, three numbers.
        velocity: (3, x, y, z), world units per second.
    """

    where: tuple[slice, slice, slice]
    rate: Tensor
    density: Tensor | float | None = None
    temperature: Tensor | float | None = None
    fuel: Tensor | float | None = None
    colour: tuple[float, float, float] | None = None
    velocity: Tensor | None = None


class GasForcing(NamedTuple):
    """Sources and forces that act on the gas at one time.

    Attributes:
        sources: sources, which are applied in this order.
        gusts: (3, X, Y, Z) acceleration, multiplied by min(1, 2 (density + temperature + fuel)), so that it does not
            move clear, cold air.
        expansion: (X, Y, Z) volume produced per volume and second.
        fade: (X, Y, Z) per second, rate at which smoke, heat and fuel vanish near open ends.
    """

    sources: Sequence[GasSource] = ()
    gusts: Tensor | None = None
    expansion: Tensor | None = None
    fade: Tensor | None = None


def advance_gas(state: GasState, settings: GasProperties, box: SmokeBox, forcing: GasForcing, time: float) -> GasState:
    """Advance the gas by ``time`` seconds in equal steps. Faster gas takes more steps, up to ``most_steps``."""
    fastest = max(float(component.abs().max()) for component in state.velocity)
    count = min(max(math.ceil(fastest * time / box.cell / settings.cfl), 1), settings.most_steps)
    for _ in range(count):
        state = step_gas(state, settings, box, forcing, time / count)
    return state


def step_gas(state: GasState, settings: GasProperties, box: SmokeBox, forcing: GasForcing, time: float) -> GasState:
    """Advance the gas by one step of ``time`` seconds; the resulting velocity is divergence-free up to rounding."""
    before = _smoke_solver_flow_at_centres(state.velocity)
    wind = before
    making = forcing.expansion
    if settings.expansion:
        burnt = state.fuel.clamp_max(settings.burn * time) * (settings.expansion / time)
        making = burnt if making is None else burnt + making
    if making is not None:
        wind = before + _smoke_solver_flow_at_centres(expansion_flow(making, box))
    scalars = torch.stack([state.density, state.temperature, state.fuel])
    fields = [before, scalars] if state.colour is None else [before, scalars, state.colour]
    # The velocity is not sharpened: that collects motion of the finest scale, which shows as streaks along the axes.
    moved = advect_field(torch.cat(fields), wind, time, box.cell, blurred=3)
    after = moved[:3]
    density, temperature, fuel = _burn_fuel(moved[3], moved[4], moved[5], settings, time)
    faded = math.exp(-settings.dissipation * time)
    density = density * faded
    colour = None if state.colour is None else moved[6:9] * faded

    after = after + time * _gas_acceleration(after, density, temperature, settings, box)
    if forcing.gusts is not None:
        after = after + (2 * time * (density + temperature + fuel)).clamp_max(time) * forcing.gusts
    after = after * math.exp(-settings.drag * time)
    state = GasState(state.velocity, density, temperature, fuel, colour, state.time + time)
    for source in forcing.sources:
        state, after = _apply_source(state, after, source, time)
    if forcing.fade is not None:
        keep = torch.exp(-time * forcing.fade)
        density, temperature, fuel = (x * keep for x in (state.density, state.temperature, state.fuel))
        colour = None if state.colour is None else state.colour * keep
        state = replace(state, density=density, temperature=temperature, fuel=fuel, colour=colour)
    # Faces take the *change* at the centres, as the mean of means would blur all motion at every step. The little
    # smoothing removes what the centres cannot see: motion that alternates from face to face.
    u, v, w = (
        old + more + settings.smoothing * (mean - old)
        for old, more, mean in zip(
            state.velocity,
            _smoke_solver_flow_at_faces(after - before),
            _smoke_solver_flow_at_faces(before),
            strict=True,
        )
    )
    return replace(state, velocity=project_velocity((u, v, w), box))


def _burn_fuel(
    density: Tensor, temperature: Tensor, fuel: Tensor, settings: GasProperties, time: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Burn fuel for ``time`` seconds, then cool the gas; return the new fields.

    Fuel burns at a constant rate (Nguyen, Fedkiw and Jensen 2002), so that flames have sharp ends.
    """
    burnt = fuel.clamp_max(settings.burn * time)
    density = density + (2 * settings.soot) * burnt * (1 - fuel).clamp_min(0)  # most of it at the flame's end
    temperature = temperature + settings.heat * burnt
    if settings.radiation:  # dT/dt = -r T^4 in closed form
        temperature = temperature * (1 + 3 * settings.radiation * time * temperature**3) ** (-1 / 3)
    return density, temperature * math.exp(-settings.cooling * time), fuel - burnt


def _gas_acceleration(
    velocity: Tensor, density: Tensor, temperature: Tensor, settings: GasProperties, box: SmokeBox
) -> Tensor:
    """Return the (3, X, Y, Z) acceleration of gas: buoyancy, weight and vorticity confinement e h (N x w).

    Confinement restores the small eddies that interpolation damps (Fedkiw, Stam and Jensen 2001). e is
    ``settings.confinement``, h the edge of a cell, w = curl u the vorticity of the velocity u, and N = grad |w| /
    |grad |w||.
    """
    if settings.confinement:
        w = _vorticity(velocity, box.cell)
        size = (w * w).sum(0).sqrt()
        n = torch.stack([_central_difference(size, axis, box.cell) for axis in range(3)])
        n = n / ((n * n).sum(0).sqrt() + 1e-3 / box.cell)  # no direction where nothing turns
        force = torch.stack([n[1] * w[2] - n[2] * w[1], n[2] * w[0] - n[0] * w[2], n[0] * w[1] - n[1] * w[0]])
        force *= settings.confinement * box.cell
    else:
        force = torch.zeros_like(velocity)
    force[2] += settings.buoyancy * temperature - settings.weight * density
    return force


def _central_difference(field: Tensor, axis: int, cell: float) -> Tensor:
    """Return the central difference of ``field`` along one axis, per world unit; 0 in the first and last cell."""
    result = torch.zeros_like(field)
    count = field.shape[axis] - 2
    result.narrow(axis, 1, count).copy_((field.narrow(axis, 2, count) - field.narrow(axis, 0, count)) * (0.5 / cell))
    return result


def _vorticity(velocity: Tensor, cell: float) -> Tensor:
    pairs = ((2, 1), (0, 2), (1, 0))  # (component, axis); each curl component is the slope of one pair less its mirror
    slopes = ((_central_difference(velocity[a], b, cell), _central_difference(velocity[b], a, cell)) for a, b in pairs)
    return torch.stack([own - mirrored for own, mirrored in slopes])


def _apply_source(state: GasState, velocity: Tensor, source: GasSource, time: float) -> tuple[GasState, Tensor]:
    """Apply a source for ``time`` seconds; return the new gas state and the velocity at cell centres."""
    share = 1 - torch.exp(-source.rate * time)

    def towards(field: Tensor, value: Tensor | float) -> Tensor:
        field = field.clone()
        field[source.where] += share * (value - field[source.where])
        return field

    changed: dict[str, Any] = {}
    for name in ("density", "temperature", "fuel"):
        if (value := getattr(source, name)) is not None:
            changed[name] = towards(getattr(state, name), value)
    if source.density is not None and source.colour is not None and state.colour is not None:
        pairs = zip(state.colour, source.colour, strict=True)
        changed["colour"] = torch.stack([towards(old, albedo * source.density) for old, albedo in pairs])
    if source.velocity is not None:
        velocity = torch.stack([towards(old, new) for old, new in zip(velocity, source.velocity, strict=True)])
    return replace(state, **changed), velocity


# ---------------------------------------------------------------- transport

_SLAB = 1 << 15  # cells worked on at once: their stencils stay in a CPU's cache, which is twice as fast
_INVISIBLE = 1e-4  # values up to this are not corrected; most of a box holds no more


class _SmokeSolverStencil(NamedTuple):
    """Stencils (eight cells and weights each) that interpolate a table of cell values (X * Y * Z, C) at N points.

    Stencils are evaluated with torch's ``embedding_bag``, which is several times faster than ``grid_sample`` in three
    dimensions. The result is the same for any number of threads.
    """

    rows: Tensor  # (N, 8) int32, the cells around each point; the first is the lowest corner
    weights: Tensor  # (N, 8) float32, trilinear

    def read(self, table: Tensor) -> Tensor:
        """Return (N, C) interpolated values of a contiguous table (X * Y * Z, C)."""
        return embedding_bag(self.rows, table, per_sample_weights=self.weights, mode="sum")


def _smoke_solver_stencil(points: list[Tensor], shape: tuple[int, int, int]) -> _SmokeSolverStencil:
    """Return the interpolation stencils of points, given as three (N,) coordinates in units of cells.

    The centre of the first cell is at 0. Points are clamped to the outermost centres.
    """
    lower, parts = [], []
    for along, count in zip(points, shape, strict=True):
        inside = along.clamp(0, count - 1)
        corner = inside.floor().clamp_max_(count - 2)
        parts.append(inside.sub_(corner))
        lower.append(corner)
    # Floats hold these integers exactly below 2^24 cells, and are faster.
    base = lower[0].mul_(shape[1]).add_(lower[1]).mul_(shape[2]).add_(lower[2]).int()
    x, y, z = parts
    weights = torch.empty(len(x), 8)
    both = x * y
    edges = (1 - x - y + both, y - both, x - both, both)  # (0, 0), (0, 1), (1, 0), (1, 1) along x and y
    for pair, edge in enumerate(edges):
        upper = torch.mul(edge, z, out=weights[:, 2 * pair + 1])
        torch.sub(edge, upper, out=weights[:, 2 * pair])
    return _SmokeSolverStencil(
        base[:, None] + torch.tensor(_smoke_solver_stencil_offsets(shape), dtype=torch.int32), weights
    )


def advect_field(fields: Tensor, velocity: Tensor, time: float, cell: float, blurred: int = 0) -> Tensor:
    """Advect (C, X, Y, Z) fields for ``time`` seconds by a velocity (3, X, Y, Z) in world units per second.

    Points are traced back with the midpoint rule. The blur of the interpolation is then corrected (MacCormack; Selle,
    Fedkiw, Kim, Liu and Rossignac 2008, "An unconditionally stable MacCormack method"): advect the fields q forward
    (A), then back (A^-1), and add half of the difference from q,

        q1 = A(q),   q2 = A^-1(q1),   q' = q1 + (q - q2) / 2,

    where q' is limited to the range of the eight cells from which q1 is interpolated, so that no new extremum appears.
    The first ``blurred`` fields are not corrected, nor are cells in which all other fields are negligible.
    """
    shape = (fields.shape[1], fields.shape[2], fields.shape[3])
    table, winds = (x.reshape(len(x), -1).T.contiguous() for x in (fields, velocity))
    sharp = table[:, blurred:].contiguous()
    scale, cells = time / cell, _smoke_solver_cell_indices(shape)
    carried, behind = torch.empty_like(table), torch.empty_like(winds)
    place = torch.empty(len(table), dtype=torch.int32)

    def carry(rows: slice) -> None:
        here = [axis[rows] for axis in cells]
        wind = winds[rows]
        behind[rows] = _smoke_solver_stencil([p - (0.5 * scale) * wind[:, k] for k, p in enumerate(here)], shape).read(
            winds
        )
        back = _smoke_solver_stencil([p - scale * behind[rows, k] for k, p in enumerate(here)], shape)
        carried[rows] = back.read(table)
        place[rows] = back.rows[:, 0]

    _advect_in_threads(carry, [slice(first, min(first + _SLAB, len(table))) for first in range(0, len(table), _SLAB)])
    blurry = carried[:, blurred:].contiguous()

    def correct(at: Tensor) -> None:
        # The wind half a step ahead is not sampled but extrapolated from those here and half a step behind.
        step = scale * (2 * winds.index_select(0, at) - behind.index_select(0, at))
        ahead = [axis.index_select(0, at) + step[:, k] for k, axis in enumerate(cells)]
        gone = sharp.index_select(0, at) - _smoke_solver_stencil(ahead, shape).read(blurry)
        better = blurry.index_select(0, at) + 0.5 * gone
        lowest_corner = place.index_select(0, at)
        low = high = sharp.index_select(0, lowest_corner)
        for offset in _smoke_solver_stencil_offsets(shape)[1:]:
            values = sharp.index_select(0, lowest_corner + offset)
            low, high = torch.minimum(low, values), torch.maximum(high, values)
        carried[at, blurred:] = torch.minimum(torch.maximum(better, low), high)

    _advect_in_threads(correct, (blurry.abs() > _INVISIBLE).any(1).nonzero().squeeze(1).split(_SLAB))
    return carried.T.reshape(fields.shape)


def _advect_in_threads(work: Callable[[Job], None], jobs: Iterable[Job]) -> None:
    """Call ``work`` with each of ``jobs`` in threads other than torch's. Calls must write to different memory.

    Torch's threads wait for each other in a busy loop after every operation. On a busy machine, the waiting takes many
    times longer than the work.
    """
    with ThreadPoolExecutor(min(4, os.cpu_count() or 1)) as pool:
        list(pool.map(work, jobs))


@lru_cache(maxsize=2)
def _smoke_solver_cell_indices(shape: tuple[int, int, int]) -> tuple[Tensor, ...]:
    """Return, for each axis, the cell index of every row of a table: three (X * Y * Z,) float32 tensors."""
    axes = torch.meshgrid(*(torch.arange(n, dtype=torch.float32) for n in shape), indexing="ij")
    return tuple(axis.reshape(-1) for axis in axes)


def _smoke_solver_stencil_offsets(shape: tuple[int, int, int]) -> list[int]:
    """Return the row offsets of a stencil's eight cells from its first cell, in a table (X * Y * Z, C) of cells."""
    return [(a * shape[1] + b) * shape[2] + c for a in (0, 1) for b in (0, 1) for c in (0, 1)]
