"""Memory of a rank, and what a step sends, with all primitives on each and with a part of them.

    python benchmarks/shards.py [--primitives 500000] [--size 64] [--docs] [--print]

Random primitives of 70 numbers in the unit cube, seen from around it (a view shows nearly all) and from within (a few
in a hundred), a fixed population, two views a step: by one process, by two ranks that hold all primitives each, and by
two ranks that hold half. Every way has processes of its own. "State" is counted: parameters, their gradients, both
moments, ages. Memory is the kernel's: resident bytes above those of a process that has imported everything, the most
while
the model is made and while steps are taken. Results go to benchmarks/results/shards.json; --docs puts the table into
docs/scaling.md.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

from shared.tables import ROOT, Table, between_markers

RESULTS, PAGE = Path(__file__).parent / "results" / "shards.json", ROOT / "docs" / "scaling.md"
WAYS = {"alone": "1 process", "whole": "2 ranks, all on each", "parts": "2 ranks, in parts"}
STEPS = 4


def resident(what: str) -> int:
    """Bytes of this process by Linux's own count: VmRSS now, VmHWM at most since :func:`forget`."""
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(what))
    return int(line.split()[1]) * 1024


def forget() -> None:
    """Let the count of the most begin anew."""
    Path("/proc/self/clear_refs").write_text("5")


def measure(way: str, inside: bool, primitives: int, size: int, group: Any) -> dict[str, Any]:
    """One way, in a process of its own."""
    import torch
    from shared.synthetic import random_trainer

    from neuprim.core.train.distributed.shards import Shards

    torch.set_num_threads(1)
    random_trainer(100, size, 10).train_step()  # what it needs at all: code and kernels
    base = resident("VmRSS")
    forget()
    trainer = random_trainer(
        primitives, size, 30, views=2 if way == "alone" else 1, inside=inside, shard=way == "parts"
    )
    if way == "parts":
        trainer.join(Shards(group, trainer.renderer.near))
    elif way == "whole":
        trainer.join(group)
    trainer.train_step()
    made = resident("VmHWM") - base
    forget()
    before, start, used = (group.sent if group else 0), time.perf_counter(), time.process_time()
    for _ in range(STEPS):
        trainer.train_step()
    seconds, processor = (time.perf_counter() - start) / STEPS, (time.process_time() - used) / STEPS
    tensors = [
        *trainer.model.params.values(),
        *trainer.optimizer.m.values(),
        *trainer.optimizer.v.values(),
        trainer.optimizer.age,
    ]
    tensors += [value.grad for value in trainer.model.params.values() if value.grad is not None]
    return {
        "state": sum(value.nbytes for value in tensors),
        "start": made, "steps": resident("VmHWM") - base, "sent": ((group.sent if group else 0) - before) // STEPS,
        "seconds": seconds, "processor": processor,
    }  # fmt: skip


def worker(way: str, inside: bool, primitives: int, size: int, out: Path) -> None:
    from neuprim.core.train.distributed.group import Group
    from neuprim.core.train.distributed.place import place_of
    from neuprim.core.train.distributed.wire import Wire

    place = place_of()
    group = None if place is None else Group(place, Wire(place, os.environ))
    found = measure(way, inside, primitives, size, group)
    every = [found] if group is None else group.tell(found)
    if group is None or group.first:
        out.write_text(json.dumps(every))
    if group is not None:
        group.close()


def table(record: dict[str, Any]) -> str:
    rows = Table(
        "cameras",
        "way",
        "state of a rank",
        "memory at most, of steps",
        "of the start",
        "over 2 ranks with all",
        "a rank sends a step",
        "processor time of a step",
    )
    for place in ("around", "within"):
        whole = record[place]["whole"]
        for way, ranks in record[place].items():
            most = {key: max(rank[key] for rank in ranks) for key in ranks[0]}
            others = max(rank["steps"] for rank in whole)
            rows.row(
                place, WAYS[way], f"{most['state'] / 1e6:,.0f} MB", f"{most['steps'] / 1e6:,.0f} MB", f"{most['start'] / 1e6:,.0f} MB",
                f"{most['steps'] / others:.2f}" if way != "alone" else "", f"{most['sent'] / 1e6:,.1f} MB" if most["sent"] else "",
                f"{most['processor']:.2f} s",
            )  # fmt: skip
    return f"{rows}\n\n{record['primitives']:,} primitives, {record['size']}×{record['size']}; the larger of both ranks. {record['cpu']}."


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--primitives", type=int, default=500_000)
    parser.add_argument("--size", type=int, default=64)
    parser.add_argument("--docs", action="store_true")
    parser.add_argument("--print", action="store_true")
    parser.add_argument("--worker", nargs=3, metavar=("WAY", "INSIDE", "OUT"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.worker is not None:
        way, inside, out = args.worker
        worker(way, inside == "within", args.primitives, args.size, Path(out))
        return
    from neuprim.core.compute.machine import cpu_name

    if not args.print:
        record: dict[str, Any] = {"primitives": args.primitives, "size": args.size, "cpu": cpu_name()}
        out = RESULTS.with_suffix(".part")
        for place in ("around", "within"):
            for way in WAYS:
                launcher = [] if way == "alone" else ["-m", "torch.distributed.run", "--nproc-per-node", "2"]
                words = [
                    "--primitives",
                    str(args.primitives),
                    "--size",
                    str(args.size),
                    "--worker",
                    way,
                    place,
                    str(out),
                ]
                subprocess.run([sys.executable, *launcher, __file__, *words], check=True)
                record.setdefault(place, {})[way] = json.loads(out.read_text())
        out.unlink()
        RESULTS.write_text(json.dumps(record, indent=1) + "\n")
    text = table(json.loads(RESULTS.read_text()))
    if args.docs:
        between_markers(PAGE, "shards", text)


if __name__ == "__main__":
    main()
