"""Whole searches of a tiny scene, by a clock that training steps move, so that no plan depends on the machine."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from neuprim.config import RunConfig, compose
from neuprim.config.command_settings import LauncherSettings, Target
from neuprim.core.errors import ConfigError, DataError
from neuprim.runs.events import Event, Note, Step, ignore_event
from neuprim.runs.launch.jobs import Job, Result, perform
from neuprim.runs.measure import evaluate_run
from neuprim.runs.open import read_metrics
from neuprim.search import pruning
from neuprim.search.target import run_target
from neuprim.search.target_record import TargetRecord, read_target_record
from tests.systems import posix

BUDGET = 400.0


@pytest.fixture(scope="module", autouse=True)
def short_orbits() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 4)
        yield


class Clock:
    """A tenth of a second for every step, and a little for every primitive; listens to the run to know."""

    def __init__(self, stop_after: int | None = None) -> None:
        self.now, self.steps, self.stop_after = 0.0, 0, stop_after
        self.notes: list[str] = []

    def __call__(self) -> float:
        return self.now

    def hear(self, event: Event) -> None:
        if isinstance(event, Step):
            self.now += 0.1 + 2e-4 * event.report.primitives
            self.steps += 1
            if self.steps == self.stop_after:
                signal.raise_signal(signal.SIGINT)
        if isinstance(event, Note):
            self.notes.append(event.text)


# A step costs the same from the first on (grow_from), so that a resumed training is timed by its remaining steps.
WORDS = (
    "task=static scene=solids scene.size=32 scene.train_views=16 scene.test_views=3 model.primitives=40 "
    "model.neurons=2 "
    "train.iterations=320 train.population.every=20 train.population.grow_from=1 renderer.threads=1"
).split()


def config(out: Path, *more: str) -> RunConfig:
    return compose([*WORDS, f"output_dir={out}", *more])


def searched(
    out: Path, target: Target, *more: str, budget: float = BUDGET, clock: Clock | None = None
) -> tuple[TargetRecord, Clock]:
    clock = clock or Clock()
    return run_target(config(out, *more), target, budget, clock.hear, clock), clock


@pytest.fixture(scope="module")
def met(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TargetRecord, Clock]:
    out = tmp_path_factory.mktemp("targets") / "met"
    return out, *searched(out, Target(psnr=20.0))


def trainings(record: TargetRecord) -> list[tuple[Any, ...]]:
    return [(a.purpose, a.words, a.primitives, a.steps, a.measured("psnr")) for a in record.attempts]


@pytest.mark.slow
def test_launched_it_trains_two_lengths_together(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By a launcher that works here, at the pace that the clock says."""
    asked: list[list[str]] = []

    def launched(jobs: list[Job], settings: LauncherSettings, folder: Path, hear: Any) -> list[Result]:
        asked.append([job.name for job in jobs])
        assert settings.threads == 1 and folder == tmp_path / "run" / "target"
        results = [perform(job, 0, ignore_event) for job in jobs]
        for job, result in zip(jobs, results, strict=True):
            own = RunConfig.from_dict(job.data["config"])
            steps, primitives = own.train.iterations, own.model.primitives
            pace = 0.1 + 2e-4 * primitives
            clock.now += pace * (steps or 0) / len(jobs)
            results[results.index(result)] = replace(
                result, value=result.value._replace(pace=pace, compiling=0.0, seconds=pace * (steps or 0))
            )
        return results

    clock = Clock()
    monkeypatch.setattr("neuprim.search.trial_runner.launch_jobs", launched)
    monkeypatch.setattr("neuprim.runs.launch.executors.machine_cores", lambda: 2)
    settings = LauncherSettings("processes")
    record = run_target(config(tmp_path / "run"), Target(psnr=20.0), BUDGET, clock.hear, clock, settings)
    sizes = [names for names in asked if len(names) == 2]
    assert sizes and len(asked[0]) == 1, "the pace alone, then pairs"
    assert record.achieved["held_out"]["psnr"] >= 20.0 and all(a.outcome is not None for a in record.attempts)
    assert (tmp_path / "run" / "model.neuprim").exists() and not (tmp_path / "run" / ".lock").exists()


# ---------------------------------------------------------------- what a search leaves


def test_the_target_is_met_within_the_budget(met: tuple[Path, TargetRecord, Clock]) -> None:
    _, record, clock = met
    assert record.warning is None and record.achieved["held_out"]["psnr"] >= 20.0
    assert record.achieved["held_out"]["psnr"] < 20.8
    assert clock.now <= BUDGET and record.spent == pytest.approx(clock.now, abs=1.0)
    assert {a.purpose for a in record.attempts} >= {"pace", "size", "full"}
    assert any("is met on the views held out" in why for why in record.why)


def test_a_usual_run_directory_is_left(met: tuple[Path, TargetRecord, Clock]) -> None:
    out, record, _ = met
    files = ("config.yaml", "model.safetensors", "checkpoint.safetensors", "metrics.json", "metrics.jsonl")
    assert {*files, "renders", "report.html", "target", "target.json"} <= {p.name for p in out.iterdir()}
    assert not list(out.rglob("packed.neuprim")) and read_target_record(out) == record
    assert Path(record.achieved["file"]).name == "model.neuprim" and Path(record.achieved["file"]).parent == Path(
        record.achieved["run_dir"]
    )
    chosen = next(a for a in record.attempts if a.folder == record.chosen)
    again, metrics = RunConfig.from_yaml(out), read_metrics(out)
    assert again.output_dir == out and again.model.primitives == metrics["primitives"] == chosen.count
    assert again.non_default["model.primitives"][1] == metrics["primitives"]
    assert metrics["train_views"] == 8, "half of sixteen, as two of them are the fewest that are held out of"
    assert evaluate_run(out)["psnr"] == pytest.approx(metrics["psnr"], abs=1e-6)


def test_the_same_command_again_trains_nothing(met: tuple[Path, TargetRecord, Clock]) -> None:
    out, record, _ = met
    again, clock = searched(out, Target(psnr=20.0), "resume=true")
    assert clock.steps == 0 and again == record


def test_another_target_keeps_the_trainings(met: tuple[Path, TargetRecord, Clock], tmp_path: Path) -> None:
    import shutil

    out, record, _ = met
    copy = tmp_path / "copy"
    shutil.copytree(out, copy)
    again, clock = searched(copy, Target(megabytes=0.004), "resume=true")
    assert trainings(again)[:3] == trainings(record)[:3] and any("are kept" in note for note in clock.notes)
    assert again.asked == {"megabytes": 0.004, "budget": BUDGET} and again.achieved["packed_bytes"] <= 4000
    assert again.warning is None


@posix
def test_ctrl_c_and_resume_end_where_an_uninterrupted_search_ends(
    met: tuple[Path, TargetRecord, Clock], tmp_path: Path
) -> None:
    _, whole, clock = met
    out = tmp_path / "interrupted"
    for share in (0.2, 0.5):
        with pytest.raises(KeyboardInterrupt):
            searched(
                out,
                Target(psnr=20.0),
                *(["resume=true"] if out.exists() else []),
                clock=Clock(round(share * clock.steps)),
            )
        assert read_target_record(out) is not None
    record, rest = searched(out, Target(psnr=20.0), "resume=true")
    assert trainings(record) == trainings(whole) and record.chosen == whole.chosen
    assert 0 < rest.steps < 0.6 * clock.steps


# ---------------------------------------------------------------- what cannot be


def test_what_is_out_of_reach_is_said_and_the_best_is_made(tmp_path: Path) -> None:
    record, clock = searched(tmp_path / "run", Target(psnr=60))
    said = next(i for i, note in enumerate(clock.notes) if "target.psnr=60 is out of reach" in note)
    assert said < next(i for i, note in enumerate(clock.notes) if note.startswith("full run"))
    assert record.warning is not None and "target.psnr=60 is missed" in record.warning
    assert (tmp_path / "run" / "model.neuprim").exists() and clock.now <= BUDGET


def test_test_views_decide_nothing(met: tuple[Path, TargetRecord, Clock], tmp_path: Path) -> None:
    """With other test views the search is the same to the last digit."""
    record, _ = searched(tmp_path / "run", Target(psnr=20.0), "scene.test_views=2")
    assert trainings(record) == trainings(met[1])


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["train.max_seconds=60"], "train.max_seconds=60: a run with a target has its seconds from budget="),
        (["preset=paper"], "train.population.strategy=gradient: it decides"),
        (["train.population.grow_to=50"], "train.population.grow_to=50: a target decides"),
        (["train.iterations=0"], "train.iterations=0"),
    ],
)
def test_settings_that_a_target_decides_are_refused(more: list[str], message: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as refused:
        searched(tmp_path / "run", Target(psnr=20), *more)
    assert str(refused.value).startswith(message) and not (tmp_path / "run").exists()


def test_a_budget_without_room_for_a_run_says_what_it_takes(tmp_path: Path) -> None:
    with pytest.raises(
        ConfigError,
        match=r"budget=20s: a full run of 40 primitives would have \d+ steps; expected 256 or more, or \d+ s",
    ):
        searched(tmp_path / "run", Target(psnr=20), budget=20.0)


def test_too_few_views_to_hold_some_out(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="3 training views; a target needs 4 or more"):
        searched(tmp_path / "run", Target(psnr=20), "scene.train_views=3")


def test_a_search_of_another_model_is_not_gone_on_with(met: tuple[Path, TargetRecord, Clock]) -> None:
    with pytest.raises(ConfigError, match=r"target.json: begun with another model"):
        searched(met[0], Target(psnr=20.0), "resume=true", "model.sh_degree=1")


def test_a_run_without_a_target_is_not_overwritten(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("task: {}\n")
    with pytest.raises(ConfigError, match="holds a run without a target"):
        searched(tmp_path, Target(psnr=20.0), "resume=true")


# ---------------------------------------------------------------- finishing


def test_what_is_left_of_the_budget_prunes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Views held out are not trained on by the pruning either; what is pruned is taken only where it is smaller and
    still meets the target."""
    learned: list[int] = []

    class Watched(pruning.ModelShrinker):
        def __post_init__(self) -> None:
            learned.append(len(self.dataset.train))
            super().__post_init__()

    monkeypatch.setattr(pruning, "ModelShrinker", Watched)
    record, clock = searched(tmp_path / "run", Target(psnr=19.0), "train.iterations=640", budget=1200.0)
    assert learned == [8], "of sixteen"
    said = [note for note in clock.notes if note.startswith("pruned: ")]
    assert len(said) == 1 or "nothing could be pruned" in record.why
    pruned = "pruned" in record.achieved
    assert pruned == any(note.endswith("kept") for note in said)
    assert record.achieved["held_out"]["psnr"] >= 19.0 and record.warning is None
    file = Path(record.achieved["file"])
    assert file.exists() and (file.parent.name == "pruned") == pruned
    if said:
        assert json.loads((tmp_path / "run" / "pruned" / "pruned.json").read_text())
