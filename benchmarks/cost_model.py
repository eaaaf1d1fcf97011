"""What a training step costs, as a sum of a few terms that are fitted to measured times; and what that says about
scenes that were never trained.

    python benchmarks/cost_model.py [--rounds 5] [--docs] [--print]

Two ranks of a torchrun measure at the same time, each on one thread: steps of random scenes of many sizes, by turns;
Adam's step alone; ground truth of volumes; and exchanges of many sizes: in seconds of the processor, which other work
on a shared machine is not in. Non-negative least squares of relative errors gives a coefficient for each term. What is
judged was not fitted:
other scenes alone, by two ranks, and by two ranks with half of the primitives each. Then two scenes on paper: a long
sequence and a city, here and, by the times that benchmarks/gpu.py recorded, on a card. Results go to
benchmarks/results/cost_model.json; --docs puts the tables into docs/scaling.md, and --print only prints what was
recorded.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import nnls
from shared.paper_scenes import table_of_scenes
from shared.tables import ROOT, Table, between_markers

RESULTS, PAGE = Path(__file__).parent / "results" / "cost_model.json", ROOT / "docs" / "scaling.md"

# primitives, image, overlap, degree of the colours
FITTED = (
    (1000, 64, 10, 3), (1000, 200, 30, 3), (1000, 400, 10, 0), (4000, 100, 30, 0), (4000, 200, 10, 3), (4000, 400, 30, 3), (10_000, 64, 10, 0),
    (10_000, 100, 100, 3), (10_000, 300, 10, 3), (30_000, 64, 30, 3), (30_000, 200, 10, 0), (100_000, 64, 10, 3), (100_000, 100, 30, 0), (2000, 300, 100, 3),
)  # fmt: skip
JUDGED = ((20_000, 250, 20, 3), (60_000, 128, 20, 3), (3000, 320, 50, 3))
LOOKED_AT = tuple(point for point in FITTED if point[0] >= 10_000)
VOLUMES, JUDGED_VOLUME = ((32, 64), (48, 128), (64, 64), (64, 192), (96, 96), (128, 64)), (160, 128)
"""Voxels along a side, and the image's edge."""
EXCHANGED = (1 << 10, 1 << 14, 1 << 18, 1 << 20, 1 << 22, 1 << 24)
"""Bytes that each of two ranks sends."""

TERMS = ("a step", "a primitive", "a number of a primitive", "a pixel", "a tile's entry", "an ellipsoid over a pixel")


def features(point: dict[str, Any]) -> list[float]:
    """How often a step has each term; Adam's part is apart."""
    return [
        1.0,
        point["primitives"],
        point["numbers"],
        point["pixels"],
        point["pairs"],
        point["overlap"] * point["pixels"],
    ]


def fitted(rows: list[list[float]], seconds: list[float]) -> list[float]:
    """Coefficients, none negative, with the least squares of relative errors."""
    A, t = np.array(rows), np.array(seconds)
    scale = A.max(0)
    return [float(x) for x in nnls(A / scale / t[:, None], np.ones(len(t)))[0] / scale]


# ------------------------------------------------------------ measuring


def timed(work: Callable[[], object], least: float = 0.04) -> float:
    """Seconds that a call keeps this process's processor busy, of as many calls as take a while: other work on the
    machine is not in it."""
    start, used, count = time.perf_counter(), time.process_time(), 0
    while time.perf_counter() - start < least or not count:
        work()
        count += 1
    return (time.process_time() - used) / count


def described(trainer: Any, size: int, overlap: float) -> dict[str, Any]:
    """A point's amounts; pairs are the mean of a few views."""
    import torch

    from neuprim.core.render import render

    views = trainer.dataset.train
    with torch.no_grad():
        pairs = statistics.mean(
            render(trainer.model, views.view(i).camera, {}, trainer.renderer).stats.pairs for i in range(6)
        )
    numbers = sum(value.numel() for value in trainer.model.params.values())
    return {
        "primitives": trainer.model.count,
        "numbers": numbers,
        "pixels": size * size,
        "pairs": pairs,
        "overlap": overlap,
    }


def volumes() -> list[tuple[dict[str, float], Callable[[], object], Callable[[], object]]]:
    """Of each volume: its amounts, what prepares its frame, and what draws one of its images."""
    from neuprim.core.io.vdb import Grid
    from neuprim.tasks.dynamic.volume.looks import named_look
    from neuprim.tasks.dynamic.volume.march import integrate
    from neuprim.tasks.dynamic.volume.normalise import Normalisation
    from neuprim.tasks.dynamic.volume.optics import medium_of
    from neuprim.tasks.dynamic.volume.rig import rig

    found = []
    for voxels, size in (*VOLUMES, JUDGED_VOLUME):
        x, y, z = np.meshgrid(*[np.linspace(-1, 1, voxels)] * 3, indexing="ij")
        smoke = np.clip(1 - x**2 - y**2 - z**2, 0, None) * (
            1 + np.sin(9 * x) * np.cos(7 * y + 5 * z)
        )  # half of the box, as a plume fills its own
        transform = np.diag([1 / voxels] * 3 + [1.0])
        transform[:3, 3] = -0.5
        grids = {"density": Grid.from_dense("density", smoke.astype(np.float32), transform=transform)}
        look, unit = named_look("smoke_fire"), Normalisation((0.0, 0.0, 0.0), 1.0)
        camera = rig(size, 4)[0][0]

        def prepare(grids: Any = grids, look: Any = look, unit: Any = unit) -> Any:
            return medium_of(grids, look, unit, threads=1)

        medium = prepare()

        def draw(medium: Any = medium, camera: Any = camera) -> Any:
            return integrate(medium, camera, samples=2, threads=1)

        found.append(
            (
                {"voxels": voxels**3, "lit": voxels**4, "rays": 4 * size * size, "cells": 4.0 * size * size * voxels},
                prepare,
                draw,
            )
        )
    return found


def measure(rounds: int, group: Any) -> dict[str, Any]:
    """The fastest turns of what both ranks measure at the same time."""
    import torch
    from shared.synthetic import random_trainer

    from neuprim.core.render.frustum import in_sight
    from neuprim.core.train.distributed.shards import Shards
    from neuprim.runs.fit import one_torch_thread

    with group.in_turn():  # kernels are compiled once
        random_trainer(100, 64, 10).train_step()
        for _, prepare, draw in volumes()[:1]:
            prepare(), draw()
    alone = {point: random_trainer(*point) for point in (*FITTED, *JUDGED)}
    two = {point: random_trainer(*point, views=2) for point in JUDGED}
    ranks = {point: random_trainer(*point) for point in JUDGED}
    parts = {point: random_trainer(*point, shard=True) for point in JUDGED}
    for trainer in ranks.values():
        trainer.join(group)
    points = [described(alone[point], point[1], point[2]) for point in (*FITTED, *JUDGED)]
    for trainer in parts.values():
        trainer.join(Shards(group, trainer.renderer.near))
    solids = volumes()

    found: dict[str, dict[str, list[float]]] = {}

    def keep(kind: str, name: object, seconds: float) -> None:
        found.setdefault(kind, {}).setdefault(str(name), []).append(seconds)

    sent: dict[str, int] = {}

    def together(kind: str, point: object, trainer: Any) -> None:
        group.tell({})
        steps = group.tell({"steps": max(round(0.25 / max(timed(trainer.train_step, 0.0), 0.01)), 1)})[0]["steps"]
        before, start, used = group.sent, time.perf_counter(), time.process_time()
        for _ in range(steps):
            trainer.train_step()
        keep(kind, point, (time.process_time() - used) / steps)
        keep(f"{kind}, by the clock", point, (time.perf_counter() - start) / steps)
        sent[f"{kind} {point}"] = (group.sent - before) // steps

    with one_torch_thread():
        for turn in range(rounds + 1):
            if turn == 1:
                found.clear()  # the first round is for caches
            for point, trainer in alone.items():
                keep("step", point, timed(trainer.train_step))
                keep(
                    "adam",
                    point,
                    timed(lambda trainer=trainer: trainer.optimizer.step(trainer.model.params, trainer.rates())),
                )
            for i, (_, prepare, draw) in enumerate(solids):
                keep("prepare", i, timed(prepare))
                keep("draw", i, timed(draw))
            for point in LOOKED_AT:
                views, own = alone[point].dataset.train, alone[point].model.geometry
                keep("sight", point, timed(lambda views=views, own=own: in_sight(own, views.view(0).camera, 0.01)))
            for size in EXCHANGED:
                rows = torch.zeros(2, size // 4)
                into = torch.empty_like(rows)
                group.tell({})
                used = time.process_time()
                for _ in range(8):
                    group.swap(rows, into)
                keep("exchange", size, (time.process_time() - used) / 8)
            for point in JUDGED:
                group.tell({})
                keep("two views", point, timed(two[point].train_step))
                together("ranks", point, ranks[point])
                together("parts", point, parts[point])
    fastest = {
        kind: [min(times) for times in values.values()] for kind, values in found.items()
    }  # noise of a shared machine only adds
    return {"points": points, "volumes": [amounts for amounts, _, _ in solids], "sent": sent, **fastest}


def worker(rounds: int, out: Path) -> None:
    """What each process of the torchrun does."""
    from neuprim.core.train.distributed.group import Group
    from neuprim.core.train.distributed.place import place_of
    from neuprim.core.train.distributed.wire import Wire

    place = place_of()
    assert place is not None and place.size == 2
    group = Group(place, Wire(place, os.environ))
    found = measure(rounds, group)
    both = group.tell({key: found[key] for key in ("step", "adam", "sight", "prepare", "draw")})
    if group.first:
        for key in both[0]:
            found[key] = [min(a, b) for a, b in zip(both[0][key], both[1][key], strict=True)]
        out.write_text(json.dumps(found))
    group.close()


# ------------------------------------------------------------ the model


def model_of(record: dict[str, Any]) -> dict[str, Any]:
    """Coefficients, seconds each, of what was measured."""
    known = len(FITTED)
    points, adam = record["points"][:known], record["adam"][:known]
    rest = [step - own for step, own in zip(record["step"][:known], adam, strict=True)]
    amounts = record["volumes"][: len(VOLUMES)]
    return {
        "step": dict(zip(TERMS, fitted([features(p) for p in points], rest), strict=True)),
        "adam": dict(zip(("a step", "a number"), fitted([[1.0, p["numbers"]] for p in points], adam), strict=True)),
        "sight": dict(zip(("a look", "a primitive"), fitted([[1.0, p[0]] for p in LOOKED_AT], record["sight"]), strict=True)),
        "exchange": dict(zip(("an exchange", "a byte"), fitted([[1.0, size] for size in EXCHANGED], record["exchange"]), strict=True)),
        "frame": dict(zip(("a frame", "a voxel", "a cell on a voxel's way to the light"), fitted([[1.0, v["voxels"], v["lit"]] for v in amounts], record["prepare"][: len(VOLUMES)]), strict=True)),
        "image": dict(
            zip(("an image", "a ray", "a cell of a ray"), fitted([[1.0, v["rays"], v["cells"]] for v in amounts], record["draw"][: len(VOLUMES)]), strict=True)
        ),
    }  # fmt: skip


def seconds_of_view(model: dict[str, Any], point: dict[str, Any]) -> float:
    """Of drawing a view, comparing, and going back."""
    return sum(a * b for a, b in zip(model["step"].values(), features(point), strict=True))


def seconds_of_adam(model: dict[str, Any], numbers: float) -> float:
    return float(model["adam"]["a step"] + model["adam"]["a number"] * numbers)


def judged(record: dict[str, Any]) -> list[dict[str, Any]]:
    """What the model says about what was measured and not fitted."""
    model, rows, known = model_of(record), [], len(FITTED)
    wait, byte = model["exchange"].values()
    for i, point in enumerate(record["points"][known:]):
        view, numbers, name = seconds_of_view(model, point), point["numbers"], str(JUDGED[i])
        specs = 10  # tensors that go one after the other, there and back
        said = {
            "step": view + seconds_of_adam(model, numbers),
            "two views": 2 * view + seconds_of_adam(model, numbers),
            "ranks": view + seconds_of_adam(model, numbers) + wait + byte * record["sent"][f"ranks {name}"],
            "parts": view
            + seconds_of_adam(model, numbers / 2)
            + model["sight"]["a primitive"] * point["primitives"]
            + (2 * specs + 3) * wait
            + byte * record["sent"][f"parts {name}"],
        }
        for kind, seconds in said.items():
            measured = record[kind][known + i] if kind == "step" else record[kind][i]
            sent = record["sent"].get(f"{kind} {name}", 0)
            clock = record.get(f"{kind}, by the clock")
            rows.append(
                {
                    "point": JUDGED[i],
                    "kind": kind,
                    "said": seconds,
                    "measured": measured,
                    "sent": sent,
                    "clock": clock and clock[i],
                }
            )
    amounts = record["volumes"][-1]
    for kind, said in (
        (
            "prepare",
            sum(c * x for c, x in zip(model["frame"].values(), (1.0, amounts["voxels"], amounts["lit"]), strict=True)),
        ),
        (
            "draw",
            sum(c * x for c, x in zip(model["image"].values(), (1.0, amounts["rays"], amounts["cells"]), strict=True)),
        ),
    ):
        rows.append(
            {"point": JUDGED_VOLUME, "kind": kind, "said": said, "measured": record[kind][-1], "sent": 0, "clock": None}
        )
    return rows


def table_of_terms(record: dict[str, Any]) -> str:
    rows = Table("term", "seconds each")
    titles = {
        "step": "a view: ",
        "adam": "Adam: ",
        "sight": "is it in sight: ",
        "exchange": "an exchange: ",
        "frame": "ground truth: ",
        "image": "ground truth: ",
    }
    for group, terms in model_of(record).items():
        for name, value in terms.items():
            rows.row(titles[group] + name, f"{value:.2e}" if value else "0")
    model = model_of(record)
    known = zip(record["points"][: len(FITTED)], record["step"], record["adam"], strict=False)
    spread = [abs((seconds_of_view(model, point) + adam) / step - 1) for point, step, adam in known]
    return (
        f"{rows}\n\nProcessor seconds. Fitted to {len(FITTED)} scenes, fastest of {record['rounds']} turns; of these the model is off by {100 * statistics.median(spread):.0f} % in the "
        f"median and {100 * max(spread):.0f} % at most. {record['cpu']}, two ranks of one thread at the same time, {record['cores']} cores that other work shared."
    )


KINDS = {
    "step": "1 process, a view a step", "two views": "1 process, two views a step", "ranks": "2 ranks, a view each", "parts": "2 ranks, half of the primitives each",
    "prepare": "ground truth, a frame's medium", "draw": "ground truth, an image",
}  # fmt: skip


def table_of_judged(record: dict[str, Any]) -> str:
    rows = Table(
        "not fitted",
        "what",
        "predicted",
        "measured",
        "predicted / measured",
        "predicted / by the clock",
        "a rank sends",
    )
    for row in judged(record):
        if len(row["point"]) == 4:
            primitives, size, overlap, _ = row["point"]
            name = f"{primitives:,} primitives, {size}×{size}, overlap {overlap}"
        else:
            name = f"{row['point'][0]}³ voxels, {row['point'][1]}×{row['point'][1]}"
        times = [f"{1e3 * row[key]:.1f} ms" for key in ("said", "measured")]
        clock = f"{row['said'] / row['clock']:.2f}" if row["clock"] else ""
        rows.row(
            name,
            KINDS[row["kind"]],
            *times,
            f"{row['said'] / row['measured']:.2f}",
            clock,
            f"{row['sent']:,} B" if row["sent"] else "",
        )
    note = (
        f"Processor seconds are those of a quiet machine. By the clock two ranks also wait for other work, and for each other: while this was measured there was "
        f"{record['busy']:.1f} times as much to do as there are cores, these two ranks included."
    )
    return f"{rows}\n\n{note}"


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true")
    parser.add_argument("--worker", type=Path, metavar="OUT", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker is not None:
        worker(args.rounds, args.worker)
        return
    from neuprim.core.compute.machine import cpu_name
    from neuprim.core.compute.threads import core_count

    if not args.print:
        out = RESULTS.with_suffix(".part")
        words = ["--rounds", str(args.rounds), "--worker", str(out)]
        subprocess.run(
            [sys.executable, "-m", "torch.distributed.run", "--nproc-per-node", "2", __file__, *words], check=True
        )
        busy = os.getloadavg()[1] / core_count()
        record = {
            "cpu": cpu_name(),
            "cores": core_count(),
            "busy": busy,
            "rounds": args.rounds,
            **json.loads(out.read_text()),
        }
        RESULTS.write_text(json.dumps({**record, "model": model_of(record)}, indent=1) + "\n")
        out.unlink()
    record = json.loads(RESULTS.read_text())
    for name, text in (
        ("cost-terms", table_of_terms(record)), ("cost-judged", table_of_judged(record)), ("cost-paper", table_of_scenes(record["model"])),
    ):  # fmt: skip
        if args.docs:
            between_markers(PAGE, name, text)


if __name__ == "__main__":
    main()
