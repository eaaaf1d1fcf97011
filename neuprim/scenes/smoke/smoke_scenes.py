"""The built-in smoke scenes, simulated as sequences of OpenVDB files.

    NAME_0.vdb ... NAME_{T-1}.vdb     fog volumes of half floats, Blosc; no leading zeros, as in files of EmberGen

    density        amount of smoke
    temperature    0 is the temperature of the air
    flames         burning fuel (scenes with fire)
    color          albedo of the smoke, vec3s, not multiplied by density (scenes with colours)

Values are about 0 to 1. Voxels are cubes. The simulation box is one world unit wide and deep, centred at x = y = 0. The
ground is at z = 0, and z is up. Each scene defines sources and forces over time, with smooth random turbulence.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from torch import Tensor

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.io.vdb import VdbGrid, vdb_scale_transform, write_vdb
from neuprim.core.validation import Range
from neuprim.scenes.image_set import Progress, write_scene_folder
from neuprim.scenes.smoke.solver import GasForcing, GasProperties, GasSource, GasState, SmokeBox, advance_gas

SOLVER_VERSION = 1
"""Part of the cache's key: raise it with every change to the solver, the scenes' sources or the files' layout."""

THRESHOLD = 2e-3
"""Grid values below this limit are written as background, so that files are small. Such values are invisible."""

Resolution = Annotated[int, Range(16, 192)]
"""Number of cells across the simulation box. The limit exists because float32 counts cells exactly only up to 2^24."""

MAX_TIMESTEPS = 1000

Axes = tuple[Tensor, Tensor, Tensor]
"""World coordinates of cell centres: (X, 1, 1), (1, Y, 1), (1, 1, Z), which broadcast against (X, Y, Z) fields."""

_PERIOD = 16  # lattice nodes per axis before the noise repeats


class TurbulenceNoise:
    """Value noise (random numbers on a lattice, smoothly interpolated) with mean 0 and unit variance at the nodes.

    The noise depends only on seed, channel, position and time, not on time steps or resolution. Channels are
    independent. Arguments of the methods: ``cells`` is the number of lattice cells per world unit. ``tempo`` is the
    number of new random fields per second.
    """

    def __init__(self, seed: int) -> None:
        self._lattice = lru_cache(maxsize=64)(self._draw_nodes)
        self._seed = seed

    def _draw_nodes(self, channel: int, key: int) -> Tensor:
        numbers = np.random.default_rng([self._seed, channel, key]).standard_normal((_PERIOD,) * 3)
        return torch.from_numpy(numbers.astype(np.float32))

    def field(self, channel: int, axes: Axes, cells: float, tempo: float, time: float) -> Tensor:
        """Return (X, Y, Z) noise of one channel at ``time``, seconds, on the grid of coordinates ``axes``.

        ``cells``: lattice cells per world unit. ``tempo``: new random fields per second. Between the times of two
        fields, the fields are blended.
        """
        phase = max(time, 0.0) * tempo
        key = math.floor(phase)
        angle = (phase - key) * math.pi / 2
        lattice = math.cos(angle) * self._lattice(channel, key) + math.sin(angle) * self._lattice(channel, key + 1)
        x, y, z = (_smoke_lattice_weights(axis.reshape(-1) * cells) for axis in axes)
        planes = torch.matmul(y, torch.matmul(lattice, z.T)).reshape(_PERIOD, -1)
        return torch.matmul(x, planes).reshape(len(x), len(y), len(z))

    def fractal(self, channel: int, axes: Axes, cells: float, tempo: float, time: float, octaves: int = 3) -> Tensor:
        """Return a sum of ``octaves`` fields of :meth:`field`.

        Each octave is twice as fine, half as strong and 1.5 times as fast as the octave before.
        """
        fields = (self.field(channel + 101 * k, axes, cells * 2**k, tempo * 1.5**k, time) for k in range(octaves))
        return torch.stack([field * 0.5**k for k, field in enumerate(fields)]).sum(0)

    def vector(self, channel: int, axes: Axes, cells: float, tempo: float, time: float, octaves: int = 2) -> Tensor:
        """Return a (3, X, Y, Z) vector field of three independent :meth:`fractal` fields."""
        channels = (channel + 1009 * (k + 1) for k in range(3))
        return torch.stack([self.fractal(c, axes, cells, tempo, time, octaves) for c in channels])


def _smoke_lattice_weights(places: Tensor) -> Tensor:
    """Return the (n, _PERIOD) weights of the lattice nodes at n coordinates ``places``, in cells, along one axis.

    The weights are cubic polynomials, so that the noise has continuous slopes.
    """
    lower = places.floor()
    part = places - lower
    part = part * part * (3 - 2 * part)
    index = lower.long() % _PERIOD
    weights = torch.zeros(len(places), _PERIOD)
    rows = torch.arange(len(places))
    weights[rows, index] = 1 - part
    weights[rows, (index + 1) % _PERIOD] = part
    return weights


class SmokeStage:
    """Simulation box of a smoke scene, with coordinates of cell centres (``axes``), noise, and ``fade``.

    ``fade`` (X, Y, Z), 1/s, is the rate at which gas vanishes near the sides and the top of the box, so that smoke is
    not cut off there.
    """

    def __init__(self, box: SmokeBox, seed: int) -> None:
        self.box, self.noise, self.axes = box, TurbulenceNoise(seed), box.axes()
        x, y, z = self.axes
        half_x, half_y, top = (n * box.cell * s for n, s in zip(box.shape, (0.5, 0.5, 1.0), strict=True))
        inside = torch.minimum(torch.minimum(half_x - x.abs(), half_y - y.abs()) / 0.14, (top - z) / 0.25)
        self.fade = 80.0 * (1 - inside).clamp_min(0) ** 2

    def region(
        self, low: tuple[float, float, float], high: tuple[float, float, float]
    ) -> tuple[tuple[slice, slice, slice], Axes]:
        """Return slices and coordinates of the cells whose centres lie in a world box, at least one cell per axis."""
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
    """A simulated smoke scene: default number of frames, seconds per frame, and the gas properties (``solver``).

    ``grids`` names the OpenVDB grids to write, e.g. "density". ``forcing`` returns the sources and forces at a time in
    seconds.
    """

    name: str
    timesteps: int
    frame_time: float
    grids: tuple[str, ...]
    solver: GasProperties
    forcing: Callable[[SmokeStage, float], GasForcing]

    @property
    def coloured(self) -> bool:
        """Whether smoke has colours, i.e. the scene writes the grid ``color``."""
        return "color" in self.grids


def _soft_smoke_source_edge(distance: Tensor, width: float) -> Tensor:
    """Return a smooth step of the signed ``distance``: 1 inside (negative), 0 outside.

    The step falls from 1 to 0 over distances from -``width`` / 2 to ``width`` / 2.
    """
    t = (0.5 - distance / width).clamp(0, 1)
    return t * t * (3 - 2 * t)


# ---------------------------------------------------------------- a fire on the ground


def _force_smoke_fire(stage: SmokeStage, time: float) -> GasForcing:
    where, axes = stage.region((-0.3, -0.3, 0.0), (0.3, 0.3, 0.1))
    x, y, z = axes
    noise = stage.noise
    radius = torch.sqrt(x * x + y * y) - 0.05 * noise.fractal(1, axes, 5.0, 3.0, time)
    flicker = torch.sigmoid(3.0 * noise.fractal(2, axes, 8.0, 6.0, time, octaves=2) + 0.6)
    rate = (
        50.0
        * min(1.0, 0.2 + time / 0.25)
        * _soft_smoke_source_edge(radius - 0.11, 0.06)
        * _soft_smoke_source_edge(z - 0.05, 0.05)
        * flicker
    )
    push = noise.vector(3, axes, 7.0, 7.0, time) * 0.5
    push[2] += 0.8
    fire = GasSource(where, rate, density=0.0, temperature=0.7, fuel=1.0, velocity=push)
    gusts = 3.0 * noise.vector(20, stage.axes, 7.0, 3.0, time)
    gusts[2] *= 0.5
    return GasForcing((fire,), gusts, fade=stage.fade)


SMOKE_FIRE = SmokeScene(
    "smoke_fire",
    100,
    1 / 25,
    ("density", "temperature", "flames"),
    GasProperties(
        buoyancy=4.0, weight=0.2, confinement=0.5, cooling=0.7, dissipation=0.35, burn=1.9, heat=0.7, soot=0.8,
        expansion=1.5, drag=0.1,
    ),
    _force_smoke_fire,
)  # fmt: skip

# ---------------------------------------------------------------- coloured jets

_PALETTE = ((0.95, 0.10, 0.20), (1.0, 0.62, 0.05), (0.10, 0.72, 0.30), (0.08, 0.40, 1.0), (0.72, 0.12, 0.90))


def _force_colorful_smoke(stage: SmokeStage, time: float) -> GasForcing:
    sources = []
    for k, albedo in enumerate(_PALETTE):
        angle = 2 * math.pi * (k / len(_PALETTE)) + 0.3
        cx, cy, cz = 0.2 * math.cos(angle), 0.2 * math.sin(angle), 0.07
        strength = 0.5 + 0.5 * math.sin(2 * math.pi * (0.55 * time + 0.37 * k + 0.1))  # they puff, one after another
        where, axes = stage.region((cx - 0.1, cy - 0.1, 0.0), (cx + 0.1, cy + 0.1, 0.2))
        x, y, z = axes
        lumps = stage.noise.fractal(10 * k, axes, 12.0, 4.0, time, octaves=2)
        distance = torch.sqrt((x - cx) ** 2 + (y - cy) ** 2 + (z - cz) ** 2) - 0.012 * lumps
        rate = 60.0 * _soft_smoke_source_edge(distance - 0.045, 0.035) * min(1.0, 0.2 + strength)
        push = 0.25 * stage.noise.vector(10 * k + 3, axes, 11.0, 6.0, time, octaves=1)
        speed = 0.5 + 0.75 * strength
        inward, around = 0.45, 0.35 if k % 2 else -0.2
        push[0] += speed * (-inward * math.cos(angle) - around * math.sin(angle))
        push[1] += speed * (-inward * math.sin(angle) + around * math.cos(angle))
        push[2] += speed * 0.9
        amount = 0.25 + 0.75 * strength
        sources.append(GasSource(where, rate, density=amount, temperature=0.35, colour=albedo, velocity=push))
    gusts = 1.2 * stage.noise.vector(200, stage.axes, 6.0, 2.0, time)
    return GasForcing(sources, gusts, fade=stage.fade)


COLORFUL_SMOKE = SmokeScene(
    "colorful_smoke",
    128,
    1 / 30,
    ("density", "temperature", "color"),
    GasProperties(buoyancy=1.6, weight=0.05, confinement=0.4, cooling=0.4, dissipation=0.22, drag=0.15),
    _force_colorful_smoke,
)

# ---------------------------------------------------------------- a blast


def _force_ground_explosion(stage: SmokeStage, time: float) -> GasForcing:
    noise, sources = stage.noise, []
    expansion = None
    blast = _fade_out(time, 0.13, 0.06)
    if blast > 0:
        where, axes = stage.region((-0.25, -0.25, 0.0), (0.25, 0.25, 0.25))
        x, y, z = axes
        distance = torch.sqrt(x * x + y * y + (z - 0.03) ** 2) + 1e-6
        lumps = noise.fractal(1, axes, 9.0, 5.0, time)
        inside = _soft_smoke_source_edge(distance - 0.1 - 0.02 * lumps, 0.05) * blast
        push = torch.stack([x.expand_as(distance), y.expand_as(distance), (z * 1.2).expand_as(distance)]) / distance
        push = 1.0 * push * (1 + 0.3 * lumps) + 0.3 * noise.vector(2, axes, 10.0, 8.0, time)
        push[2] += 0.7
        sources.append(GasSource(where, 60.0 * inside, density=0.05, temperature=1.0, fuel=1.0, velocity=push))
        expansion = torch.zeros(stage.box.shape)
        expansion[where] = 22.0 * inside
    sweep = _fade_out(time, 0.55, 0.35)
    if sweep > 0:  # the pressure wave runs outward and lifts a ring of dust
        front = 0.08 + 0.26 * (1 - math.exp(-time / 0.22))
        where, axes = stage.region((-0.5, -0.5, 0.0), (0.5, 0.5, 0.09))
        x, y, z = axes
        distance = torch.sqrt(x * x + y * y) + 1e-6
        lumps = noise.fractal(5, axes, 11.0, 3.0, time)
        ring = _soft_smoke_source_edge((distance - front).abs() - 0.035 - 0.02 * lumps, 0.05) * _soft_smoke_source_edge(
            z - 0.03 - 0.015 * lumps, 0.03
        )
        speed = 1.1 * math.exp(-time / 0.3)
        push = torch.stack([x.expand_as(ring), y.expand_as(ring), torch.zeros_like(ring)]) / distance * speed
        push[2] += 0.35 * speed
        amount = (0.3 + 0.3 * lumps).clamp(0.05, 0.7)
        sources.append(GasSource(where, 18.0 * ring * sweep, density=amount, temperature=0.02, velocity=push))
    gusts = 1.2 * noise.vector(40, stage.axes, 10.0, 2.0, time)
    return GasForcing(sources, gusts, expansion, stage.fade)


def _fade_out(time: float, end: float, length: float) -> float:
    """Return a factor that is 1 at first, and falls linearly to 0 in the last ``length`` seconds before ``end``."""
    return min(1.0, max(0.0, (end - time) / length))


GROUND_EXPLOSION = SmokeScene(
    "ground_explosion",
    130,
    1 / 36,
    ("density", "temperature", "flames"),
    GasProperties(
        buoyancy=3.6, weight=0.35, confinement=0.35, cooling=0.7, radiation=0.3, dissipation=0.25, burn=0.75, heat=0.3,
        soot=0.8, expansion=2.0, drag=0.25,
    ),
    _force_ground_explosion,
)  # fmt: skip

# ---------------------------------------------------------------- a whirlwind


def _whirl_axis(height: Tensor, time: float) -> tuple[Tensor, Tensor]:
    """Return x and y of the tornado's axis at each height; higher parts follow with a delay and move less."""
    late = time - 0.55 * height
    reach = 0.13 * torch.exp(-0.35 * height)
    return reach * torch.sin(1.5 * late + 0.4), reach * torch.sin(1.05 * late + 2.0)


def _force_dust_tornado(stage: SmokeStage, time: float) -> GasForcing:
    x, y, z = stage.axes
    noise = stage.noise
    centre_x, centre_y = _whirl_axis(z, time)
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
    whirl = GasSource(whole, 4.5 * torch.exp(-r2 / (3.0 * core) ** 2), velocity=push)

    where, axes = stage.region((-0.45, -0.45, 0.0), (0.45, 0.45, 0.12))
    fx, fy = _whirl_axis(axes[2], time)
    ground = torch.sqrt((axes[0] - fx) ** 2 + (axes[1] - fy) ** 2)
    lumps = noise.fractal(1, axes, 13.0, 7.0, time)
    ring = _soft_smoke_source_edge((ground - 0.085).abs() - 0.04 - 0.035 * lumps, 0.05) * _soft_smoke_source_edge(
        axes[2] - 0.03 - 0.025 * lumps, 0.04
    )
    dust = GasSource(where, 22.0 * ring, density=(0.4 + 0.6 * lumps).clamp(0.0, 1.2), temperature=0.05)
    gusts = (2.0 + 3.5 * z) * noise.vector(40, stage.axes, 8.0, 5.0, time)
    return GasForcing(
        (whirl, dust), gusts, fade=stage.fade + 2.5 * (z - 0.6).clamp_min(0)
    )  # dust thins out on its way up


DUST_TORNADO = SmokeScene(
    "dust_tornado",
    100,
    1 / 24,
    ("density", "temperature"),
    GasProperties(buoyancy=0.3, weight=0.15, confinement=0.45, cooling=0.3, dissipation=0.3, drag=0.1),
    _force_dust_tornado,
)

SMOKE_SCENES = {scene.name: scene for scene in (SMOKE_FIRE, COLORFUL_SMOKE, GROUND_EXPLOSION, DUST_TORNADO)}
"""The built-in scenes by name."""


# ---------------------------------------------------------------- simulation


def simulate_smoke(
    name: str,
    frames: int | None,
    resolution: int,
    seed: int,
    cache_dir: Path,
    progress: Progress = lambda text, fraction: None,
) -> Path:
    """Simulate a smoke scene unless its files exist; return the folder ``cache_dir/sim-NAME-KEY``.

    Equal arguments give equal grids on one machine for any number of threads.

    Args:
        name: one of :data:`SMOKE_SCENES`.
        frames: number of frames, at most :data:`MAX_TIMESTEPS`; None for the default number of the scene.
        resolution: cells across the width of the box. The height of the box is 1.5 times its width.
        seed: seed of the turbulence; not negative.

    Raises:
        ConfigError: there is no scene ``name``.
        DataError: the cache directory cannot be written.
    """
    if name not in SMOKE_SCENES:
        raise ConfigError(f"scene {name!r} is not simulated{nearest(str(name), SMOKE_SCENES)}")
    scene = SMOKE_SCENES[name]
    count = scene.timesteps if frames is None else frames
    files = [f"{name}_{i}.vdb" for i in range(count)]

    def write(folder: Path) -> None:
        text = f"{name}: simulating {count} frames"
        progress(text, 0.0)
        box = smoke_box(resolution)
        stage, state = SmokeStage(box, seed), GasState.clear_air(box, scene.coloured)
        metadata = {"creator": "neuprim simulation", "comment": f"simulated by neuprim: {name}, seed {seed}"}
        for frame, file in enumerate(files, start=1):
            with _solve_smoke_on_one_thread():
                state = advance_gas(state, scene.solver, box, scene.forcing(stage, state.time), scene.frame_time)
            write_vdb(folder / file, make_smoke_grids(state, scene, box), metadata=metadata)
            progress(text, frame / count)

    final = Path(cache_dir) / f"sim-{name}-{simulation_key(scene, count, resolution, seed)}"
    return write_scene_folder(final, files, write, f"scene {name}: cannot write the simulated frames")


def simulation_key(scene: SmokeScene, frames: int, resolution: int, seed: int) -> str:
    """Return a hash of everything that the files of a simulation depend on."""
    settings = {
        "version": SOLVER_VERSION,
        "scene": scene.name,
        "frame_time": scene.frame_time,
        "grids": scene.grids,
        "solver": asdict(scene.solver),
        "threshold": THRESHOLD,
        "frames": frames,
        "resolution": resolution,
        "seed": seed,
    }
    return hashlib.sha256(json.dumps(settings, sort_keys=True).encode()).hexdigest()[:16]


def smoke_box(resolution: int) -> SmokeBox:
    """Return the simulation box: one world unit wide and deep, and 1.5 high, rounded up to a multiple of 8 voxels."""
    return SmokeBox((resolution, resolution, -(-3 * resolution // 16) * 8), 1.0 / resolution)


def make_smoke_grids(state: GasState, scene: SmokeScene, box: SmokeBox) -> list[VdbGrid]:
    """Convert a gas state to the scene's OpenVDB grids, in half floats; faint values become background."""
    half = box.cell * 0.5
    corner = (half - box.shape[0] * half, half - box.shape[1] * half, half)  # the centre of voxel 0
    transform = vdb_scale_transform(box.cell, corner)
    fields = {"density": state.density, "temperature": state.temperature, "flames": state.fuel}
    grids = []
    for name in scene.grids:
        if name == "color":
            assert state.colour is not None
            straight = (state.colour / state.density.clamp_min(THRESHOLD)).clamp(0, 1)
            straight = torch.where(state.density < THRESHOLD, 0.0, straight)
            values = np.ascontiguousarray(straight.permute(1, 2, 3, 0).numpy())
        else:
            values = fields[name].numpy()
            values = np.where(values < THRESHOLD, np.float32(0), values)
        grids.append(VdbGrid.from_dense(name, values, transform=transform, half=True))
    return grids


@contextmanager
def _solve_smoke_on_one_thread() -> Iterator[None]:
    """Return a context manager that runs each torch operation on one thread.

    Results then do not depend on the number of threads of torch or of the solver.
    """
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
