"""Trials of a tiny scene: what their folders hold, and that none is trained twice or half."""

from __future__ import annotations

import os
import signal
from dataclasses import replace
from pathlib import Path

import pytest

import neuprim.runs.fit as fitting
from neuprim.config import Job, RunConfig, compose
from neuprim.core import checkpoint
from neuprim.core.errors import DataError
from neuprim.core.train.trainer import StepReport, Trainer
from neuprim.runs.fit import Event, Note, Step, fit
from neuprim.runs.measure import evaluate_run
from neuprim.runs.open import load_dataset, load_run
from neuprim.runs.render_images import RenderRequest, render_run
from neuprim.search.trials import TRIAL_FILE, Outcome, Trial, launch_trials, read_trial, run_trial
from neuprim.tasks.static import TASK
from tests.core import tiny
from tests.runs.launching import processes
from tests.short_runs import words
from tests.systems import posix

STEPS = 40


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


def config_of(scene: Path, folder: Path, *more: str) -> RunConfig:
    return compose(words(scene, folder, STEPS, *more), check_output=False)


@pytest.fixture(scope="module")
def done(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Outcome]:
    folder = tmp_path_factory.mktemp("trials") / "one"
    return folder, run_trial(Trial(config_of(scene, folder)))


def steps_of(heard: list[Event]) -> int:
    return sum(isinstance(event, Step) for event in heard)


def test_a_trial_is_a_run_without_report_and_pictures(done: tuple[Path, Outcome], tmp_path: Path) -> None:
    folder = done[0]
    assert sorted(p.name for p in folder.iterdir()) == sorted(
        ["checkpoint.safetensors", "config.yaml", "metrics.jsonl", "model.safetensors", TRIAL_FILE]
    )
    assert load_run(folder).model.count == 40
    assert len(render_run(folder, RenderRequest("test", size=(12, 12), format="png", out=tmp_path / "drawn"))) == 2


def test_an_outcome_is_what_evaluating_the_folder_measures(done: tuple[Path, Outcome]) -> None:
    folder, outcome = done
    metrics = evaluate_run(folder)
    assert outcome.psnr == pytest.approx(metrics["psnr"], abs=1e-9)
    assert outcome.ssim == pytest.approx(metrics["ssim"], abs=1e-9)
    assert outcome.primitives == 40 and outcome.parameters_per_primitive == metrics["parameters_per_primitive"]
    assert outcome.bytes == (folder / "model.safetensors").stat().st_size and outcome.steps == STEPS
    assert 0 < outcome.pace < outcome.seconds and outcome.ms_per_frame > 0
    record = read_trial(folder)
    assert record is not None and record.outcome == outcome


def test_what_is_done_is_read_back_and_nothing_is_loaded(
    done: tuple[Path, Outcome], scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, outcome = done
    monkeypatch.setattr("neuprim.runs.fit.load_dataset", lambda *args: pytest.fail("loaded"))
    assert run_trial(Trial(config_of(scene, folder))) == outcome


def test_other_settings_are_trained_anew_and_said(scene: Path, tmp_path: Path) -> None:
    folder, heard = tmp_path / "t", list[Event]()
    first = run_trial(Trial(config_of(scene, folder)))
    second = run_trial(Trial(config_of(scene, folder, "model.neurons=0")), events=heard.append)
    said = [event.text for event in heard if isinstance(event, Note)]
    assert f"{folder}: made with another model.neurons; trained anew" in said and steps_of(heard) == STEPS
    assert second.parameters_per_primitive < first.parameters_per_primitive
    run_trial(Trial(config_of(scene, folder, "model.neurons=0"), hold_out=3), events=heard.append)
    assert any("another hold_out" in event.text for event in heard if isinstance(event, Note))


def test_other_views_are_measured_and_not_trained_for(scene: Path, tmp_path: Path) -> None:
    folder, heard = tmp_path / "t", list[Event]()
    both = run_trial(Trial(config_of(scene, folder)))
    one = run_trial(Trial(config_of(scene, folder), views=1), events=heard.append)
    assert steps_of(heard) == 0 and one.psnr != both.psnr and one.steps == STEPS
    assert one.psnr == pytest.approx(evaluate_run(folder)["per_view"][0]["psnr"])


def test_views_that_judge_are_not_learned_from(scene: Path, tmp_path: Path) -> None:
    config = config_of(scene, tmp_path / "t")
    whole = load_dataset(Job(config, TASK))
    learned = set[str]()

    def hear(event: Event) -> None:
        if isinstance(event, Step):
            learned.add(event.report.view)

    outcome = run_trial(Trial(config, hold_out=3), whole, hear)
    names = [whole.train.view(i).name for i in range(len(whole.train))]
    assert learned == {name for i, name in enumerate(names) if i not in (0, 4)} and len(names) == 6
    fitted = fit(config_of(scene, tmp_path / "other"), dataset=whole)
    assert outcome.psnr != pytest.approx(fitted.metrics()["psnr"], abs=1e-6), "the test views do not judge"


class Halting(Trainer):
    """Presses Ctrl-C in the 15th step."""

    def train_step(self) -> StepReport:
        if self.step == 15 and self.model.count == 40:
            os.kill(os.getpid(), signal.SIGINT)
        return super().train_step()


@posix
def test_interrupted_it_goes_on_to_the_same_end(
    done: tuple[Path, Outcome], scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, heard = tmp_path / "t", list[Event]()
    monkeypatch.setattr(fitting, "Trainer", Halting)
    with pytest.raises(KeyboardInterrupt):
        run_trial(Trial(config_of(scene, folder)))
    monkeypatch.undo()
    record = read_trial(folder)
    assert checkpoint.read_header(folder / "checkpoint.safetensors", "checkpoint")["step"] == 16
    assert record is not None and record.outcome is None
    outcome = run_trial(Trial(config_of(scene, folder)), events=heard.append)
    assert steps_of(heard) == STEPS - 16 and outcome.psnr == done[1].psnr
    assert (folder / "model.safetensors").read_bytes() != b"" and outcome.steps == STEPS


def test_a_run_that_is_no_trial_is_left_alone(scene: Path, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    folder.mkdir()
    (folder / "config.yaml").write_text("mine")
    with pytest.raises(DataError, match=r"run: contains a run, but no trial\.json; expected a new folder"):
        run_trial(Trial(config_of(scene, folder)))
    assert (folder / "config.yaml").read_text() == "mine" and len(list(folder.iterdir())) == 1


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"format": 1}', '{"format": 9, "asked": {}, "views": 8, "outcome": null}']
)
def test_a_damaged_record_is_refused(scene: Path, tmp_path: Path, text: str) -> None:
    (tmp_path / TRIAL_FILE).write_text(text)
    with pytest.raises(DataError, match=r"trial\.json: .*delete its folder to train anew"):
        run_trial(Trial(config_of(scene, tmp_path)))


@posix
def test_launched_trials_equal_those_of_this_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neuprim.runs.launch.executors.machine_cores", lambda: 1)
    scene = tiny.write_blender(tmp_path / "two")
    # The names of the folders are equally long, as the file holds them.
    here, there = (Trial(compose(words(scene, tmp_path / name, 20)), views=2) for name in ("in_1", "in_2"))
    gone = replace(there, config=compose(words(tmp_path / "nowhere", tmp_path / "gone", 20)))
    progress: list[float] = []
    first, second = launch_trials([there, gone], processes(), tmp_path, progress.append)
    expected, found = run_trial(here), first.value
    assert (found.psnr, found.ssim) == (expected.psnr, expected.ssim)
    assert abs(found.bytes - expected.bytes) <= 8, "the header holds the seconds, with more or fewer digits"
    assert second.state == "failed" and "nowhere" in second.line
    assert progress == sorted(progress) and progress[-1] == 1.0 and not (tmp_path / "launch").exists()
