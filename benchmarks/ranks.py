"""Two ranks of one thread against one process of two threads and of one: views per second.

    python benchmarks/ranks.py [--parts pace steps] [--scenes solids smoke_fire lit_solids large] [--rounds 15]
    [--seconds 0.5] [--docs] [--print]

Both ranks of a torchrun hold the same trainer, in the middle of its budget, with a fixed population. They train in
turns: together; the first one alone with the same views a step, on two threads and on one; and alone with one view a
step. So all meet the same noise of a shared machine, and the ratios are medians of those of each round, and ratios of
the fastest turns. `steps` trains with as many views in fewer, larger steps.
Results go to benchmarks/results/ranks.json; --docs puts the tables between the markers of docs/results/performance.md,
--print only prints what was recorded.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

from shared.arguments import make_parser
from shared.tables import RESULT_PAGES, RESULTS, Record, between_markers, make_table, read_record, spread, update_record

from neuprim.config import compose
from neuprim.core.compute.threads import core_count, cpu_name
from neuprim.core.train.process_group import ProcessGroup, read_torchrun_rank
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import compile_run_kernels, fit, prepare_training, use_one_torch_thread_for_run

RECORD = RESULTS / "ranks.json"
SCENES = {
    "solids": ("task=static", "scene=solids", "scene.size=200"),
    "smoke_fire": ("task=dynamic", "scene=smoke_fire", "scene.size=64"),
    "lit_solids": ("task=relight", "scene=lit_solids", "scene.size=128"),
    "large": ("task=static", "scene=solids", "scene.size=400", "model.primitives=20000"),
}
WAYS = {"together": (1, 1), "two threads": (2, 2), "one thread": (2, 1), "single view": (1, 2)}
"""Views a step of a process, and its threads; ``together`` two ranks work."""
BUDGET, VIEWS = ("task=static", "scene=solids", "scene.size=128", "model.primitives=1500"), 2400


def make_trainers(scene: str, group: ProcessGroup) -> dict[str, Trainer]:
    """The same training in every way; on ranks but the first only what they take part in."""
    words = [*SCENES[scene], "train.population.strategy=fixed", "train.population.grow_from=1", "seed=0"]
    config, made, dataset = compose(words, check_output=False), {}, None
    for way in WAYS if group.is_first else ("together",):
        views, threads = WAYS[way]
        own = replace(config, train=replace(config.train, views_per_step=views))
        own = replace(own, renderer=replace(config.renderer, device="cpu", threads=threads))
        fitted = prepare_training(own, dataset=dataset, group=group if way == "together" else None)
        dataset = fitted.dataset
        compile_run_kernels(fitted.trainer)
        fitted.trainer.step = (fitted.trainer.settings.iterations or 0) // 2
        made[way] = fitted.trainer
    return made


def measure(scene: str, args: argparse.Namespace, group: ProcessGroup) -> Record:
    """Seconds per view of every way and round, by the first rank's clock."""
    with group.in_turn():
        trainers = make_trainers(scene, group)

    def run_steps(way: str, steps: int) -> tuple[float, float]:
        """Seconds of a step, by the clock and of cores that this process used."""
        begun, used = time.perf_counter(), time.process_time()
        for _ in range(steps):
            trainers[way].train_step()
        return (time.perf_counter() - begun) / steps, (time.process_time() - used) / steps

    with use_one_torch_thread_for_run():
        for way in trainers:
            run_steps(way, 10)
        steps = group.gather(max(round(args.seconds / run_steps("together", 10)[0]), 4))[0]
        times: dict[str, list[float]] = {way: [] for way in WAYS}
        used: dict[str, list[float]] = {way: [] for way in WAYS}
        for _ in range(args.rounds):
            for way in trainers:
                if way == "together":
                    group.gather(None)  # the others have waited for the first rank's turns
                took, worked = run_steps(way, steps)
                views = WAYS[way][0]
                times[way].append(took / (2 if way == "together" else views))
                used[way].append(worked / views)  # a rank works for one view a step
    trainer = trainers["together"]
    view = trainer.dataset.train.view(0).camera
    numbers = sum(value.numel() for value in trainer.model.params.values())
    return {
        "scene": scene,
        "size": [view.width, view.height],
        "primitives": trainer.model.count,
        "numbers": numbers,
        "steps": steps,
        "seconds": times,
        "processor": used,
    }


def work_as_rank(args: argparse.Namespace) -> None:
    """What each process of the torchrun does."""
    place = read_torchrun_rank()
    assert place is not None and place.size == 2
    group = ProcessGroup(place, os.environ)
    for scene in args.scenes:
        found = measure(scene, args, group)
        if group.is_first:
            update_record(args.worker, **{scene: found})
    group.close()


def measure_pace(args: argparse.Namespace) -> None:
    """Start the two ranks and record what they find."""
    out = RECORD.with_suffix(".part")
    out.unlink(missing_ok=True)
    options = ["--rounds", str(args.rounds), "--seconds", str(args.seconds), "--scenes", *args.scenes]
    launcher = [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2"]
    subprocess.run([*launcher, __file__, "--worker", str(out), *options], check=True)
    scenes = {**read_record(RECORD).get("scenes", {}), **read_record(out)}
    update_record(RECORD, cpu=cpu_name(), cores=core_count(), rounds=args.rounds, scenes=scenes)
    out.unlink()


def measure_larger_steps(seeds: int) -> Record:
    """PSNR on the test views after as many views in fewer, larger steps, by one process: several ranks train the
    same."""
    found: dict[str, list[float]] = {}
    for views in (1, 2, 4, 8):
        words = [*BUDGET, f"train.iterations={VIEWS // views}", f"train.views_per_step={views}"]
        words.append(f"train.population.every={200 // views}")
        runs = [fit(compose([*words, f"seed={seed}"], check_output=False)).metrics()["psnr"] for seed in range(seeds)]
        found[str(views)] = runs
    return {"words": list(BUDGET), "views": VIEWS, "psnr": found}


def pace_table(record: Record) -> str:
    def ratio(scene: Record, way: str) -> str:
        own, other = scene["seconds"]["together"], scene["seconds"][way]
        middle = statistics.median(b / a for a, b in zip(own, other, strict=True))
        return f"{middle:.2f}; {min(other) / min(own):.2f}"

    def work(scene: Record) -> str:
        own, other = scene["processor"]["together"], scene["processor"]["two threads"]
        return f"{statistics.median(a / b for a, b in zip(own, other, strict=True)):.2f}"

    columns = {
        "scene": lambda one: "`solids`, more primitives" if one["scene"] == "large" else f"`{one['scene']}`",
        "image": lambda one: "×".join(map(str, one["size"])),
        "primitives": lambda one: f"{one['primitives']:,}",
        "views/s of 2 ranks × 1 thread": lambda one: f"{1 / statistics.median(one['seconds']['together']):.1f}",
        "over 1 process × 2 threads, 2 views a step": lambda one: ratio(one, "two threads"),
        "over the same, 1 view a step": lambda one: ratio(one, "single view"),
        "over 1 process × 1 thread, 2 views": lambda one: ratio(one, "one thread"),
        "processor time of a view, over 1 process × 2 threads": work,
        "bytes a step sends": lambda one: f"{4 * (one['numbers'] + 2 * one['primitives']):,} B",
    }
    table = make_table(columns, record["scenes"].values())
    return (
        f"{table}\n\nEach ratio: median of {record['rounds']} rounds; of the fastest turns. {record['cpu']}, "
        f"{record['cores']} cores that other work shared."
    )


def steps_table(found: Record) -> str:
    columns = {
        "views a step, of all ranks together": lambda row: row[0],
        "steps": lambda row: f"{found['views'] // int(row[0]):,}",
        "PSNR": lambda row: f"{spread(row[1], 2)} dB",
    }
    table = make_table(columns, found["psnr"].items())
    seeds = len(next(iter(found["psnr"].values())))
    return (
        f"{table}\n\n`neuprim run {' '.join(found['words'])}`, {found['views']:,} views in all, with the learning "
        f"rates of one view a step, means of {seeds} seeds ± half the spread."
    )


def main() -> None:
    parser = make_parser(__doc__, "--rounds", "--seeds", "--docs", "--print", scenes=SCENES)
    parser.set_defaults(rounds=15, seeds=2)
    parser.add_argument("--seconds", type=float, default=0.5, help="of a turn")
    parser.add_argument("--parts", nargs="+", default=["pace", "steps"], choices=["pace", "steps"])
    parser.add_argument("--worker", type=Path, metavar="OUT", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker is not None:
        work_as_rank(args)
        return
    if "pace" in args.parts and not args.only_print:
        measure_pace(args)
    if "steps" in args.parts and not args.only_print:
        update_record(RECORD, **{"larger steps": measure_larger_steps(args.seeds)})
    record = read_record(RECORD)
    for name, text in (("ranks", pace_table(record)), ("larger-steps", steps_table(record["larger steps"]))):
        if args.docs:
            between_markers(RESULT_PAGES / "performance.md", name, text)


if __name__ == "__main__":
    main()
