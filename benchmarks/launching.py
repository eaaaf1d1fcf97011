"""What launchers cost and bring: eight one-thread runs in two processes against one after the other, and what Ray adds
to a run.

    python benchmarks/launching.py            # measures, into benchmarks/results/launching.json
    python benchmarks/launching.py --docs     # writes the table of docs/launching.md from that file, and measures
    nothing

Both sides of a ratio are measured in turns, so that they meet the same noise of the machine.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

from shared.tables import between_markers

from neuprim.config import compose_all
from neuprim.config.launcher import LauncherSettings
from neuprim.core.compute.machine import cpu_name
from neuprim.core.compute.threads import core_count
from neuprim.runs.launch.jobs import Job
from neuprim.runs.launch.table import launch
from neuprim.runs.sweep.one import job_of

RESULTS = Path(__file__).parent / "results" / "launching.json"
PAGE = Path(__file__).parents[1] / "docs" / "launching.md"
WORDS = [
    "task=static",
    "scene=solids",
    "scene.size=128",
    "scene.train_views=40",
    "scene.test_views=8",
    "model.primitives=1000",
]


def nothing(data: None, attempt: int, events: object) -> float:
    """A job that is done at once; when it was."""
    return time.time()


def seconds(settings: LauncherSettings, runs: int, steps: int) -> float:
    """Of a whole launch, beginning and ending workers included."""
    with tempfile.TemporaryDirectory() as folder:
        seeds = "seed=" + ",".join(map(str, range(runs)))
        configs = compose_all([*WORDS, f"train.iterations={steps}", seeds, f"output_dir='{folder}/sweep'"])
        begun = time.perf_counter()
        results = launch([job_of(config) for config in configs], settings, Path(folder) / "launch")
        took = time.perf_counter() - begun
    if not all(result is not None and result.state == "done" for result in results):
        raise SystemExit(f"a run failed: {[result and result.line for result in results]}")
    return took


def overhead_of_ray(runs: int, steps: int) -> dict[str, float]:
    """Seconds that a run takes in Ray beyond those of its own, once Ray and its worker are there; and those of
    beginning."""
    import ray

    begun = time.perf_counter()
    ray.init(num_cpus=core_count(), include_dashboard=False, log_to_driver=False, logging_level="error")
    settings = LauncherSettings("ray", workers=1, threads=1)
    with tempfile.TemporaryDirectory() as folder:
        warm = [Job("warm", f"{__name__}:{nothing.__name__}", None)]
        launch(warm, settings, Path(folder) / "launch")
        start = time.perf_counter() - begun
        seeds = "seed=" + ",".join(map(str, range(runs)))
        configs = compose_all([*WORDS, f"train.iterations={steps}", seeds, f"output_dir='{folder}/sweep'"])
        begun = time.perf_counter()
        results = launch([job_of(config) for config in configs], settings, Path(folder) / "launch")
        took = time.perf_counter() - begun
    ray.shutdown()
    return {"start": start, "per_run": (took - sum(result.seconds for result in results if result is not None)) / runs}


def measure(runs: int, steps: int, rounds: int) -> dict[str, Any]:
    """Everything."""
    seconds(LauncherSettings("inline", threads=1), 1, 2)  # data and kernels are there
    pairs = []
    for number in range(rounds):
        pair = {
            "inline": seconds(LauncherSettings("inline", threads=1), runs, steps),
            "processes": seconds(LauncherSettings("processes", workers=2, threads=1), runs, steps),
        }
        pairs.append(pair)
        print(
            f"round {number + 1}: {pair['inline']:.1f} s inline, {pair['processes']:.1f} s in two processes", flush=True
        )
    found: dict[str, Any] = {"runs": runs, "steps": steps, "rounds": pairs, "cpu": cpu_name(), "cores": core_count()}
    try:
        found["ray"] = overhead_of_ray(4, steps)
    except ImportError:
        print("Ray is not installed: pip install 'neuprim[ray]'")
    return found


def table(found: dict[str, Any]) -> str:
    """For the page."""
    inline, processes = (statistics.median(pair[name] for pair in found["rounds"]) for name in ("inline", "processes"))
    ratio = statistics.median(pair["inline"] / pair["processes"] for pair in found["rounds"])
    lines = [
        f"| {found['runs']} runs of {found['steps']:,} steps, one thread each | seconds | times as fast |",
        "| --- | --- | --- |",
        f"| `launcher=inline` | {inline:.0f} | 1 |",
        f"| `launcher=processes launcher.workers=2` | {processes:.0f} | {ratio:.2f} |",
    ]
    ray = ""
    if "ray" in found:
        ray = f" Ray takes {found['ray']['start']:.0f} s to begin, and then {found['ray']['per_run']:.1f} s per run beyond the run's own."
    cores = f"{found['cores']} cores of {found['cpu']}"
    return (
        "\n".join(lines)
        + f"\n\nOn {cores}, measured in turns, {len(found['rounds'])} rounds; data loading, measuring and starting processes included.{ray}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--runs", type=int, default=8)
    parser.add_argument("--steps", type=int, default=3000)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument(
        "--docs", action="store_true", help="write the table of the page from the results, and measure nothing"
    )
    args = parser.parse_args()
    if not args.docs:
        RESULTS.write_text(json.dumps(measure(args.runs, args.steps, args.rounds), indent=1) + "\n")
    text = table(json.loads(RESULTS.read_text()))
    print(text)
    if args.docs:
        between_markers(PAGE, "launching", text)


if __name__ == "__main__":
    main()
