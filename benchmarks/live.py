"""What a viewer that nobody looks at costs a training, and that it changes no bit of it.

    python benchmarks/live.py [--steps 1000] [--block 25] [--rounds 3] [WORD ...]

Three trainings of one configuration (words as for ``neuprim run``; default: task=static scene=solids) go on in turns in
one process, a block of steps each: two plain ones, and one with the page of ``viewer=true`` open and nobody there. All
do the same work in every block, so its times are compared one by one; the order changes. Times are the processor's, on
one thread, so that other work on the machine counts less. Printed are the median ratio of steps/s over all blocks with
its quartiles: of the plain trainings to each other, which is what chance makes, and of a plain one to the one with a
viewer; what the page's server uses while nothing happens; what the viewer's own code takes per step, timed alone; and
whether all parameters are equal
to the bit.
"""

from __future__ import annotations

import argparse
import tempfile
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from neuprim.config import compose
from neuprim.config.viewer import ViewerSettings
from neuprim.core.train.trainer import StepReport
from neuprim.runs.events import Events, Step, silent
from neuprim.runs.fit import Fitted, one_torch_thread, start, steps
from neuprim.runs.training import Between, alone, make_ready
from neuprim.viewer.training import LiveTraining

_IDLE = 5.0  # seconds
_CALLS = 20_000


def stepper(fitted: Fitted, events: Events, between: Between) -> Callable[[int], float]:
    """Does so many steps as a run does them; seconds of the processor that they took."""
    stop, loop = threading.Event(), steps(fitted.trainer, events)

    def go(count: int) -> float:
        begun = time.process_time()
        for _ in range(count):
            next(loop)
            between(fitted, stop)
        return time.process_time() - begun

    return go


def alone_with(live: LiveTraining, fitted: Fitted) -> float:
    """Seconds that listening to a step and the question after it take."""
    model, stop = fitted.model, threading.Event()
    report = StepReport(1, 1.0, 0.1, {}, 20.0, model.count, "view", None)
    begun = time.process_time()
    for _ in range(_CALLS):
        live(Step(report, 0.0))
        live.between(fitted, stop)
    return (time.process_time() - begun) / _CALLS


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("words", nargs="*", default=["task=static", "scene=solids"], metavar="WORD")
    parser.add_argument("--steps", type=int, default=1000)
    parser.add_argument("--block", type=int, default=25)
    parser.add_argument("--rounds", type=int, default=3)
    args = parser.parse_args()
    seconds: list[list[float]] = []
    with tempfile.TemporaryDirectory() as folder:
        own = [
            f"train.iterations={args.steps}",
            "train.eval_every=0",
            "renderer.threads=1",
            f"output_dir={Path(folder) / 'out'}",
        ]
        config = compose([*args.words, *own])
        dataset = start(config).dataset
        for number in range(args.rounds):
            plain, again, viewed = (start(config, dataset=dataset) for _ in range(3))
            make_ready(plain.trainer)
            with LiveTraining(ViewerSettings(port=0), config, lambda address: None, silent) as live, one_torch_thread():
                live.between(viewed, threading.Event())
                begun = time.process_time()
                time.sleep(_IDLE)
                idle = (time.process_time() - begun) / _IDLE
                own_code = alone_with(live, viewed)
                all_three = [
                    stepper(plain, silent, alone),
                    stepper(again, silent, alone),
                    stepper(viewed, live, live.between),
                ]
                for block in range(args.steps // args.block):
                    turn = [(block + i) % 3 for i in range(3)]
                    took = {which: all_three[which](args.block) for which in turn}
                    seconds.append([took[which] for which in range(3)])
            equal = all(torch.equal(value, viewed.model.params[name]) for name, value in plain.model.params.items())
            times = np.array(seconds)
            print(
                f"round {number + 1}, {len(times)} blocks of {args.block} steps; parameters {'equal to the bit' if equal else 'DIFFER'}"
            )
            for name, which in (("plain, against plain", 1), ("with a viewer that nobody looks at, against plain", 2)):
                low, middle, high = np.percentile(times[:, which] / times[:, 0], (25, 50, 75))
                print(f"  {name}: a step takes {middle:.4f} times as long (quartiles {low:.4f} to {high:.4f})")
            print(
                f"  the viewer's own code: {1e6 * own_code:.1f} µs per step, {own_code / (np.median(times[:, 0]) / args.block):.3%} of one"
            )
            print(f"  the page's server, idle: {idle:.2%} of a core")


if __name__ == "__main__":
    main()
