"""Whatever is killed at any moment and resumed ends with the bits of what nothing happened to: a run, a sweep, a trial
of a search, a run in chunks."""

from __future__ import annotations

import json
import random
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from neuprim.config import compose
from neuprim.config.compose import compose_all
from neuprim.core import checkpoint
from neuprim.core.io.vdb import write_vdb
from neuprim.runs.run import run
from neuprim.runs.sweep import run_sweep
from neuprim.search.trials import Trial, run_trial
from tests.core import tiny
from tests.short_runs import words
from tests.tasks.dynamic.sequences import blob

STEPS, MOMENTS = 40, 2
OFTEN = "train.checkpoint_every_seconds=0.01"
GRADIENT = [
    "train.population.strategy=gradient",
    "train.population.prune_threshold=0",
    "train.population.max_primitives=60",
]


class Killed(BaseException):
    """Ends everything at once; no code expects it."""


class Killer:
    """A listener that kills at the n-th event."""

    def __init__(self, moment: int | None = None) -> None:
        self.count, self._moment = 0, moment

    def __call__(self, *event: Any) -> None:
        if self.count == self._moment:
            raise Killed
        self.count += 1


Work = Callable[[Path, Path, Killer], object]


def work_on_run(data: Path, out: Path, killer: Killer, *more: str) -> None:
    if (out / "metrics.jsonl").exists():
        with open(out / "metrics.jsonl", "a") as file:
            file.write('{"step": 110, "lo')  # as a kill cuts it short
    run(compose(words(data / "two", out, STEPS, OFTEN, "resume=true", *more)), killer)


def work_on_sweep(data: Path, out: Path, killer: Killer) -> None:
    typed = [w for w in words(data / "two", out, STEPS, OFTEN, "resume=true") if not w.startswith("seed=")]
    typed.append("seed=1,2")
    run_sweep(compose_all(typed), typed, on_status=killer)


def work_on_trial(data: Path, out: Path, killer: Killer) -> None:
    run_trial(Trial(compose(words(data / "two", out, STEPS, OFTEN), check_output=False), hold_out=3), events=killer)


def work_on_chunks(data: Path, out: Path, killer: Killer) -> None:
    typed = [
        "task=dynamic", "scene=vdb", f"scene.vdb='{data / 'ball'}'", "scene.look=smoke_fire", "scene.size=16",
        "scene.cameras=4", "scene.samples=1", "scene.chunks=2", "model.primitives=40", f"train.iterations={STEPS}",
        "train.population.every=10", "train.eval_every=0.5", "train.log_every=10", OFTEN, "resume=true",
        f"output_dir='{out}'",
    ]  # fmt: skip
    run(compose(typed), killer)


WORKS: Mapping[str, Work] = {
    "run": work_on_run,
    "run with growth": lambda data, out, killer: work_on_run(data, out, killer, *GRADIENT),
    "sweep": work_on_sweep,
    "trial": work_on_trial,
    "chunks": work_on_chunks,
}


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    tiny.write_blender(folder / "two")
    (folder / "ball").mkdir()
    for number in range(1, 7):
        write_vdb(folder / "ball" / f"ball_{number}.vdb", blob(5.0 + 2 * number))
    return folder


def contents(folder: Path) -> dict[str, Any]:
    """Every tensor, curve and metric below a folder, without times."""
    found: dict[str, Any] = {}
    for file in sorted(folder.rglob("*.safetensors")):
        tensors = checkpoint.read_tensors(file, file.stem)[1]
        found |= {f"{file.relative_to(folder)} {k}": (v.dtype, v.numpy().tobytes()) for k, v in tensors.items()}
    for file in sorted(folder.rglob("metrics.json*")):
        lines = file.read_text().splitlines() if file.suffix == ".jsonl" else [file.read_text()]
        timed = ("seconds", "train_seconds", "render_fps", "per_view", "non_default", "model_bytes")
        found[str(file.relative_to(folder))] = [
            {k: v for k, v in json.loads(line).items() if k not in timed} for line in lines
        ]
    return found


@pytest.mark.parametrize("kind", WORKS)
def test_killed_at_any_moment_and_resumed_it_is_the_uninterrupted_one(kind: str, data: Path, tmp_path: Path) -> None:
    work, whole = WORKS[kind], Killer()
    work(data, tmp_path / "whole", whole)
    expected = contents(tmp_path / "whole")
    assert len(expected) > 20
    out, generator, killed = tmp_path / "killed", random.Random(kind), 0
    for _ in range(MOMENTS):
        try:
            work(data, out, Killer(generator.randrange(1, max(whole.count // 2, 2))))
        except Killed:
            killed += 1
    assert killed
    work(data, out, Killer())
    assert contents(out) == expected
