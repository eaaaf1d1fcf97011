"""What a seam costs: sequences fitted in one run and in chunks of time, at the same views and primitives, judged by
held-out cameras.

    python benchmarks/chunks.py DIR            # measures, into benchmarks/results/chunks.json; runs stay below DIR, and
    what is recorded is kept python benchmarks/chunks.py DIR --fire VDB # with frames 1 to 40 of the EmberGen fire in
    the folder VDB, too python benchmarks/chunks.py --docs         # writes the table of docs/dynamic.md from that file,
    and measures nothing

The change from one frame to the next is the mean absolute difference of the two images, over that of the true ones; of
a seam the largest of the steps over which one chunk hands over to the next. Beside windows of 12 frames stand those of
0.3 of the sequence, however many frames that is.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from shared.tables import Table, between_markers

from neuprim.config import compose
from neuprim.core.compute.machine import cpu_name
from neuprim.runs.measure import draw
from neuprim.runs.open import load_dataset, load_run, read_metrics
from neuprim.runs.run import run
from neuprim.tasks.dynamic.density import TimeDensity
from neuprim.tasks.dynamic.judging import recording_of

RESULTS = Path(__file__).parent / "results" / "chunks.json"
PAGE = Path(__file__).parents[1] / "docs" / "dynamic.md"

FIRE, SMOKE = "EmberGen fire, frames 1–40, 96×96", "`smoke_fire` (simulated), 100 frames, 64×64"
LONG = "`smoke_fire` (simulated), 300 frames, 64×64"
SCENES = {
    FIRE: ["scene=vdb", "scene.frames=1:40", "scene.size=96"],
    SMOKE: ["scene=smoke_fire", "scene.size=64"],
    LONG: ["scene=smoke_fire", "scene.timesteps=300", "scene.size=64"],
}
NAMES = {FIRE: "fire", SMOKE: "smoke", LONG: "long"}
STEPS = {FIRE: 4000, SMOKE: 4000, LONG: 8000}
INTERVENTIONS = 20


@dataclass(frozen=True)
class Case:
    """A run: of a scene, in so many chunks, with so many primitives."""

    scene: str
    chunks: int
    primitives: int
    long_windows: bool = False

    @property
    def name(self) -> str:
        return f"{NAMES[self.scene]}-{self.chunks}-{self.primitives}{'-long' if self.long_windows else ''}"


CASES = (
    *(Case(FIRE, *pair) for pair in ((1, 5400), (2, 5400), (4, 5400), (4, 10800))),
    *(Case(SMOKE, *pair) for pair in ((1, 2700), (2, 2700), (4, 2700), (4, 5400))),
    Case(SMOKE, 1, 2700, long_windows=True),
    *(Case(LONG, *pair) for pair in ((1, 5400), (3, 5400), (6, 5400))),
    Case(LONG, 1, 5400, long_windows=True),
)


def words(case: Case, fire: Path | None, out: Path) -> list[str]:
    """Of the command line."""
    return [
        "task=dynamic", *SCENES[case.scene], *([f"scene.vdb='{fire}'"] if case.scene == FIRE else []),
        f"model.primitives={case.primitives}", f"train.iterations={STEPS[case.scene]}", f"train.population.every={STEPS[case.scene] // INTERVENTIONS}",
        *(["model.init.window_frames=null"] if case.long_windows else []),
        "train.eval_every=0", "renderer.threads=1", f"scene.chunks={case.chunks}", f"output_dir='{out}'", "resume=true",
    ]  # fmt: skip


def film(folder: Path) -> dict[str, float]:
    """Changes from frame to frame on held-out cameras, over the truth's: the largest over seams, and elsewhere; and
    primitives alive in a frame."""
    config, task, model, _ = load_run(folder)
    dataset = load_dataset(config, task, run_dir=folder)
    recording, density = recording_of(dataset), model.density
    assert recording is not None and isinstance(density, TimeDensity)
    times = [float(time) for time in recording.test.times]
    over, elsewhere, absolute = [0.0], [0.0], {True: [0.0], False: [0.0]}
    for camera in range(len(recording.test.cameras)):
        before: tuple[torch.Tensor, torch.Tensor] | None = None
        for number, time in enumerate(times):
            index = camera * len(times) + number
            image = draw(model, dataset.test.view(index), config.renderer, dataset.background)
            truth = dataset.test.pixels(index).over(dataset.background)
            if before is not None:
                change, true = (
                    float((now - then).abs().mean()) for now, then in zip((image, truth), before, strict=True)
                )
                seam = any(begin <= times[number - 1] and time <= end for begin, end in density.seams)
                (over if seam else elsewhere).append(change / true)
                absolute[seam].append(change)
            before = image, truth
    own = model.of(density)
    alive = [len(rows) for time in times if (rows := density.alive(own, {"time": torch.tensor(time)})) is not None]
    return {
        "change_seam": max(over),
        "change_elsewhere": max(elsewhere),
        "absolute_seam": max(absolute[True]),
        "absolute_elsewhere": max(absolute[False]),
        "alive": sum(alive) / len(alive),
    }


def measure(case: Case, fire: Path | None, folder: Path) -> dict[str, Any]:
    out = folder / case.name
    run(compose(words(case, fire, out)))
    metrics = read_metrics(out)
    names = (
        "psnr_mask",
        "psnr_pooled_mask",
        "sigma_relative_l2_early",
        "sigma_relative_l2_middle",
        "sigma_relative_l2_late",
        "train_seconds",
    )
    size = (out / "model.safetensors").stat().st_size
    return {**{name: metrics[name] for name in names}, **film(out), "bytes": size, "cpu": cpu_name()}


def table(found: dict[str, Any]) -> str:
    """For the page."""
    made = Table("", "chunks", "primitives", "alive in a frame", "inside the mask", "pooled", "σ, early / middle / late", "frame to frame, over the truth's: at a seam", "elsewhere")  # fmt: skip
    for case in CASES:
        own = found.get(case.name)
        if own is None:
            continue
        sigma = " / ".join(f"{own[f'sigma_relative_l2_{third}']:.2f}" for third in ("early", "middle", "late"))
        seam = f"{own['change_seam']:.2f}" if case.chunks > 1 else ""
        made.row(
            "windows of 0.3" if case.long_windows else case.scene if case.chunks == 1 else "", case.chunks, f"{case.primitives:,}", f"{own['alive']:,.0f}", f"{own['psnr_mask']:.2f} dB",
            f"{own['psnr_pooled_mask']:.2f} dB", sigma, seam, f"{own['change_elsewhere']:.2f}",
        )  # fmt: skip
    cpu = next(iter(found.values()))["cpu"]
    return (
        f"{made}\n\n{STEPS[FIRE]:,} views in all, {STEPS[LONG]:,} of the long sequence; one seed, one thread of {cpu}."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", metavar="DIR", help="for the runs")
    parser.add_argument("--fire", type=Path, metavar="VDB", help="folder of the EmberGen fire's frames")
    parser.add_argument(
        "--docs", action="store_true", help="write the table of the page from the results, and measure nothing"
    )
    args = parser.parse_args()
    found = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    if args.docs:
        between_markers(PAGE, "chunks", table(found))
        return
    if args.folder is None:
        parser.error("expected DIR, for the runs, or --docs")
    torch.set_num_threads(1)
    for case in CASES:
        if case.name in found or (case.scene == FIRE and args.fire is None):
            continue
        found[case.name] = own = measure(case, args.fire, args.folder)
        print(case.name, {name: round(value, 3) for name, value in own.items() if isinstance(value, float)}, flush=True)
        RESULTS.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    main()
