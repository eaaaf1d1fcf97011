"""``neuprim tradeoff task=…`` on a tiny scene: what it trains, measures, keeps, writes and refuses."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from neuprim.cli import main
from neuprim.config import compose
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError, DataError, NonFiniteError
from neuprim.runs.fit import Events, fit
from neuprim.runs.launch.jobs import JobResult
from neuprim.runs.open import load_run
from neuprim.search import ablation, ablation_plan, trials
from neuprim.search.ablation import run_ablation
from neuprim.search.ablation_plan import CENTRE, AblationPlan, Variant, plan_training_lengths
from neuprim.search.tradeoff_measuring import TradeoffRequest
from neuprim.search.tradeoff_record import COMBINED, TradeoffRecord, read_tradeoff_record
from neuprim.search.trials import Outcome, Trial, run_trial
from tests.core import tiny
from tests.short_runs import command_line, words

STEPS = 40
KNOBS = ("model.primitives", "model.neurons", "train.iterations")
"""Knobs that compile nothing more."""

SINGLES = {
    *(CENTRE, "neurons=0", "neurons=2", "neurons=8", "0.5 of the length", "0.25 of the length"),
    *("primitives=20", "primitives=80"),
}


@pytest.fixture(scope="module", autouse=True)
def small_sets() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ablation_plan, "_COUNTS", (0.5, 2.0))
        patch.setattr(ablation, "_MAX_COMBINATIONS", 2)
        yield


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


def request(scene: Path, folder: Path, *more: str, **changes: Any) -> TradeoffRequest:
    values: dict[str, Any] = {"budget": 600.0, "views": 2, "repeats": 3, "knobs": KNOBS, **changes}
    return TradeoffRequest([*words(scene, folder, STEPS), *more], out=folder, **values)


@pytest.fixture(scope="module")
def measured(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, TradeoffRecord]:
    return run_ablation(request(scene, tmp_path_factory.mktemp("sets") / "a set"))


def names(record: TradeoffRecord) -> set[str]:
    return {point.name for point in record.points if point.knob != COMBINED}


def test_the_centre_every_knob_alone_and_some_together(measured: tuple[Path, TradeoffRecord]) -> None:
    folder, record = measured
    assert record.points[0].name == CENTRE and names(record) == SINGLES and record.left_out == []
    assert any(point.knob == COMBINED and len(point.turned) > 1 for point in record.points)
    plan = AblationPlan(**record.facts["plan"])
    for point in record.points:
        stored = load_run(folder / point.run_dir)
        config, model = stored.config, stored.model
        assert config.train.iterations == point.steps and model.count == point.primitives
        assert point.steps == max(1, round(STEPS * point.length / plan.paces[point.name]))
        assert point.bytes == (folder / point.run_dir / "model.safetensors").stat().st_size
        assert point.seconds > 0 and len(point.ms) == len(point.ratios) >= 3
    assert set(record.points[0].ratios) == {1.0} and read_tradeoff_record(folder / "tradeoff.json") == record
    page = (folder / "tradeoff.html").read_text(encoding="utf-8")
    assert "neuprim run" in page and (folder / "front.png").exists()


def test_the_overrides_of_a_point_train_it(measured: tuple[Path, TradeoffRecord]) -> None:
    point = measured[1].points[measured[1].size[-1]]
    again = fit(compose([*point.words, "output_dir=null"], check_output=False)).metrics()
    assert again["psnr"] == pytest.approx(point.quality["psnr"], abs=1e-6)
    assert again["primitives"] == point.primitives


def test_what_does_not_fit_is_left_out_until_the_budget_grows(scene: Path, tmp_path: Path) -> None:
    _, record = run_ablation(request(scene, tmp_path / "set", budget=1e-3))
    assert names(record) == {CENTRE} and record.points[0].steps == STEPS // 20
    assert {one.reason for one in record.left_out} == {"no time left of the budget of 0.001 s"}
    _, larger = run_ablation(request(scene, tmp_path / "set"))
    assert names(larger) == SINGLES and larger.left_out == [] and larger.points[0].steps == STEPS // 20
    assert larger.points[0].ms[:1] == record.points[0].ms[:1], "earlier measurements stay"


def test_failures_and_equal_models_are_left_out(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(trial: Trial, dataset: Dataset | None, events: Events) -> Outcome:
        if trial.config.model.neurons == 8:
            raise NonFiniteError("gradient of W1 is not finite")
        return run_trial(trial, dataset, events)

    knob = "model.neurons"
    offered = [Variant(knob, (f"{knob}={n}",)) for n in (2, 4, 8)]
    monkeypatch.setattr(ablation, "list_variants", lambda *args: {knob: offered})
    monkeypatch.setattr(trials, "run_trial", failing)
    _, record = run_ablation(request(scene, tmp_path / "set", knobs=(knob,)))
    assert names(record) == {CENTRE, "neurons=2"}
    assert {one.words[0]: one.reason for one in record.left_out} == {
        "model.neurons=4": "the same model as the centre",
        "model.neurons=8": "gradient of W1 is not finite",
    }


def test_an_interrupted_set_continues_with_trainings_launched_together(
    scene: Path, measured: tuple[Path, TradeoffRecord], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches: list[int] = []

    def launch(wanted: list[Trial], settings: LauncherSettings, *args: Any) -> list[JobResult]:
        if len(batches) == 1:
            raise KeyboardInterrupt
        batches.append(len(wanted))
        return [JobResult("done", run_trial(trial)) for trial in wanted]

    monkeypatch.setattr(ablation, "launch_trials", launch)
    monkeypatch.setattr("neuprim.runs.launch.executors.machine_cores", lambda: 2)
    again = request(scene, tmp_path / "set", knobs=("model.neurons",))
    with pytest.raises(KeyboardInterrupt):
        run_ablation(again, launcher=LauncherSettings("processes"))
    monkeypatch.undo()
    half = read_tradeoff_record(tmp_path / "set" / "tradeoff.json")
    assert batches == [2] and half is not None and names(half) == {CENTRE, "neurons=2"}
    _, record = run_ablation(again)
    assert names(record) == {CENTRE, "neurons=0", "neurons=2", "neurons=8"}
    assert record.points[0].quality["psnr"] == measured[1].points[0].quality["psnr"]


def test_folders_that_hold_something_else_are_refused(
    scene: Path, tmp_path: Path, measured: tuple[Path, TradeoffRecord]
) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "a").touch()
    with pytest.raises(ConfigError, match="has other files"):
        run_ablation(request(scene, tmp_path / "mine"))
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="is a file"):
        run_ablation(request(scene, tmp_path / "file"))
    with pytest.raises(ConfigError, match="has trainings with another centre"):
        run_ablation(request(scene, measured[0], "model.neurons=3"))
    TradeoffRecord({}, {}, measured[1].points[:1]).write(tmp_path / "tradeoff.json")
    with pytest.raises(DataError, match="is about a finished run"):
        run_ablation(request(scene, tmp_path))
    with pytest.raises(ConfigError, match="no such setting of a model"):
        run_ablation(request(scene, tmp_path / "set", knobs=("model.neuron",)))


def test_the_command(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    typed = command_line(words(scene, tmp_path / "set", 20))
    flags = ["--views", "1", "--repeats", "1", "--vary", "train.iterations"]
    assert main(["tradeoff", *typed, "budget=60s", *flags]) == 0
    out = capsys.readouterr().out
    assert "Every model trains for the same time" in out and "front of size" in out and "neuprim run" in out
    assert (tmp_path / "set" / "tradeoff.json").is_file()
    assert main(["tradeoff"]) == 2
    assert "expected RUN_DIR, or task=NAME scene=NAME" in capsys.readouterr().err


def test_lengths_fit_the_budget(scene: Path, tmp_path: Path) -> None:
    centre = compose(words(scene, tmp_path / "a", 1000), check_output=False)
    assert plan_training_lengths(centre, 0.1, 60.0, [1.0, 0.5, 0.5]).steps == 300
    assert (
        plan_training_lengths(centre, 0.1, 1e9, [1.0]).steps == 1000
        and plan_training_lengths(centre, 0.1, 0.0, [1.0]).steps == 50
    )
    plan = plan_training_lengths(centre, 0.1, 60.0, [1.0, 0.5, 0.5])
    plan.paces["neurons=8"] = 2.0
    trained = plan.overrides(Variant("model.neurons", ("model.neurons=8",)), ["model.neurons=4", "seed=3"], centre)
    assert trained[:3] == ["seed=3", "model.neurons=8", "train.iterations=150"]
