"""Whole searches of a tiny scene, by a clock that training steps move, so that no plan depends on the machine."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from neuprim.config import Job, RunConfig, compose
from neuprim.config.command_settings import LauncherSettings, SearchTarget
from neuprim.core.errors import ConfigError, DataError
from neuprim.runs.fit import Event, Note, Step
from neuprim.runs.launch.jobs import JobResult
from neuprim.runs.measure import evaluate_run
from neuprim.runs.open import load_dataset, read_metrics
from neuprim.search import pruning, size_search, target, target_record
from neuprim.search.target import run_target
from neuprim.search.target_record import TargetRecord, read_target_record
from neuprim.search.trials import Outcome, Trial, run_trial
from neuprim.tasks.static import TASK
from tests.systems import posix

BUDGET = 400.0

WORDS = (
    "task=static scene=solids scene.size=32 scene.train_views=16 scene.test_views=3 model.primitives=40 "
    "model.neurons=2 train.iterations=320 train.population.every=20 train.population.grow_from=1 renderer.threads=1"
).split()

Met = tuple[Path, TargetRecord, "Clock"]


class Clock:
    """A tenth of a second for every step, and a little for every primitive; listens to the run to know."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.now, self.steps, self.stop_after = 0.0, 0, stop_after
        self.notes: list[str] = []

    def __call__(self) -> float:
        return self.now

    def hear(self, event: Event) -> None:
        if isinstance(event, Step):
            self.now += pace(event.report.primitives)
            self.steps += 1
            if self.steps == self.stop_after:
                signal.raise_signal(signal.SIGINT)
        if isinstance(event, Note):
            self.notes.append(event.text)


def pace(primitives: int) -> float:
    return 0.1 + 2e-4 * primitives


def timed(trial: Trial, *args: Any) -> Outcome:
    outcome = run_trial(trial, *args)
    return replace(outcome, pace=pace(outcome.primitives))


@pytest.fixture(scope="module", autouse=True)
def clocked_trials() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 4)
        patch.setattr(target_record, "run_trial", timed)
        patch.setattr(size_search, "_MAX_SIZES", 3)
        patch.setattr(size_search, "_MAX_CHANGES", 1)
        yield


def config(out: Path, *more: str) -> RunConfig:
    return compose([*WORDS, f"output_dir={out}", *more])


def search(out: Path, psnr: float, *more: str, clock: Clock | None = None) -> tuple[TargetRecord, Clock]:
    clock = clock or Clock()
    return run_target(config(out, *more), SearchTarget(psnr=psnr), BUDGET, clock.hear, clock), clock


@pytest.fixture(scope="module")
def met(tmp_path_factory: pytest.TempPathFactory) -> Met:
    out = tmp_path_factory.mktemp("targets") / "met"
    return out, *search(out, 20.0)


def trainings(record: TargetRecord) -> list[tuple[Any, ...]]:
    return [(a.purpose, a.words, a.primitives, a.steps, a.measured("psnr")) for a in record.attempts]


def test_the_target_is_met_within_the_budget(met: Met) -> None:
    out, record, clock = met
    assert record.warning is None and 20.0 <= record.achieved["held_out"]["psnr"] < 20.8
    assert clock.now <= BUDGET and record.spent == pytest.approx(clock.now, abs=1.0)
    assert {a.purpose for a in record.attempts} >= {"pace", "size", "full"}
    assert any("is met on the views held out" in why for why in record.why)
    again, later = search(out, 20.0, "resume=true")
    assert later.steps == 0 and again == record, "the same command again trains nothing"


def test_a_usual_run_directory_is_left(met: Met) -> None:
    out, record, _ = met
    files = ("config.yaml", "model.safetensors", "checkpoint.safetensors", "metrics.json", "metrics.jsonl")
    assert {*files, "renders", "report.html", "target", "target.json"} <= {p.name for p in out.iterdir()}
    assert not list(out.rglob("packed.neuprim")) and read_target_record(out) == record
    assert Path(record.achieved["file"]) == Path(record.achieved["run_dir"]) / "model.neuprim"
    chosen = next(a for a in record.attempts if a.folder == record.chosen)
    again, metrics = RunConfig.from_yaml(out), read_metrics(out)
    assert again.output_dir == out and again.model.primitives == metrics["primitives"] == chosen.count
    assert again.non_default["model.primitives"][1] == metrics["primitives"]
    assert metrics["train_views"] == 8, "half of sixteen, as two of them are the fewest that are held out of"
    assert evaluate_run(out)["psnr"] == pytest.approx(metrics["psnr"], abs=1e-6)


def test_another_target_keeps_the_trainings(met: Met, tmp_path: Path) -> None:
    out, record, _ = met
    copy, clock = tmp_path / "copy", Clock()
    shutil.copytree(out, copy)
    again = run_target(config(copy, "resume=true"), SearchTarget(megabytes=0.004), BUDGET, clock.hear, clock)
    assert trainings(again)[:3] == trainings(record)[:3] and any("are kept" in note for note in clock.notes)
    assert again.asked == {"megabytes": 0.004, "budget": BUDGET} and again.achieved["packed_bytes"] <= 4000
    assert again.warning is None


@posix
def test_an_interrupted_search_ends_like_one_that_was_not_and_test_views_decide_nothing(
    met: Met, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With other test views, and interrupted in trials and in full runs, the search is the same to the last digit."""
    _, whole, clock = met
    out, views = tmp_path / "interrupted", "scene.test_views=2"
    monkeypatch.setattr(target, "_finish_target_search", lambda runner, predictor: None)
    for share in (0.2, 0.5):
        again = ["resume=true"] if out.exists() else []
        with pytest.raises(KeyboardInterrupt):
            search(out, 20.0, views, *again, clock=Clock(round(share * clock.steps)))
        assert read_target_record(out) is not None
    record, rest = search(out, 20.0, views, "resume=true")
    assert trainings(record) == trainings(whole) and 0 < rest.steps < 0.6 * clock.steps


def test_launched_it_trains_two_lengths_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked, clock = list[int](), Clock()
    dataset = load_dataset(Job(config(tmp_path / "run"), TASK))

    def launch(trials: list[Trial], settings: LauncherSettings, folder: Path, progress: Any) -> list[JobResult]:
        asked.append(len(trials))
        assert settings.threads == 1 and folder == tmp_path / "run" / "target"
        outcomes = [timed(trial, dataset) for trial in trials]
        seconds = [outcome.pace * outcome.steps for outcome in outcomes]
        clock.now += max(seconds)
        return [JobResult("done", one, seconds=each) for one, each in zip(outcomes, seconds, strict=True)]

    monkeypatch.setattr(target_record, "launch_trials", launch)
    monkeypatch.setattr(target, "_finish_target_search", lambda runner, predictor: None)
    monkeypatch.setattr("neuprim.runs.launch.executors.machine_cores", lambda: 2)
    settings = LauncherSettings("processes")
    record = run_target(config(tmp_path / "run"), SearchTarget(psnr=20.0), BUDGET, clock.hear, clock, settings)
    assert asked[:2] == [1, 2], "the pace alone, then pairs"
    assert all(a.outcome is not None for a in record.attempts) and record.finished("full")
    assert not (tmp_path / "run" / ".lock").exists()


def test_what_is_left_of_the_budget_prunes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Pruning does not train on held-out views. Its model is taken if it is smaller and still meets the target."""
    learned: list[int] = []

    class Watched(pruning.ModelShrinker):
        def __post_init__(self) -> None:
            learned.append(len(self.dataset.train))
            super().__post_init__()

    monkeypatch.setattr(pruning, "ModelShrinker", Watched)
    monkeypatch.setattr(target, "_MIN_TUNING", 100)
    monkeypatch.setattr(target, "_MAX_TUNING", 1)
    record, clock = search(tmp_path / "run", 19.0)
    assert learned == [8], "of sixteen"
    said = [note for note in clock.notes if note.startswith("pruned: ")]
    assert len(said) == 1 or "nothing could be pruned" in record.why
    pruned = "pruned" in record.achieved
    assert pruned == any(note.endswith("kept") for note in said)
    assert record.achieved["held_out"]["psnr"] >= 19.0 and record.warning is None
    file = Path(record.achieved["file"])
    assert file.exists() and (file.parent.name == "pruned") == pruned
    assert not said or json.loads((tmp_path / "run" / "pruned" / "pruned.json").read_text())


# ---------------------------------------------------------------- refusals


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["train.max_seconds=60"], "train.max_seconds=60: a run with a target takes its time from budget="),
        (["preset=paper"], "train.population.strategy=gradient: a target determines"),
        (["train.population.grow_to=50"], "train.population.grow_to=50: a target determines"),
        (["train.iterations=0"], "train.iterations=0"),
    ],
)
def test_settings_that_a_target_decides_are_refused(more: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        search(tmp_path / "run", 20.0, *more)
    assert str(refused.value).startswith(message) and not (tmp_path / "run").exists()


def test_what_cannot_be_searched_is_refused(met: Met, tmp_path: Path) -> None:
    expected = (
        r"budget=20s: enough for only \d+ steps of 40 primitives; expected at least 256 steps. "
        r"Give a budget of \d+ s"
    )
    clock = Clock()
    with pytest.raises(ConfigError, match=expected):
        run_target(config(tmp_path / "short"), SearchTarget(psnr=20.0), 20.0, clock.hear, clock)
    with pytest.raises(DataError, match="3 training views; a target needs 4 or more"):
        search(tmp_path / "few", 20.0, "scene.train_views=3")
    with pytest.raises(ConfigError, match=r"target.json: the search was started with another model"):
        search(met[0], 20.0, "resume=true", "model.colour.lobes=1")
    (tmp_path / "config.yaml").write_text("task: {}\n")
    with pytest.raises(ConfigError, match="contains a run without a target"):
        search(tmp_path, 20.0, "resume=true")
