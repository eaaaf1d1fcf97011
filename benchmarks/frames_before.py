"""Whether a change made frames of finished runs faster or slower: the same frames by this checkout and by an earlier
one, in turns.

    git worktree add ../before COMMIT
    python benchmarks/frames_before.py ../before RUN_DIR... [--rounds 20] [--record]

A process of each checkout draws five held-out views of a run on one thread, one process at a time, round by round in
another order. The ratio is that of the times of a round, whose median and quartiles are printed; images are compared.
Results go to benchmarks/results/frames_before.json.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

from before import commit
from shared.tables import ROOT, Table

from neuprim.core.compute.machine import cpu_name
from neuprim.core.io.files import write_json

RESULTS = Path(__file__).parent / "results" / "frames_before.json"

CHILD = """
import hashlib, json, statistics, sys, time
from pathlib import Path
from neuprim.runs.fit import one_torch_thread
from neuprim.search.tradeoff.measure import Models
from neuprim.search.tradeoff.subject import load_subject

with one_torch_thread():
    subject = load_subject(Path(sys.argv[1]), ["renderer.threads=1"], 5)
    draw, views = Models(subject).ready(subject.reference), [truth.view for truth in subject.truths]
    images = hashlib.sha256(b"".join(draw(view).numpy().tobytes() for view in views)).hexdigest()
    print(json.dumps([subject.model.count, images]), flush=True)
    for line in sys.stdin:
        times = []
        for view in views:
            for repeat in range(7):
                begin = time.perf_counter()
                draw(view)
                if repeat:  # the first finds its model in no cache
                    times.append(time.perf_counter() - begin)
        print(1e3 * statistics.mean(times), flush=True)
"""
"""What both checkouts run: only what both of them have."""


class Checkout:
    """A process of one checkout that draws a run."""

    def __init__(self, folder: Path, run: Path) -> None:
        environment = {**os.environ, "PYTHONPATH": str(folder.resolve())}
        command = [sys.executable, "-c", CHILD, str(run.resolve())]
        self.process = subprocess.Popen(
            command, env=environment, cwd=folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.count, self.images = json.loads(self._line())
        self.milliseconds: list[float] = []

    def draw(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write("\n")
        self.process.stdin.flush()
        self.milliseconds.append(float(self._line()))

    def end(self) -> None:
        self.process.communicate()

    def _line(self) -> str:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"a checkout could not draw: {self.process.args!r}")
        return line


def compare(before: Path, run: Path, rounds: int) -> dict[str, Any]:
    both = [Checkout(folder, run) for folder in (before, ROOT)]
    for _ in range(rounds):
        for checkout in random.sample(both, 2):
            checkout.draw()
    for checkout in both:
        checkout.end()
    old, new = both
    ratios = [b / a for a, b in zip(old.milliseconds, new.milliseconds, strict=True)]
    low, middle, high = statistics.quantiles(ratios, n=4)
    return {
        "primitives": new.count,
        "ms": statistics.median(new.milliseconds),
        "ratio": middle,
        "quartiles": [low, high],
        "same_images": old.images == new.images,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path, help="another checkout")
    parser.add_argument("runs", type=Path, nargs="+")
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--record", action="store_true")
    args = parser.parse_args()
    found = {"before": commit(args.before), "after": commit(ROOT), "cpu": cpu_name(), "runs": {}}
    table = Table("run", "primitives", "ms", "over before", "quartiles", "images")
    for run in args.runs:
        name = "/".join(run.resolve().parts[-3::2])  # a set and its model
        one = found["runs"][name] = compare(args.before, run, args.rounds)
        quartiles, same = (
            "{:.3f} to {:.3f}".format(*one["quartiles"]),
            "the same bits" if one["same_images"] else "differ",
        )
        table.row(name, f"{one['primitives']:,}", f"{one['ms']:.2f}", f"{one['ratio']:.3f}", quartiles, same)
        if args.record:
            write_json(RESULTS, found)


if __name__ == "__main__":
    main()
