"""Two ranks of one thread against one process of two threads and of one: views per second.

    python benchmarks/ranks.py [--parts pace steps] [--scenes solids smoke_fire lit_solids large] [--rounds 15]
    [--seconds 0.5] [--docs] [--print]

Both ranks of a torchrun hold the same trainer, in the middle of its budget, with a fixed population. They train in
turns: together; the first one alone with the same views a step, on two threads and on one; and alone with one view a
step. So all meet the same noise of a shared machine, and the ratios are medians of those of each round, and ratios of
the fastest turns. `steps` trains with as many views in fewer, larger steps.
Results go to benchmarks/results/ranks.json; --docs puts the tables between the markers of docs/scaling.md, --print only
prints what was recorded.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from shared.tables import ROOT, Table, between_markers, spread

RESULTS, PAGE = Path(__file__).parent / "results" / "ranks.json", ROOT / "docs" / "scaling.md"
SCENES = {
    "solids": ("task=static", "scene=solids"),
    "smoke_fire": ("task=dynamic", "scene=smoke_fire", "scene.size=64"),
    "lit_solids": ("task=relight", "scene=lit_solids", "scene.size=128"),
    "large": ("task=static", "scene=solids", "scene.size=400", "model.primitives=20000"),
}
TITLES = {"large": "`solids`, more primitives"}
WAYS = {
    "together": "2 ranks × 1 thread",
    "two threads": "1 process × 2 threads",
    "one thread": "1 process × 1 thread",
    "single view": "1 process × 2 threads, a view a step",
}


BUDGET, VIEWS = ("task=static", "scene=solids", "scene.size=128", "model.primitives=1500"), 2400


def trainers(scene: str, group: Any) -> dict[str, Any]:
    """The same training in every way; on ranks but the first only what they take part in."""
    from neuprim.config import compose
    from neuprim.runs.fit import prepare_training
    from neuprim.runs.training import compile_for_run

    words = [*SCENES[scene], "train.population.strategy=fixed", "train.population.grow_from=1", "seed=0"]
    made: dict[str, Any] = {}
    dataset = None
    for way in WAYS if group.is_first else ("together",):
        config = compose(words, check_output=False)
        views = 2 if way in ("two threads", "one thread") else 1
        config = replace(config, train=replace(config.train, views_per_step=views))
        config = replace(
            config,
            renderer=replace(config.renderer, device="cpu", threads=1 if way in ("together", "one thread") else 2),
        )
        fitted = prepare_training(config, dataset=dataset, group=group if way == "together" else None)
        dataset = fitted.dataset
        trainer = fitted.trainer
        compile_for_run(trainer)
        trainer.step = (trainer.settings.iterations or 0) // 2
        made[way] = trainer
    return made


def measure(scene: str, rounds: int, seconds: float, group: Any) -> dict[str, Any]:
    """Seconds per view of every way and round, by the first rank's clock."""
    from neuprim.runs.fit import use_one_torch_thread

    with group.in_turn():
        made = trainers(scene, group)

    def turn(way: str, steps: int) -> tuple[float, float]:
        """Seconds of a step, by the clock and of processors that this process used."""
        begun, used = time.perf_counter(), time.process_time()
        for _ in range(steps):
            made[way].train_step()
        return (time.perf_counter() - begun) / steps, (time.process_time() - used) / steps

    with use_one_torch_thread():
        for way in made:
            turn(way, 10)
        steps = group.gather(max(round(seconds / turn("together", 10)[0]), 4))[0]
        times: dict[str, list[float]] = {way: [] for way in WAYS}
        used: dict[str, list[float]] = {way: [] for way in WAYS}
        for _ in range(rounds):
            for way in WAYS:
                if way in made:
                    if way == "together":
                        group.gather(None)  # the others have waited for the first rank's turns
                    took, worked = turn(way, steps)
                    times[way].append(took / (1 if way == "single view" else 2))
                    used[way].append(
                        worked / (1 if way in ("single view", "together") else 2)
                    )  # a rank works for one view a step
    trainer = made["together"]
    view = trainer.dataset.train.view(0).camera
    numbers = sum(value.numel() for value in trainer.model.params.values())
    return {
        "scene": scene, "size": [view.width, view.height], "primitives": trainer.model.count, "numbers": numbers,
        "steps": steps, "seconds": times, "processor": used,
    }  # fmt: skip


def worker(scenes: list[str], rounds: int, seconds: float, out: Path) -> None:
    """What each process of the torchrun does."""
    from neuprim.core.train.distributed.process_group import ProcessGroup
    from neuprim.core.train.distributed.torchrun import read_torchrun_rank

    place = read_torchrun_rank()
    assert place is not None and place.size == 2
    group = ProcessGroup(place, os.environ)
    for scene in scenes:
        found = measure(scene, rounds, seconds, group)
        if group.is_first:
            record = json.loads(out.read_text()) if out.exists() else {}
            record[scene] = found
            out.write_text(json.dumps(record, indent=1) + "\n")
    group.close()


def table(record: dict[str, Any]) -> str:
    rows = Table(
        "scene", "image", "primitives", "views/s of 2 ranks × 1 thread", "over 1 process × 2 threads, 2 views a step", "over the same, 1 view a step",
        "over 1 process × 1 thread, 2 views", "processor time of a view, over 1 process × 2 threads", "bytes a step sends",
    )  # fmt: skip
    for scene, found in record["scenes"].items():
        times = found["seconds"]

        def ratio(way: str, times: dict[str, list[float]] = times) -> str:
            middle = statistics.median(other / own for own, other in zip(times["together"], times[way], strict=True))
            return f"{middle:.2f}; {min(times[way]) / min(times['together']):.2f}"

        work = statistics.median(
            a / b for a, b in zip(found["processor"]["together"], found["processor"]["two threads"], strict=True)
        )
        width, height = found["size"]
        formula = 4 * (found["numbers"] + 2 * found["primitives"])
        rows.row(
            TITLES.get(scene, f"`{scene}`"), f"{width}×{height}", f"{found['primitives']:,}", f"{1 / statistics.median(times['together']):.1f}",
            ratio("two threads"), ratio("single view"), ratio("one thread"), f"{work:.2f}", f"{formula:,} B",
        )  # fmt: skip
    note = f"Each ratio: median of {record['rounds']} rounds; of the fastest turns. {record['cpu']}, {record['cores']} cores that other work shared."
    return f"{rows}\n\n{note}"


def larger_steps(seeds: int) -> dict[str, Any]:
    """PSNR on the test views after as many views in fewer, larger steps, by one process: several ranks train the
    same."""
    from neuprim.config import compose
    from neuprim.runs.fit import fit

    found: dict[str, Any] = {"words": list(BUDGET), "views": VIEWS, "psnr": {}}
    for views in (1, 2, 4, 8):
        words = [
            *BUDGET,
            f"train.iterations={VIEWS // views}",
            f"train.views_per_step={views}",
            f"train.population.every={200 // views}",
        ]
        runs = [fit(compose([*words, f"seed={seed}"], check_output=False)).metrics()["psnr"] for seed in range(seeds)]
        found["psnr"][str(views)] = runs
        print(f"{views} views a step: {spread(runs, 2)} dB", flush=True)
    return found


def table_of_steps(found: dict[str, Any]) -> str:
    rows = Table("views a step, of all ranks together", "steps", "PSNR")
    for views, values in found["psnr"].items():
        rows.row(views, f"{found['views'] // int(views):,}", f"{spread(values, 2)} dB")
    seeds = len(next(iter(found["psnr"].values())))
    return (
        f"{rows}\n\n`neuprim run {' '.join(found['words'])}`, {found['views']:,} views in all, rates as for one view a step, means of {seeds} seeds "
        "± half the spread."
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--scenes", nargs="+", default=list(SCENES), choices=list(SCENES))
    parser.add_argument("--rounds", type=int, default=15)
    parser.add_argument("--seconds", type=float, default=0.5, help="of a turn")
    parser.add_argument("--seeds", type=int, default=2, help="of the training with larger steps")
    parser.add_argument("--parts", nargs="+", default=["pace", "steps"], choices=["pace", "steps"])
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true")
    parser.add_argument("--worker", type=Path, metavar="OUT", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker is not None:
        worker(args.scenes, args.rounds, args.seconds, args.worker)
        return
    from neuprim.core.compute.threads import core_count, cpu_name

    record = json.loads(RESULTS.read_text()) if RESULTS.exists() else {"scenes": {}}
    if "pace" in args.parts and not args.print:
        out = RESULTS.with_suffix(".part")
        out.unlink(missing_ok=True)
        more = [
            "--scenes",
            *args.scenes,
            "--rounds",
            str(args.rounds),
            "--seconds",
            str(args.seconds),
            "--worker",
            str(out),
        ]
        subprocess.run(
            [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", __file__, *more], check=True
        )
        record |= {
            "cpu": cpu_name(),
            "cores": core_count(),
            "rounds": args.rounds,
            "scenes": {**record["scenes"], **json.loads(out.read_text())},
        }
        out.unlink()
    if "steps" in args.parts and not args.print:
        record["larger steps"] = larger_steps(args.seeds)
    if not args.print:
        RESULTS.write_text(json.dumps(record, indent=1) + "\n")
    tables = {"ranks": table(record)} if record["scenes"] else {}
    if "larger steps" in record:
        tables["larger-steps"] = table_of_steps(record["larger steps"])
    for name, text in tables.items():
        if args.docs:
            between_markers(PAGE, name, text)


if __name__ == "__main__":
    main()
