"""Grids that neuprim exports, compared with those of the source, and motion blur, compared with its limit.

    python benchmarks/exported_grids.py [--scenes smoke_fire mantaflow embergen] [--mantaflow DIR] [--embergen DIR]
        [--steps 8000] [--record] [--print [--docs]]

trains a model of each scene with all grids of its files as channels, exports it with `velocity=true`, and compares the
grids with the source. `smoke_fire` is simulated again, which gives its velocity. `mantaflow` is a folder of Mantaflow's
.vdb files with the staggered grid `velocity`. Its files place each frame in a unit box, so they are first written again
with one voxel size. `embergen` is frames 20 to 40 of EmberGen's files. Errors are those of metrics.json, on voxels with
extinction. The grid `vel` (motion of the primitives) is compared on all voxels where the density of the source and of
the export is not zero. The correlation is Pearson's, over all three components after the mean of each is subtracted.
Motion blur is `render --shutter 0.5` in the middle frame, from four sides: the lowest PSNR of eight sub-frames, and of
one, against 32. --record writes benchmarks/results/exported_grids.json and the table of docs/results/dynamic.md.
"""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from shared.arguments import make_parser, require_folders
from shared.tables import RESULTS, Record, Table, publish

from neuprim.config import compose
from neuprim.core.compute.threads import cpu_name
from neuprim.core.io.vdb import VdbGrid, list_vdb_files, read_grid, read_grids, vdb_scale_transform, write_vdb
from neuprim.core.metrics import psnr
from neuprim.runs.export import export_run
from neuprim.runs.render_images import RenderRequest, render_run
from neuprim.runs.run import run
from neuprim.scenes.smoke.smoke_scenes import SMOKE_FIRE, SmokeStage, simulate_smoke, smoke_box
from neuprim.scenes.smoke.solver import GasState, advance_gas
from neuprim.tasks.dynamic.volume.capture_density import THIRDS

RECORD = RESULTS / "exported_grids.json"
FRAMES, RESOLUTION = 50, 48  # of smoke_fire
_SIZE = ("scene.size=96", "scene.cameras=12")

Frame = tuple[np.ndarray, np.ndarray]
"""Density (X, Y, Z) and velocity (X, Y, Z, 3) of the source, from voxel 0 on."""


def simulate() -> Iterator[Frame]:
    """Yield the frames of `smoke_fire`, with velocities in world units per frame."""
    box = smoke_box(RESOLUTION)
    stage, state = SmokeStage(box, 0), GasState.clear_air(box)
    for _ in range(FRAMES):
        state = advance_gas(state, SMOKE_FIRE.solver, box, SMOKE_FIRE.forcing(stage, state.time), SMOKE_FIRE.frame_time)
        faces = [component.numpy() for component in state.velocity]
        yield state.density.numpy(), SMOKE_FIRE.frame_time * _at_centres(faces)


def read_mantaflow(folder: Path) -> Iterator[Frame]:
    """Yield the frames of a Mantaflow sequence, with velocities in unknown units."""
    for frame in list_vdb_files(folder).frames:
        density, velocity = (read_grid(frame.path, name) for name in ("density", "velocity"))
        assert density.bounds is not None
        size = density.bounds[1]
        faces = velocity.to_dense(((0, 0, 0), tuple(n + 1 for n in size)))  # type: ignore[arg-type]
        x, y, z = size
        shapes = ((x + 1, y, z), (x, y + 1, z), (x, y, z + 1))
        cut = [faces[:a, :b, :c, axis] for axis, (a, b, c) in enumerate(shapes)]
        yield density.to_dense(((0, 0, 0), size)), _at_centres(cut)


def _at_centres(faces: list[np.ndarray]) -> np.ndarray:
    """Return (X, Y, Z, 3) means of opposite faces of a staggered grid."""
    u, v, w = faces
    return np.stack([u[1:] + u[:-1], v[:, 1:] + v[:, :-1], w[:, :, 1:] + w[:, :, :-1]], -1) / 2


def add_velocity(source: Path, frames: Iterator[Frame], target: Path) -> Path:
    """Write the files of a simulation again, with the grid `velocity`."""
    target.mkdir()
    for frame, (_, velocity) in zip(list_vdb_files(source).frames, frames, strict=True):
        grids = list(read_grids(frame.path))
        moving = VdbGrid.from_dense("velocity", velocity, transform=grids[0].transform)
        write_vdb(target / frame.path.name, [*grids, moving])
    return target


def rescale(source: Path, target: Path) -> Path:
    """Write a Mantaflow sequence with one voxel size, that of the last frame."""
    frames = list_vdb_files(source).frames
    transform = vdb_scale_transform(read_grid(frames[-1].path, "density").voxel_size)
    target.mkdir()
    for frame in frames:
        grids = [read_grid(frame.path, name) for name in ("density", "flame", "velocity")]
        write_vdb(target / frame.path.name, [replace(grid, transform=transform, metadata={}) for grid in grids])
    return target


def train(scene: str, words: list[str], steps: int, folder: Path) -> tuple[Path, float]:
    """Return the run directory, and seconds of CPU time."""
    words = ["task=dynamic", *words, *_SIZE, f"train.iterations={steps}", "train.max_seconds=null"]
    words += ["train.eval_every=0", "renderer.threads=1", f"output_dir='{folder / scene}'"]
    start = time.process_time()
    return run(compose(words)), time.process_time() - start


def correlation(exported: np.ndarray, source: np.ndarray) -> float:
    """Return Pearson's correlation of (M, C) values."""
    a, b = exported - exported.mean(0), source - source.mean(0)
    return float((a * b).sum() / np.sqrt((a * a).sum() * (b * b).sum()))


def compare(files: tuple[Path, ...], frames: Iterator[Frame]) -> Record:
    """Compare exported files with the frames of the source."""
    parts: list[tuple[np.ndarray, ...]] = []
    for file, (density, velocity) in zip(files, frames, strict=True):
        box: Any = ((0, 0, 0), density.shape)
        found, moving = read_grid(file, "density").to_dense(box), read_grid(file, "vel").to_dense(box)
        inside = (density > 2e-3 * density.max()) & (density > 0) & (found > 0)
        parts.append((moving[inside], velocity[inside]))
    exported, source = (np.concatenate(x).astype(np.float64) for x in zip(*parts, strict=True))
    axes = [correlation(exported[:, [i]], source[:, [i]]) for i in range(3)]
    return {"voxels": len(source), "correlation": correlation(exported, source), "correlation_xyz": axes}


def blur(directory: Path, number: int, folder: Path) -> Record:
    """PSNR of motion blur in one frame, dB, with eight sub-frames and with one, against 32."""
    images: dict[int, list[torch.Tensor]] = {}
    for samples in (32, 8, 1):
        request = RenderRequest("orbit", format="npy", out=folder / f"blur_{samples}", frames=4, frame=str(number))
        request = replace(request, shutter=0.5, shutter_samples=samples)
        images[samples] = [torch.from_numpy(np.load(path)) for path in render_run(directory, request)]
    values = {n: min(psnr(a, b) for a, b in zip(images[n], images[32], strict=True)) for n in (8, 1)}
    return {"blur_psnr": values[8], "sharp_psnr": values[1]}


def find_errors(metrics: Record, channels: Sequence[str], extinction: str) -> dict[str, dict[str, list[float | None]]]:
    """Return grid -> error -> its values in the early, middle and late frames, from the metrics of a run."""
    keys = {extinction: extinction if f"{extinction}_frames" in metrics else "sigma", **{n: n for n in channels}}
    errors = ("relative_l2", "correlation")
    return {n: {e: [metrics[f"{key}_{e}_{third}"] for third in THIRDS] for e in errors} for n, key in keys.items()}


def measure(scene: str, folders: Mapping[str, Path | None], steps: int) -> Record:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        if scene == "smoke_fire":
            simulated = simulate_smoke("smoke_fire", FRAMES, RESOLUTION, 0, folder, lambda text, share: None)
            files = add_velocity(simulated, simulate(), folder / "files")
            channels = ["temperature", "flames", "velocity"]
            words, frames = ["scene.look=smoke_fire"], simulate()
        elif scene == "mantaflow":
            source = folders[scene]
            assert source is not None
            files, channels = rescale(source, folder / "files"), ["flame", "velocity"]
            words, frames = ["scene.grids.flames=flame", "model.init.window=1"], read_mantaflow(source)
        else:
            found = folders[scene]
            assert found is not None
            files, channels, words, frames = found, ["flames"], ["scene.frames=20:40"], None
        words += [f"scene.vdb='{files}'", f"scene.channels=[{','.join(channels)}]"]
        directory, seconds = train(scene, ["scene=vdb", *words], steps, folder)
        metrics = json.loads((directory / "metrics.json").read_text())
        extinction = "temperature" if scene == "embergen" else "density"
        row: Record = {"scene": scene, "steps": steps, "cpu_seconds": seconds, "model_bytes": metrics["model_bytes"]}
        row["grids"] = find_errors(metrics, channels, extinction)
        if frames is not None:
            report = export_run(directory, "vdb", folder / "export", ["velocity=true"])
            numbers = [frame.number for frame in list_vdb_files(folder / "export").frames]
            row |= {"vel": compare(report.files, frames), **blur(directory, numbers[len(numbers) // 2], folder)}
        return row


def table(record: Record) -> str:
    """Return the table of the errors; print motion blur, and the correlation of `vel` along each axis."""
    made = Table("scene", "grid", "relative error: early / middle / late", "correlation")
    for row in record["rows"]:
        for name, errors in row["grids"].items():
            made.row(row["scene"], f"`{name}`", *(_join(errors[key]) for key in ("relative_l2", "correlation")))
        if "vel" in row:
            made.row(row["scene"], "`vel`, from the motion of primitives", "", f"{row['vel']['correlation']:.2f}")
    for row in record["rows"]:
        if "vel" in row:
            axes = ", ".join(f"{x:.2f}" for x in row["vel"]["correlation_xyz"])
            blurred = f"blur {row['blur_psnr']:.1f} dB, sharp {row['sharp_psnr']:.1f} dB"
            print(f"{row['scene']}: vel along x, y, z {axes}; {blurred}")
    steps, cpu = record["rows"][0]["steps"], record["cpu"]
    return f"{made}\n\n{steps:,} steps of preset `quick` at 96×96 pixels, one seed; {cpu}."


def _join(values: Sequence[float | None]) -> str:
    return " / ".join("–" if value is None else f"{value:.2f}" for value in values)


def main() -> None:
    parser = make_parser(__doc__, "--record", "--print", "--docs", scenes=("smoke_fire", "mantaflow", "embergen"))
    parser.add_argument("--mantaflow", type=Path, help="a folder of Mantaflow's .vdb files")
    parser.add_argument("--embergen", type=Path, help="a folder of EmberGen's .vdb files")
    parser.add_argument("--steps", type=int, default=8000)
    args = parser.parse_args()
    folders = {"mantaflow": args.mantaflow, "embergen": args.embergen}
    if not args.only_print:
        require_folders(parser, args, args.scenes)

    def run_scenes() -> Record:
        torch.set_num_threads(1)
        return {"cpu": cpu_name(), "rows": [measure(scene, folders, args.steps) for scene in args.scenes]}

    publish(args, RECORD, "dynamic.md", "exported grids", run_scenes, table)


if __name__ == "__main__":
    main()
