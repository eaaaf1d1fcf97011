"""The built-in scenes: sources and forces over time, with smooth random turbulence."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from neuprim.scenes.smoke.solver import Box, Forcing, SolverSettings, Source

Axes = tuple[Tensor, Tensor, Tensor]
"""World coordinates (X, 1, 1), (1, Y, 1), (1, 1, Z), which broadcast against fields."""

_PERIOD = 16  # lattice nodes per axis before the noise repeats


class Noise:
    """Value noise (random numbers on a lattice, smoothly interpolated) with mean 0 and about unit variance at the
    nodes.

    A pure function of seed, channel, place and time, so that it is the same however a frame is divided into steps, and
    at any resolution the same pattern. Different channels are independent. ``cells`` are lattice cells per world unit;
    ``tempo`` is how often per second the field is another one, and in between one turns into the next.
    """

    def __init__(self, seed: int) -> None:
        self._lattice = lru_cache(maxsize=64)(self._draw)
        self._seed = seed

    def _draw(self, channel: int, key: int) -> Tensor:
        numbers = np.random.default_rng([self._seed, channel, key]).standard_normal((_PERIOD,) * 3)
        return torch.from_numpy(numbers.astype(np.float32))

    def field(self, channel: int, axes: Axes, cells: float, tempo: float, time: float) -> Tensor:
        """(X, Y, Z) values."""
        phase = max(time, 0.0) * tempo
        key = math.floor(phase)
        angle = (phase - key) * math.pi / 2
        lattice = math.cos(angle) * self._lattice(channel, key) + math.sin(angle) * self._lattice(channel, key + 1)
        x, y, z = (_weights(axis.reshape(-1) * cells) for axis in axes)
        planes = torch.matmul(y, torch.matmul(lattice, z.T)).reshape(_PERIOD, -1)
        return torch.matmul(x, planes).reshape(len(x), len(y), len(z))

    def fractal(self, channel: int, axes: Axes, cells: float, tempo: float, time: float, octaves: int = 3) -> Tensor:
        """Octaves of :meth:`field`, each twice as fine, half as strong and faster by half."""
        fields = (self.field(channel + 101 * k, axes, cells * 2**k, tempo * 1.5**k, time) for k in range(octaves))
        return torch.stack([field * 0.5**k for k, field in enumerate(fields)]).sum(0)

    def vector(self, channel: int, axes: Axes, cells: float, tempo: float, time: float, octaves: int = 2) -> Tensor:
        """(3, X, Y, Z): three independent :meth:`fractal` fields."""
        channels = (channel + 1009 * (k + 1) for k in range(3))
        return torch.stack([self.fractal(c, axes, cells, tempo, time, octaves) for c in channels])


def _weights(places: Tensor) -> Tensor:
    """(n, _PERIOD) what each lattice node counts at each place; cubic fade, so that slopes are continuous."""
    lower = places.floor()
    part = places - lower
    part = part * part * (3 - 2 * part)
    index = lower.long() % _PERIOD
    weights = torch.zeros(len(places), _PERIOD)
    rows = torch.arange(len(places))
    weights[rows, index] = 1 - part
    weights[rows, (index + 1) % _PERIOD] = part
    return weights


class Stage:
    """A box, the coordinates of its cells' centres, the noise, and (X, Y, Z) ``fade`` per second: near the sides and
    the top gas vanishes, so that nothing is cut off there."""

    def __init__(self, box: Box, seed: int) -> None:
        self.box, self.noise, self.axes = box, Noise(seed), box.axes()
        x, y, z = self.axes
        half_x, half_y, top = (n * box.cell * s for n, s in zip(box.shape, (0.5, 0.5, 1.0), strict=True))
        inside = torch.minimum(torch.minimum(half_x - x.abs(), half_y - y.abs()) / 0.14, (top - z) / 0.25)
        self.fade = 80.0 * (1 - inside).clamp_min(0) ** 2

    def region(
        self, low: tuple[float, float, float], high: tuple[float, float, float]
    ) -> tuple[tuple[slice, slice, slice], Axes]:
        """The cells whose centres lie in a box of the world (one at least per axis), and their coordinates."""
        slices, axes = [], []
        for axis, (a, b) in enumerate(zip(low, high, strict=True)):
            line = self.axes[axis].reshape(-1)
            first = int(torch.searchsorted(line, torch.tensor(a)))
            last = max(int(torch.searchsorted(line, torch.tensor(b))), first + 1)
            first = min(first, len(line) - 1)
            slices.append(slice(first, last))
            axes.append(self.axes[axis].narrow(axis, first, min(last, len(line)) - first))
        return (slices[0], slices[1], slices[2]), (axes[0], axes[1], axes[2])


@dataclass(frozen=True)
class SmokeScene:
    """A simulation: frames of the whole sequence, seconds between two of them, the grids that are written
    (:mod:`neuprim.scenes.smoke.generate`), what the gas is like, and sources and forces at a time in seconds."""

    name: str
    timesteps: int
    frame_time: float
    grids: tuple[str, ...]
    solver: SolverSettings
    forcing: Callable[[Stage, float], Forcing]

    @property
    def coloured(self) -> bool:
        """Whether the smoke has colours."""
        return "color" in self.grids


def _soft(distance: Tensor, width: float) -> Tensor:
    """1 well inside (negative distance), 0 outside, smooth over ``width``."""
    t = (0.5 - distance / width).clamp(0, 1)
    return t * t * (3 - 2 * t)


# ---------------------------------------------------------------- a fire on the ground


def _smoke_fire(stage: Stage, time: float) -> Forcing:
    where, axes = stage.region((-0.3, -0.3, 0.0), (0.3, 0.3, 0.1))
    x, y, z = axes
    noise = stage.noise
    radius = torch.sqrt(x * x + y * y) - 0.05 * noise.fractal(1, axes, 5.0, 3.0, time)
    flicker = torch.sigmoid(3.0 * noise.fractal(2, axes, 8.0, 6.0, time, octaves=2) + 0.6)
    rate = 50.0 * min(1.0, 0.2 + time / 0.25) * _soft(radius - 0.11, 0.06) * _soft(z - 0.05, 0.05) * flicker
    push = noise.vector(3, axes, 7.0, 7.0, time) * 0.5
    push[2] += 0.8
    fire = Source(where, rate, density=0.0, temperature=0.7, fuel=1.0, velocity=push)
    gusts = 3.0 * noise.vector(20, stage.axes, 7.0, 3.0, time)
    gusts[2] *= 0.5
    return Forcing((fire,), gusts, fade=stage.fade)


SMOKE_FIRE = SmokeScene(
    "smoke_fire",
    100,
    1 / 25,
    ("density", "temperature", "flames"),
    SolverSettings(
        buoyancy=4.0, weight=0.2, confinement=0.5, cooling=0.7, dissipation=0.35, burn=1.9, heat=0.7, soot=0.8,
        expansion=1.5, drag=0.1,
    ),
    _smoke_fire,
)  # fmt: skip

# ---------------------------------------------------------------- coloured jets

_PALETTE = ((0.95, 0.10, 0.20), (1.0, 0.62, 0.05), (0.10, 0.72, 0.30), (0.08, 0.40, 1.0), (0.72, 0.12, 0.90))


def _colorful_smoke(stage: Stage, time: float) -> Forcing:
    sources = []
    for k, albedo in enumerate(_PALETTE):
        angle = 2 * math.pi * (k / len(_PALETTE)) + 0.3
        cx, cy, cz = 0.2 * math.cos(angle), 0.2 * math.sin(angle), 0.07
        strength = 0.5 + 0.5 * math.sin(2 * math.pi * (0.55 * time + 0.37 * k + 0.1))  # they puff, one after another
        where, axes = stage.region((cx - 0.1, cy - 0.1, 0.0), (cx + 0.1, cy + 0.1, 0.2))
        x, y, z = axes
        lumps = stage.noise.fractal(10 * k, axes, 12.0, 4.0, time, octaves=2)
        distance = torch.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) - 0.012 * lumps
        rate = 60.0 * _soft(distance - 0.045, 0.035) * min(1.0, 0.2 + strength)
        push = 0.25 * stage.noise.vector(10 * k + 3, axes, 11.0, 6.0, time, octaves=1)
        speed = 0.5 + 0.75 * strength
        inward, around = 0.45, 0.35 if k % 2 else -0.2
        push[0] += speed * (-inward * math.cos(angle) - around * math.sin(angle))
        push[1] += speed * (-inward * math.sin(angle) + around * math.cos(angle))
        push[2] += speed * 0.9
        amount = 0.25 + 0.75 * strength
        sources.append(Source(where, rate, density=amount, temperature=0.35, colour=albedo, velocity=push))
    gusts = 1.2 * stage.noise.vector(200, stage.axes, 6.0, 2.0, time)
    return Forcing(sources, gusts, fade=stage.fade)


COLORFUL_SMOKE = SmokeScene(
    "colorful_smoke",
    128,
    1 / 30,
    ("density", "temperature", "color"),
    SolverSettings(buoyancy=1.6, weight=0.05, confinement=0.4, cooling=0.4, dissipation=0.22, drag=0.15),
    _colorful_smoke,
)

# ---------------------------------------------------------------- a blast


def _ground_explosion(stage: Stage, time: float) -> Forcing:
    noise, sources = stage.noise, []
    expansion = None
    blast = _fade(time, 0.13, 0.06)
    if blast > 0:
        where, axes = stage.region((-0.25, -0.25, 0.0), (0.25, 0.25, 0.25))
        x, y, z = axes
        distance = torch.sqrt(x * x + y * y + (z - 0.03) ** 2) + 1e-6
        lumps = noise.fractal(1, axes, 9.0, 5.0, time)
        inside = _soft(distance - 0.1 - 0.02 * lumps, 0.05) * blast
        push = torch.stack([x.expand_as(distance), y.expand_as(distance), (z * 1.2).expand_as(distance)]) / distance
        push = 1.0 * push * (1 + 0.3 * lumps) + 0.3 * noise.vector(2, axes, 10.0, 8.0, time)
        push[2] += 0.7
        sources.append(Source(where, 60.0 * inside, density=0.05, temperature=1.0, fuel=1.0, velocity=push))
        expansion = torch.zeros(stage.box.shape)
        expansion[where] = 22.0 * inside
    sweep = _fade(time, 0.55, 0.35)
    if sweep > 0:  # the pressure wave runs outward and lifts a ring of dust
        front = 0.08 + 0.26 * (1 - math.exp(-time / 0.22))
        where, axes = stage.region((-0.5, -0.5, 0.0), (0.5, 0.5, 0.09))
        x, y, z = axes
        distance = torch.sqrt(x * x + y * y) + 1e-6
        lumps = noise.fractal(5, axes, 11.0, 3.0, time)
        ring = _soft((distance - front).abs() - 0.035 - 0.02 * lumps, 0.05) * _soft(z - 0.03 - 0.015 * lumps, 0.03)
        speed = 1.1 * math.exp(-time / 0.3)
        push = torch.stack([x.expand_as(ring), y.expand_as(ring), torch.zeros_like(ring)]) / distance * speed
        push[2] += 0.35 * speed
        amount = (0.3 + 0.3 * lumps).clamp(0.05, 0.7)
        sources.append(Source(where, 18.0 * ring * sweep, density=amount, temperature=0.02, velocity=push))
    gusts = 1.2 * noise.vector(40, stage.axes, 10.0, 2.0, time)
    return Forcing(sources, gusts, expansion, stage.fade)


def _fade(time: float, end: float, length: float) -> float:
    """1, then down to 0 at ``end`` over ``length`` seconds."""
    return min(1.0, max(0.0, (end - time) / length))


GROUND_EXPLOSION = SmokeScene(
    "ground_explosion",
    130,
    1 / 36,
    ("density", "temperature", "flames"),
    SolverSettings(
        buoyancy=3.6, weight=0.35, confinement=0.35, cooling=0.7, radiation=0.3, dissipation=0.25, burn=0.75, heat=0.3,
        soot=0.8, expansion=2.0, drag=0.25,
    ),
    _ground_explosion,
)  # fmt: skip

# ---------------------------------------------------------------- a whirlwind


def _axis(height: Tensor, time: float) -> tuple[Tensor, Tensor]:
    """Where the whirl's axis passes at each height: the ground leads, the top follows later and wanders less."""
    late = time - 0.55 * height
    reach = 0.13 * torch.exp(-0.35 * height)
    return reach * torch.sin(1.5 * late + 0.4), reach * torch.sin(1.05 * late + 2.0)


def _dust_tornado(stage: Stage, time: float) -> Forcing:
    x, y, z = stage.axes
    noise = stage.noise
    centre_x, centre_y = _axis(z, time)
    dx, dy = x - centre_x, y - centre_y
    r2 = dx * dx + dy * dy + 1e-8
    r = torch.sqrt(r2)
    core, widening = 0.05 + 0.05 * z + 0.08 * z * z, 0.05 + 0.16 * z
    inside = torch.exp(-r2 / (1.6 * core) ** 2)
    turn = 1.8 * core / r * (1 - torch.exp(-r2 / core**2))  # the vortex of Burgers: rigid in the core, 1/r outside
    # Two arms wind up the column; they turn with the gas, and what they lift faster shows as bands.
    arms = torch.cos(2 * torch.atan2(dy, dx) + 9.0 * z - 14.0 * time + 2.0 * noise.field(9, stage.axes, 4.0, 2.0, time))
    updraft = 1.35 * inside * (1 + 0.55 * arms) - 0.12
    outward = updraft * widening * r / core * inside - 0.6 * torch.exp(-z / 0.08) * (1 - inside)
    push = torch.stack(
        [(dx * outward - dy * turn) / r, (dy * outward + dx * turn) / r, updraft * (1 - torch.exp(-z / 0.03))]
    )
    whole = (slice(None), slice(None), slice(None))
    whirl = Source(whole, 4.5 * torch.exp(-r2 / (3.0 * core) ** 2), velocity=push)

    where, axes = stage.region((-0.45, -0.45, 0.0), (0.45, 0.45, 0.12))
    fx, fy = _axis(axes[2], time)
    ground = torch.sqrt((axes[0] - fx) ** 2 + (axes[1] - fy) ** 2)
    lumps = noise.fractal(1, axes, 13.0, 7.0, time)
    ring = _soft((ground - 0.085).abs() - 0.04 - 0.035 * lumps, 0.05) * _soft(axes[2] - 0.03 - 0.025 * lumps, 0.04)
    dust = Source(where, 22.0 * ring, density=(0.4 + 0.6 * lumps).clamp(0.0, 1.2), temperature=0.05)
    gusts = (2.0 + 3.5 * z) * noise.vector(40, stage.axes, 8.0, 5.0, time)
    return Forcing((whirl, dust), gusts, fade=stage.fade + 2.5 * (z - 0.6).clamp_min(0))  # dust thins out on its way up


DUST_TORNADO = SmokeScene(
    "dust_tornado",
    100,
    1 / 24,
    ("density", "temperature"),
    SolverSettings(buoyancy=0.3, weight=0.15, confinement=0.45, cooling=0.3, dissipation=0.3, drag=0.1),
    _dust_tornado,
)

SCENES = {scene.name: scene for scene in (SMOKE_FIRE, COLORFUL_SMOKE, GROUND_EXPLOSION, DUST_TORNADO)}
"""The built-in scenes by name."""
