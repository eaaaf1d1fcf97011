"""Long sequences: what the memory of a run does with their length, and what two workers bring to ground truth.

    python benchmarks/sequence.py DIR          # DIR: a folder of .vdb frames; measures, into
    benchmarks/results/sequence.json python benchmarks/sequence.py --docs       # writes the tables of docs/dynamic.md
    and docs/launching.md from that file, and measures nothing

A long sequence is the real frames forwards and backwards, as often as needed, as links to them. Every number is of a
process of its own: the peak of its resident set, as the system has it (VmHWM), so on Linux alone. Both sides of a ratio
are measured in turns.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from shared.tables import between_markers

from neuprim.config import compose
from neuprim.config.launcher import LauncherSettings
from neuprim.core.compute.machine import cpu_name
from neuprim.core.compute.threads import core_count, sharing
from neuprim.core.io.vdb import sequence
from neuprim.runs.events import Event, Finishing, Step
from neuprim.runs.ground_truth import make_truth
from neuprim.runs.run import run

RESULTS = Path(__file__).parent / "results" / "sequence.json"
DOCS = Path(__file__).parents[1] / "docs"
PARTS = ("memory", "simulation", "speed", "together")
LENGTHS = (40, 200, 1000)
MEMORY = 64
IMAGES = ["scene.size=32", "scene.cameras=6", "scene.samples=1", f"scene.memory={MEMORY}"]
SPEED = ["scene.size=96", "scene.cameras=40", "scene.samples=2"]


def long_sequence(source: Path, count: int, folder: Path) -> Path:
    """A folder with ``count`` links to the frames of another, there and back again."""
    frames = [frame.path.resolve() for frame in sequence(source).frames]
    around = [*frames, *frames[-2:0:-1]]
    made = folder / f"{count}_frames"
    made.mkdir()
    for number in range(count):
        (made / f"frame_{number}.vdb").symlink_to(around[number % len(around)])
    return made


def peak() -> int:
    """Bytes of the resident set of this process at its peak."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith("VmHWM:"):
            return int(line.split()[1]) * 1024
    raise SystemExit("this system does not tell the peak of a process's memory; Linux does")


def child(what: str, words: list[str]) -> dict[str, float]:
    """Make the ground truth, or train, in this process; peaks and seconds."""
    config, found = compose(words), {"modules": peak() / 2**20}
    begun = time.perf_counter()
    with sharing(1):
        if what.startswith("truth"):
            workers = int(what.removeprefix("truth") or 0)
            make_truth(
                config, LauncherSettings("processes", workers=workers, threads=1) if workers else LauncherSettings()
            )
        else:
            steps: list[float] = []

            def hear(event: Event) -> None:
                if isinstance(event, Step):
                    steps.append(time.perf_counter())
                elif isinstance(event, Finishing):
                    found["training"] = peak() / 2**20

            run(config, hear)
            found["ms_a_step"] = statistics.median(b - a for a, b in itertools.pairwise(steps)) * 1000
    return {**found, "peak": peak() / 2**20, "seconds": time.perf_counter() - begun}


def apart(what: str, words: list[str]) -> dict[str, float]:
    """The same in a process of its own."""
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    command = [sys.executable, __file__, "--child", what, *words]
    return json.loads(
        subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True, text=True).stdout.splitlines()[-1]
    )


def memory(scene: list[str], folder: Path, steps: int) -> dict[str, Any]:
    """Of making the ground truth of a scene, and of a training with it."""
    words = ["task=dynamic", *scene, *IMAGES, f"scene.cache='{folder / 'cache'}'"]
    truth = apart("truth", [*words, f"output_dir='{folder / 'none'}'"])
    budget = [f"train.iterations={steps}", "model.primitives=2000", f"output_dir='{folder / 'run'}'"]
    found = {"truth": truth, "run": apart("run", [*words, *budget])}
    shutil.rmtree(folder)
    return found


def speed(source: Path, frames: int, rounds: int) -> list[dict[str, float]]:
    """Seconds with one worker and with two, in turns; starting them included."""
    pairs = []
    for number in range(rounds):
        pair: dict[str, float] = {}
        for workers in (1, 2) if number % 2 == 0 else (2, 1):
            with tempfile.TemporaryDirectory() as folder:
                made = long_sequence(source, frames, Path(folder))
                words = [
                    "task=dynamic",
                    "scene=vdb",
                    f"scene.vdb='{made}'",
                    *SPEED,
                    f"scene.cache='{folder}/cache'",
                    f"output_dir='{folder}/out'",
                ]
                begun = time.perf_counter()
                make_truth(compose(words), LauncherSettings("processes", workers=workers, threads=1))
                pair[str(workers)] = time.perf_counter() - begun
        pairs.append(pair)
        print(
            f"round {number + 1}: {pair['1']:.1f} s with one worker, {pair['2']:.1f} s with two",
            file=sys.stderr,
            flush=True,
        )
    return pairs


def together(source: Path, frames: int, rounds: int) -> list[float]:
    """Frames that two workers make for each that one makes beside them, from their start until the two are done;
    whatever else the machine does, it does beside both."""
    found = []
    for number in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            made = long_sequence(source, frames, Path(folder))
            scene = ["task=dynamic", "scene=vdb", f"scene.vdb='{made}'", *SPEED]
            one, two = (
                subprocess.Popen(
                    [
                        sys.executable,
                        __file__,
                        "--child",
                        f"truth{n}",
                        *scene,
                        f"scene.cache='{folder}/{n}'",
                        f"output_dir='{folder}/out/{n}'",
                    ],
                    stdout=subprocess.DEVNULL,
                )
                for n in (1, 2)
            )
            if two.wait():
                raise SystemExit("ground truth cannot be made")
            found.append(frames / len(list(Path(folder, "1").glob("volumes/*/frame_*/points.npz"))))
            one.send_signal(signal.SIGINT)
            one.wait()
        print(f"round {number + 1}: {found[-1]:.2f} frames of two workers for one of one", file=sys.stderr, flush=True)
    return found


def measure(args: argparse.Namespace) -> dict[str, Any]:
    """Everything, or the parts asked for beside what was measured before."""
    found: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.exists() else {}
    found |= {"cpu": cpu_name(), "cores": core_count(), "memory": MEMORY}
    if {"memory", "simulation"} & set(args.parts):  # kernels are compiled, which takes memory
        with tempfile.TemporaryDirectory() as folder:
            memory(
                ["scene=vdb", f"scene.vdb='{args.folder.resolve()}'", "scene.frames='1:3'"], Path(folder) / "work", 5
            )
    if "memory" in args.parts:
        found |= {"steps": args.steps, "frames": {}}
        for count in LENGTHS:
            with tempfile.TemporaryDirectory() as folder:
                made = long_sequence(args.folder, count, Path(folder))
                found["frames"][str(count)] = memory(
                    ["scene=vdb", f"scene.vdb='{made}'"], Path(folder) / "work", args.steps
                )
            print(count, found["frames"][str(count)], file=sys.stderr, flush=True)
    if "simulation" in args.parts:
        for count in (40, 300):
            with tempfile.TemporaryDirectory() as folder:
                scene = ["scene=smoke_fire", f"scene.timesteps={count}", "scene.resolution=32"]
                found.setdefault("simulated", {})[str(count)] = memory(scene, Path(folder) / "work", args.steps)
            print(f"simulated {count}", found["simulated"][str(count)], file=sys.stderr, flush=True)
    if "speed" in args.parts:
        found |= {"speed_frames": args.frames, "speed": speed(args.folder, args.frames, args.rounds)}
    if "together" in args.parts:
        found["together"] = together(args.folder, args.frames, args.rounds)
    return found


def tables(found: dict[str, Any]) -> dict[str, str]:
    """Page and marker -> text."""
    lines = [
        "| frames | ground truth, peak | run, peak while training | run, peak in all | ms a step |",
        "| --- | --- | --- | --- | --- |",
    ]
    rows = [(f"{int(n):,}", row) for n, row in found["frames"].items()] + [
        (f"{n}, simulated", row) for n, row in found["simulated"].items()
    ]
    for name, row in rows:
        made, ran = row["truth"], row["run"]
        lines.append(
            f"| {name} | {made['peak']:.0f} MiB | {ran['training']:.0f} MiB | {ran['peak']:.0f} MiB | {ran['ms_a_step']:.1f} |"
        )
    modules = next(iter(found["frames"].values()))["truth"]["modules"]
    text = (
        "\n".join(lines)
        + f"\n\nPeaks of a process's resident set, {modules:.0f} MiB of which are Python, torch and the rest of the modules; `scene.size=32 scene.cameras=6 "
        f"scene.memory={found['memory']}`, 2,000 primitives, {found['steps']:,} steps, one thread of {found['cpu']}, which other work shared: times tell little."
    )
    one, two = (statistics.median(pair[n] for pair in found["speed"]) for n in ("1", "2"))
    ratios = sorted(pair["1"] / pair["2"] for pair in found["speed"])
    beside = sorted(found["together"])
    fast = (
        f"| {found['speed_frames']} frames, 40 cameras, 96×96, one thread each | seconds | times as fast |\n| --- | --- | --- |\n"
        f"| `launcher.workers=1` | {one:.0f} | 1 |\n| `launcher.workers=2` | {two:.0f} | {statistics.median(ratios):.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f}) |\n\n"
        f"On {found['cores']} cores of {found['cpu']}, measured in turns, {len(ratios)} rounds, starting processes included. Where one worker and two are at work at the same time, and "
        f"whatever else the machine does meets all three, two made {statistics.median(beside):.2f} frames ({beside[0]:.2f} to {beside[-1]:.2f} in {len(beside)} rounds) for each of the one."
    )
    return {"dynamic.md sequence": text, "launching.md truth": fast}


def main() -> None:
    if sys.argv[1:2] == ["--child"]:
        print(json.dumps(child(sys.argv[2], sys.argv[3:])))
        return
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="?", help="a sequence of .vdb files")
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=PARTS)
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--frames", type=int, default=80, help="whose ground truth is timed")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--docs", action="store_true", help="write the tables of the pages from the results")
    args = parser.parse_args()
    if args.folder:
        RESULTS.write_text(json.dumps(measure(args), indent=1) + "\n")
    for place, text in tables(json.loads(RESULTS.read_text())).items():
        print(text, end="\n\n")
        if args.docs:
            page, marker = place.split()
            between_markers(DOCS / page, marker, text)


if __name__ == "__main__":
    main()
