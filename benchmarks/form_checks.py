"""What checking the lowered forms costs, as a share of a training step.

    python benchmarks/form_checks.py [--primitives 5000] [--size 200] [--steps 60]

Every function of neuprim.core.model.checks that a step calls is timed in the steps themselves, so both times come from
one process and one mood of the machine; the clock's own cost counts as the checks'. Exits with an error where the share
reaches --most (1 %).
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median
from typing import Any

import torch

from neuprim.conformance.example import example
from neuprim.core import render
from neuprim.core.data import Dataset, Pixels
from neuprim.core.model import checks as forms
from neuprim.core.model import primitives
from neuprim.core.model.colours import sh
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.fields import ColourField, ConditionSpec, DensityField
from neuprim.core.train import population
from neuprim.core.train.initial import initial_model
from neuprim.core.train.losses import photometric
from neuprim.core.train.settings import ModelSettings, TrainSettings
from neuprim.core.train.trainer import Trainer
from neuprim.tasks.dynamic import TASK as DYNAMIC
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.density import TimeDensity
from neuprim.tasks.static.fields import SphericalHarmonics


def large(conditions: tuple[ConditionSpec, ...], size: int) -> Dataset:
    """The conformance example at another size, its pixels drawn at random: no run learns here."""
    made = example(conditions)
    generator = torch.Generator().manual_seed(3)
    views = made.train
    views.views = [replace(v, camera=v.camera.resized(size, size)) for v in views.views]  # type: ignore[attr-defined]
    views.images = [Pixels(torch.rand(size, size, 3, generator=generator)) for _ in range(len(views))]  # type: ignore[attr-defined]
    return made


class Clock:
    """Stands in for every check, and adds up what they take: of nested ones only the outermost counts."""

    def __init__(self) -> None:
        self.seconds, self.calls, self.inside = 0.0, 0, False
        names = [name for name in forms.__all__ if callable(getattr(forms, name)) and name.islower()]
        for module in (primitives, render, sh, population):
            for name in names:
                if hasattr(module, name):
                    setattr(module, name, self.timed(getattr(module, name)))

    def timed(self, check: Callable[..., Any]) -> Callable[..., Any]:
        def run(*arguments: Any) -> Any:
            if self.inside:
                return check(*arguments)
            self.inside, start = True, time.perf_counter()
            try:
                return check(*arguments)
            finally:
                self.seconds += time.perf_counter() - start
                self.calls, self.inside = self.calls + 1, False

        return run


def share(
    density: DensityField, colour: ColourField, data: Dataset, count: int, steps: int, clock: Clock
) -> tuple[float, float, float]:
    """Medians over steps: milliseconds of a step, microseconds of its checks, and their ratio."""
    model = initial_model(density, colour, data, ModelSettings(primitives=count), 0)
    settings = TrainSettings(iterations=steps + 5)
    loss = photometric({**vars(settings), "options": {}})
    trainer = Trainer(model, data, loss, settings, render.RenderSettings(backend="cpu"), 0)
    whole, checks = [], []
    for step in range(steps + 5):
        clock.seconds, start = 0.0, time.perf_counter()
        trainer.train_step()
        if step >= 5:  # the first ones compile
            whole.append(time.perf_counter() - start)
            checks.append(clock.seconds)
    return 1e3 * median(whole), 1e6 * median(checks), median(c / w for c, w in zip(checks, whole, strict=True))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--primitives", type=int, default=5000)
    parser.add_argument("--size", type=int, default=200)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--most", type=float, default=0.01, help="share of a step that fails")
    args = parser.parse_args()
    clock, worst = Clock(), 0.0
    cases: tuple[tuple[str, DensityField, ColourField, Any], ...] = (
        ("static, degree 3", CosineDensity(8), SphericalHarmonics(3), ()),
        ("dynamic, windows and motion", TimeDensity(8, "window+motion"), TimeHarmonics(1), DYNAMIC.conditions),
    )
    for name, density, colour, conditions in cases:
        step, checks, ratio = share(density, colour, large(conditions, args.size), args.primitives, args.steps, clock)
        print(f"{name:28} step {step:7.2f} ms   checks {checks:6.1f} us   share {100 * ratio:.3f} %")
        worst = max(worst, ratio)
    return 0 if worst < args.most else 1


if __name__ == "__main__":
    sys.exit(main())
