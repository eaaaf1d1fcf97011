"""The box of a simulation, its staggered grid, and the pressure projection that is exact for it.

Marker-and-cell layout (Harlow and Welch 1965): scalars at the cells' centres, each velocity component at the centres of
the faces that it crosses. Divergence and gradient are differences over one cell, and their product, the 7-point
Laplacian, is a sum of one tridiagonal matrix per axis. Diagonalising these three small matrices solves Poisson's
equation directly (Lynch, Rice and Thomas 1964, "Direct solution of partial difference equations by tensor product
methods"): no iteration, no tolerance, and any mix of solid and open ends, where a cosine transform would need another
variant for each.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated

import torch
from torch import Tensor

from neuprim.core.validation import Range, validate_fields
from neuprim.scenes.smoke.advection import advect_field

__all__ = [
    "Box",
    "Faces",
    "Forcing",
    "SolverSettings",
    "Source",
    "GasState",
    "advance_gas",
    "divergence",
    "expansion_flow",
    "project_velocity",
    "step_gas",
    "to_centres",
    "to_faces",
]

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


def project_velocity(velocity: Faces, box: Box) -> Faces:
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


NotNegative = Annotated[float, Range(at_least=0)]


@dataclass(frozen=True)
class SolverSettings:
    """What the gas is like.

    Attributes:
        buoyancy: upward acceleration at temperature 1.
        weight: downward acceleration at density 1.
        confinement: strength of vorticity confinement; 0 is none, above 1 is noise.
        cooling: share of the temperature lost per second.
        radiation: further loss of temperature per second, at temperature 1; it goes with the fourth power.
        dissipation: share of the density lost per second.
        drag: share of the velocity lost per second.
        burn: fuel that burns per second, whatever its concentration; 1 / burn is the life of a flame.
        heat: temperature released per fuel burnt.
        soot: density released per fuel burnt, most of it at the flame's end.
        expansion: volume made per fuel burnt.
        smoothing: share of the face velocities, per step, that is replaced by the means of those at the centres.
        cfl: cells that gas may cross in one step; faster gas makes more steps per frame.
        most_steps: steps per frame at most.
    """

    buoyancy: NotNegative = 2.0
    weight: NotNegative = 0.1
    confinement: NotNegative = 0.3
    cooling: NotNegative = 0.3
    radiation: NotNegative = 0.0
    dissipation: NotNegative = 0.1
    drag: NotNegative = 0.0
    burn: NotNegative = 2.0
    heat: NotNegative = 0.0
    soot: NotNegative = 0.0
    expansion: NotNegative = 0.0
    smoothing: NotNegative = 0.1
    cfl: Annotated[float, Range(above=0)] = 3.0
    most_steps: Annotated[int, Range(at_least=1)] = 2

    def __post_init__(self) -> None:
        validate_fields(self, "solver")


@dataclass(frozen=True)
class GasState:
    """The gas at one time.

    Attributes:
        velocity: at the faces, free of divergence.
        density, temperature, fuel: (X, Y, Z) float32. Fuel is the reaction coordinate: 1 as it leaves the source, 0
        when burnt. colour: (3, X, Y, Z) albedo times density, so that where two smokes mix, each counts by its amount;
        None without colours. time: seconds since the start.
    """

    velocity: Faces
    density: Tensor
    temperature: Tensor
    fuel: Tensor
    colour: Tensor | None = None
    time: float = 0.0

    @staticmethod
    def empty(box: Box, coloured: bool = False) -> GasState:
        """Clear, cold air at rest."""
        nothing = torch.zeros(box.shape)
        return GasState(box.still(), nothing, nothing, nothing, torch.zeros(3, *box.shape) if coloured else None)


@dataclass(frozen=True)
class Source:
    """A place where gas takes given values, as fast as ``rate`` says. What is None is left alone.

    Attributes:
        where: slices of the cells that ``rate`` covers.
        rate: (x, y, z) per second; after a time t the gas has gone 1 - exp(-rate * t) of the way.
        density, temperature, fuel: the values it takes, numbers or fields over ``where``.
        colour: albedo of the smoke, three numbers.
        velocity: three numbers or (3, x, y, z), world units per second.
    """

    where: tuple[slice, slice, slice]
    rate: Tensor
    density: Tensor | float | None = None
    temperature: Tensor | float | None = None
    fuel: Tensor | float | None = None
    colour: tuple[float, float, float] | None = None
    velocity: Tensor | tuple[float, float, float] | None = None


@dataclass(frozen=True)
class Forcing:
    """What a scene does to the gas at one time.

    Attributes:
        sources: applied in order.
        gusts: (3, X, Y, Z) acceleration of what is not clear air, or None; full where density, temperature and fuel add
        up to 1/2. expansion: (X, Y, Z) volume made per volume and second, or None.
        fade: (X, Y, Z) per second: how fast smoke, heat and fuel vanish; above 0 near open ends only. None is nowhere.
    """

    sources: Sequence[Source] = ()
    gusts: Tensor | None = None
    expansion: Tensor | None = None
    fade: Tensor | None = None


def advance_gas(state: GasState, settings: SolverSettings, box: Box, forcing: Forcing, time: float) -> GasState:
    """As many equal steps over ``time`` seconds as the fastest gas needs."""
    fastest = max(float(component.abs().max()) for component in state.velocity)
    count = min(max(math.ceil(fastest * time / box.cell / settings.cfl), 1), settings.most_steps)
    for _ in range(count):
        state = step_gas(state, settings, box, forcing, time / count)
    return state


def step_gas(state: GasState, settings: SolverSettings, box: Box, forcing: Forcing, time: float) -> GasState:
    """The gas ``time`` seconds later; its velocity is free of divergence, to rounding, under
    :func:`projection.divergence`."""
    before = to_centres(state.velocity)
    wind = before
    making = _expansion(state, settings, forcing, time)
    if making is not None:
        wind = before + to_centres(expansion_flow(making, box))
    scalars = torch.stack([state.density, state.temperature, state.fuel])
    fields = [before, scalars] if state.colour is None else [before, scalars, state.colour]
    # The velocity stays blurred: sharp, it gathers motion of the finest scale, which shows as streaks along the axes.
    moved = advect_field(torch.cat(fields), wind, time, box.cell, blurred=3)
    after, (density, temperature, fuel) = moved[:3], moved[3:6]
    colour = None if state.colour is None else moved[6:9]

    density, temperature, fuel = _react(density, temperature, fuel, settings, time)
    faded = math.exp(-settings.dissipation * time)
    density = density * faded
    colour = None if colour is None else colour * faded

    after = after + time * _forces(after, density, temperature, settings, box)
    if forcing.gusts is not None:
        after = after + (2 * time * (density + temperature + fuel)).clamp_max(time) * forcing.gusts
    after = after * math.exp(-settings.drag * time)
    state = GasState(state.velocity, density, temperature, fuel, colour, state.time + time)
    for source in forcing.sources:
        state, after = _emit(state, after, source, time)
    if forcing.fade is not None:
        keep = torch.exp(-time * forcing.fade)
        colour = None if state.colour is None else state.colour * keep
        state = replace(
            state,
            density=state.density * keep,
            temperature=state.temperature * keep,
            fuel=state.fuel * keep,
            colour=colour,
        )
    return replace(state, velocity=project_velocity(_changed(state.velocity, before, after, settings.smoothing), box))


def _changed(velocity: Faces, before: Tensor, after: Tensor, smoothing: float) -> Faces:
    """Face velocities from what happened at the centres: they take the *change*, since the mean of means would blur all
    motion at every step. The little smoothing removes what the centres cannot see: motion that alternates from face to
    face."""
    change, mean = to_faces(after - before), to_faces(before)
    parts = [old + more + smoothing * (m - old) for old, more, m in zip(velocity, change, mean, strict=True)]
    return parts[0], parts[1], parts[2]


def _expansion(state: GasState, settings: SolverSettings, forcing: Forcing, time: float) -> Tensor | None:
    if not settings.expansion:
        return forcing.expansion
    burnt = state.fuel.clamp_max(settings.burn * time) * (settings.expansion / time)
    return burnt if forcing.expansion is None else burnt + forcing.expansion


def _react(
    density: Tensor, temperature: Tensor, fuel: Tensor, settings: SolverSettings, time: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Fuel burns at a constant rate (Nguyen, Fedkiw and Jensen 2002), which gives flames a sharp end; then the gas
    cools."""
    burnt = fuel.clamp_max(settings.burn * time)
    density = density + (2 * settings.soot) * burnt * (1 - fuel).clamp_min(0)
    temperature = temperature + settings.heat * burnt
    if settings.radiation:  # dT/dt = -r T^4 in closed form
        temperature = temperature * (1 + 3 * settings.radiation * time * temperature**3) ** (-1 / 3)
    return density, temperature * math.exp(-settings.cooling * time), fuel - burnt


def _forces(velocity: Tensor, density: Tensor, temperature: Tensor, settings: SolverSettings, box: Box) -> Tensor:
    """(3, X, Y, Z) acceleration: buoyancy, weight, and vorticity confinement ``e h (N x w)`` with w = curl u and N =
    grad |w| / |grad |w|| (Fedkiw, Stam and Jensen 2001), which gives small eddies back what interpolation takes from
    them."""
    if settings.confinement:
        w = _curl(velocity, box.cell)
        size = (w * w).sum(0).sqrt()
        n = torch.stack([_slope(size, axis, box.cell) for axis in range(3)])
        n = n / ((n * n).sum(0).sqrt() + 1e-3 / box.cell)  # no direction where nothing turns
        force = torch.stack([n[1] * w[2] - n[2] * w[1], n[2] * w[0] - n[0] * w[2], n[0] * w[1] - n[1] * w[0]])
        force *= settings.confinement * box.cell
    else:
        force = torch.zeros_like(velocity)
    force[2] += settings.buoyancy * temperature - settings.weight * density
    return force


def _slope(field: Tensor, axis: int, cell: float) -> Tensor:
    """Central difference along one axis, zero in the first and last cell."""
    result = torch.zeros_like(field)
    count = field.shape[axis] - 2
    result.narrow(axis, 1, count).copy_((field.narrow(axis, 2, count) - field.narrow(axis, 0, count)) * (0.5 / cell))
    return result


def _curl(velocity: Tensor, cell: float) -> Tensor:
    u, v, w = velocity
    return torch.stack(
        [
            _slope(w, 1, cell) - _slope(v, 2, cell),
            _slope(u, 2, cell) - _slope(w, 0, cell),
            _slope(v, 0, cell) - _slope(u, 1, cell),
        ]
    )


def _emit(state: GasState, velocity: Tensor, source: Source, time: float) -> tuple[GasState, Tensor]:
    """State and velocity at the centres after a source has worked for ``time`` seconds."""
    share = 1 - torch.exp(-source.rate * time)

    def towards(field: Tensor, value: Tensor | float) -> Tensor:
        field = field.clone()
        field[source.where] += share * (value - field[source.where])
        return field

    density, temperature, fuel, colour = state.density, state.temperature, state.fuel, state.colour
    if source.density is not None:
        density = towards(density, source.density)
        if colour is not None and source.colour is not None:
            colour = torch.stack(
                [towards(c, albedo * source.density) for c, albedo in zip(colour, source.colour, strict=True)]
            )
    if source.temperature is not None:
        temperature = towards(temperature, source.temperature)
    if source.fuel is not None:
        fuel = towards(fuel, source.fuel)
    if source.velocity is not None:
        velocity = torch.stack(
            [towards(component, value) for component, value in zip(velocity, source.velocity, strict=True)]
        )
    return replace(state, density=density, temperature=temperature, fuel=fuel, colour=colour), velocity
