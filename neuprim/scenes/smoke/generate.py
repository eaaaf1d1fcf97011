"""A simulated scene as a sequence of OpenVDB files.

    NAME_0.vdb ... NAME_{T-1}.vdb     fog volumes of half floats, Blosc, numbers not padded, as EmberGen writes them

    density        amount of smoke
    temperature    0 is the air's
    flames         fuel that is burning (scenes with fire)
    color          albedo of the smoke, vec3s, not multiplied by density (scenes with colours)

Values are about 0 to 1. Voxels are cubes; the box is one world unit wide and deep, centred at x = y = 0, its ground at
z = 0, z up.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import numpy as np
import torch

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.io.vdb import Grid, scale_transform, write_vdb
from neuprim.core.validation import Range, coerce
from neuprim.scenes.image_set import write_cached_folder
from neuprim.scenes.smoke.scenes import SCENES, SmokeScene, Stage
from neuprim.scenes.smoke.solver import Box, GasState, advance_gas

SOLVER_VERSION = 1
"""Part of the cache's key: raise it with every change to the solver, the scenes' sources or the files' layout."""

THRESHOLD = 2e-3
"""Values below are background: they are invisible, and files stay small."""

Resolution = Annotated[int, Range(16, 192)]
"""Cells across the box; advection counts cells in float32, which is exact up to 2^24."""

TIMESTEPS = (1, 1000)
"""Fewest and most frames of a simulation."""

Progress = Callable[[str, float], None]


def simulate_smoke(
    name: str,
    frames: int | None,
    resolution: int,
    seed: int,
    cache_dir: Path,
    progress: Progress = lambda text, fraction: None,
) -> Path:
    """Run a simulation unless its sequence is complete; return the folder ``cache_dir/sim-NAME-KEY``.

    Equal arguments give equal grids on one machine for any number of threads.

    Args:
        name: one of :data:`~neuprim.scenes.smoke.scenes.SCENES`.
        frames: number of frames from the start; None for all.
        resolution: cells across the box, which is half as high again as it is wide.
        seed: of the turbulence; not negative.

    Raises:
        ConfigError: unknown scene or impossible value.
        DataError: the cache directory cannot be written.
    """
    if name not in SCENES:
        raise ConfigError(f"scene {name!r} is not simulated{nearest(str(name), SCENES)}")
    scene = SCENES[name]
    count = scene.timesteps if frames is None else frames
    count = coerce(count, Annotated[int, Range(*TIMESTEPS)], "scene.timesteps")
    resolution = coerce(resolution, Resolution, "scene.resolution")
    seed = coerce(seed, Annotated[int, Range(0, 2**63 - 1)], "seed")
    final = Path(cache_dir) / f"sim-{name}-{simulation_key(scene, count, resolution, seed)}"
    files = [f"{name}_{i}.vdb" for i in range(count)]

    def write(folder: Path) -> None:
        _write(scene, [folder / file for file in files], resolution, seed, progress)

    return write_cached_folder(final, files, write, f"scene {name}: cannot write the simulated frames")


def simulation_key(scene: SmokeScene, frames: int, resolution: int, seed: int) -> str:
    """Hash everything that the files depend on."""
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


def simulation_box(resolution: int) -> Box:
    """The box: one world unit wide and deep, 1.5 high, rounded up to blocks of 8 voxels."""
    return Box((resolution, resolution, -(-3 * resolution // 16) * 8), 1.0 / resolution)


def make_vdb_grids(state: GasState, scene: SmokeScene, box: Box) -> list[Grid]:
    """Convert a state to the grids of the scene, in half floats, with faint values set to the background."""
    half = box.cell * 0.5
    corner = (half - box.shape[0] * half, half - box.shape[1] * half, half)  # the centre of voxel 0
    transform = scale_transform(box.cell, corner)
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
        grids.append(Grid.from_dense(name, values, transform=transform, half=True))
    return grids


def _write(scene: SmokeScene, paths: list[Path], resolution: int, seed: int, progress: Progress) -> None:
    """Simulate, and write each frame while the next one is computed."""
    text = f"{scene.name}: simulating {len(paths)} frames"
    progress(text, 0.0)
    box = simulation_box(resolution)
    stage, state = Stage(box, seed), GasState.empty(box, scene.coloured)
    metadata = {"creator": "neuprim simulation", "comment": f"simulated by neuprim: {scene.name}, seed {seed}"}
    writing: Future[None] | None = None
    pool = ThreadPoolExecutor(1)
    try:
        for frame, path in enumerate(paths, start=1):
            with _one_torch_thread():
                state = advance_gas(state, scene.solver, box, scene.forcing(stage, state.time), scene.frame_time)
            if writing is not None:
                writing.result()  # raises what the writer raised
            writing = pool.submit(write_vdb, path, make_vdb_grids(state, scene, box), metadata=metadata)
            progress(text, frame / len(paths))
        if writing is not None:
            writing.result()
    finally:
        pool.shutdown(cancel_futures=True)


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Run torch on one thread: the solver divides its work itself, and results must not depend on threads."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
