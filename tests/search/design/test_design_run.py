"""``neuprim tradeoff task=…`` on a tiny scene: what it trains, measures, keeps, writes and refuses."""

from __future__ import annotations

import csv
import html
import io
import json
import re
import shlex
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

import neuprim.search.design.session as session
from neuprim.cli import main
from neuprim.config import compose
from neuprim.config.launcher import LauncherSettings
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError, DataError, NonFiniteError
from neuprim.runs.events import Events
from neuprim.runs.fit import fit
from neuprim.runs.open import load_run
from neuprim.search.design.plan import Plan
from neuprim.search.design.record import Model, command
from neuprim.search.design.run import TRIALS, DesignRequest, design_run
from neuprim.search.design.variants import CENTRE, COMBINED
from neuprim.search.tradeoff.record import COLUMNS, Record, read_record
from neuprim.search.trials import Outcome, Trial, read_outcome, run_trial
from tests.core import tiny
from tests.short_runs import words

STEPS = 40
KNOBS = ("model.primitives", "model.neurons", "train.iterations")
"""Knobs that compile nothing more."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


def request(scene: Path, folder: Path, *more: str, **changes: Any) -> DesignRequest:
    """Of a set whose trainings all fit, so that their lengths are those of the words."""
    values: dict[str, Any] = {"budget": 600.0, "views": 2, "repeats": 3, "knobs": KNOBS, **changes}
    return DesignRequest([*words(scene, folder, STEPS), *more], **values)


@pytest.fixture(scope="module")
def measured(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Record]:
    folder, record = design_run(request(scene, tmp_path_factory.mktemp("sets") / "a set"))
    return folder, record


def models(record: Record) -> list[Model]:
    assert all(isinstance(point, Model) for point in record.points)
    return record.points  # type: ignore[return-value]


def names(record: Record) -> set[str]:
    return {model.name for model in models(record) if model.knob != COMBINED}


SINGLES = {
    CENTRE,
    "primitives=20",
    "primitives=80",
    "primitives=10",
    "primitives=160",
    "primitives=5",
    "primitives=2",
    "primitives=1",
    "neurons=0",
    "neurons=2",
    "neurons=8",
    "0.5 of the length",
    "0.25 of the length",
}


# ---------------------------------------------------------------- what is trained


def test_the_centre_every_knob_alone_and_some_together(measured: tuple[Path, Record]) -> None:
    folder, record = measured
    found = models(record)
    assert found[0].name == CENTRE and names(record) == SINGLES and record.left_out == []
    together = [model for model in found if model.knob == COMBINED]
    assert together and all(len(model.turned) > 1 for model in together)
    for model in found:
        config, _, trained, header = load_run(folder / model.run_dir)
        assert config.train.iterations == model.steps == header["iterations"] and trained.count == model.primitives
        assert model.bytes == (folder / model.run_dir / "model.safetensors").stat().st_size
        assert (
            model.seconds > 0
            and model.steps_in_turns
            and len(model.ms) == len(model.ratios) >= 3
            and model.seeds == (model.quality["psnr"],)
        )
    by = {model.name: model for model in found}
    assert (
        by["primitives=80"].primitives == 80
        and by["neurons=0"].parameters_per_primitive < by["neurons=8"].parameters_per_primitive
    )
    plan = Plan.from_dict(record.facts["plan"])
    assert by[CENTRE].steps == STEPS == plan.steps and by["0.25 of the length"].steps == STEPS // 4
    assert all(model.steps == plan.steps_of(model.variant) for model in found) and set(plan.paces) == {
        model.name for model in found
    }
    assert set(by[CENTRE].ratios) == {1.0} and by[CENTRE].bytes > by["primitives=20"].bytes


def test_the_words_of_a_point_train_it(measured: tuple[Path, Record]) -> None:
    _, record = measured
    for number in dict.fromkeys([record.speed[0], record.size[-1]]):
        model = models(record)[number]
        again = fit(compose([*model.words, "output_dir=null"], check_output=False)).metrics()
        assert (
            again["psnr"] == pytest.approx(model.quality["psnr"], abs=1e-6) and again["primitives"] == model.primitives
        )
        assert again["ssim"] == pytest.approx(model.quality["ssim"], abs=1e-6)


def test_quality_is_against_the_truth_and_against_the_exact_image(measured: tuple[Path, Record]) -> None:
    for model in models(measured[1]):
        assert (
            5
            < model.quality["psnr"]
            < 50
            < model.quality["psnr_exact"]  # what alpha_min = 1/255 leaves out is below -48 dB
            and 0 < model.quality["ssim"] <= 1 <= model.quality["ssim_exact"] + 1e-3
        )
    assert measured[1].facts["exact"]["float64"] is True


def test_seeds_are_averaged(scene: Path, tmp_path: Path) -> None:
    folder, record = design_run(request(scene, tmp_path / "set", knobs=("train.iterations",), seeds=2))
    model = models(record)[0]
    outcomes = [read_outcome(folder / TRIALS / name) for name in (CENTRE, f"{CENTRE}_seed-4")]
    kept = [outcome.psnr for outcome in outcomes if outcome is not None]
    assert list(model.seeds) == kept and kept[0] != kept[1] and model.quality["psnr"] == pytest.approx(sum(kept) / 2)
    assert model.seed_spread is not None and record.same["seeds"] == 2
    with pytest.raises(ConfigError, match="holds a set with another seeds; expected the same words"):
        design_run(request(scene, tmp_path / "set", knobs=("train.iterations",)))


# ---------------------------------------------------------------- what is left out


def test_what_does_not_fit_the_budget_is_left_out_and_said(scene: Path, tmp_path: Path) -> None:
    _, record = design_run(request(scene, tmp_path / "set", budget=1e-3))
    assert names(record) == {CENTRE} and models(record)[0].steps == STEPS // 20, (
        "the centre in any case, and not shorter"
    )
    said = {(" ".join(one.words), one.reason) for one in record.left_out}
    assert {text for text, _ in said} >= {"model.neurons=0", "model.primitives=80", "0.25 of the length"}
    assert {reason for _, reason in said} == {"no time left of the budget of 0.001 s"}
    assert (
        "fronts of short trainings" in record.facts["length"]
        and "of 40 that its words or preset say" in record.facts["length"]
    )


def test_a_larger_budget_adds_what_did_not_fit_at_the_same_length(scene: Path, tmp_path: Path) -> None:
    small = design_run(request(scene, tmp_path / "set", budget=1e-3))[1]
    folder, record = design_run(request(scene, tmp_path / "set"))
    assert names(record) == SINGLES and record.left_out == [] and models(record)[0].steps == STEPS // 20
    assert models(record)[0].ms[:1] == models(small)[0].ms[:1], "what was measured stays"
    assert read_record(folder / "tradeoff.json", Model) is not None


def test_what_cannot_be_trained_is_left_out_with_its_reason(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def failing(trial: Trial, dataset: Dataset | None, events: Events) -> Outcome:
        if trial.config.model.neurons == 8:
            raise NonFiniteError("gradient of W1 is not finite")
        return run_trial(trial, dataset, events)

    monkeypatch.setattr(session, "run_trial", failing)
    _, record = design_run(request(scene, tmp_path / "set", knobs=("model.neurons",)))
    assert "neurons=8" not in names(record) and "neurons=0" in names(record)
    assert [(one.words, one.reason) for one in record.left_out] == [
        (("model.neurons=8",), "gradient of W1 is not finite")
    ]
    assert "gradient of W1 is not finite" in (tmp_path / "set" / "tradeoff.html").read_text()


def test_a_word_that_changes_nothing_is_no_model(scene: Path, tmp_path: Path) -> None:
    """The preset of the paper does not say which edge its density has; it is 0."""
    _, record = design_run(request(scene, tmp_path / "set", "preset=paper", knobs=("model.density.edge",)))
    assert "density.edge=2" in names(record) and "density.edge=0" not in names(record)
    assert (("model.density.edge=0",), "the same model as the centre") in [
        (one.words, one.reason) for one in record.left_out
    ]


@pytest.mark.slow
def test_several_are_trained_together_and_the_set_is_the_same(
    scene: Path, measured: tuple[Path, Record], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    batches: list[int] = []

    def together(trials: list[list[Trial]], *args: Any) -> list[list[Outcome] | NonFiniteError]:
        batches.append(len(trials))
        bad = [trial.config.model.neurons == 8 for (trial,) in trials]
        return [
            NonFiniteError("not finite") if wrong else [run_trial(trial)]
            for wrong, (trial,) in zip(bad, trials, strict=True)
        ]

    monkeypatch.setattr(session, "launched_trials", together)
    monkeypatch.setattr("neuprim.runs.launch.executors.machine_cores", lambda: 2)
    _, record = design_run(request(scene, tmp_path / "set", launcher=LauncherSettings("processes")))
    assert max(batches) > 1 and sum(batches) >= len(SINGLES)
    assert names(record) == SINGLES - {"neurons=8"} and [one.reason for one in record.left_out] == ["not finite"]
    assert (
        models(record)[0].name == CENTRE and models(record)[0].quality["psnr"] == models(measured[1])[0].quality["psnr"]
    )


# ---------------------------------------------------------------- what is kept


def test_interrupted_it_goes_on_to_the_same_models(
    scene: Path, measured: tuple[Path, Record], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trained: list[str] = []

    def stopped(trial: Trial, dataset: Dataset | None, events: Events) -> Outcome:
        if len(trained) == 3:
            raise KeyboardInterrupt
        trained.append(trial.config.output_dir.name)
        return run_trial(trial, dataset, events)

    monkeypatch.setattr(session, "run_trial", stopped)
    with pytest.raises(KeyboardInterrupt):
        design_run(request(scene, tmp_path / "set"))
    monkeypatch.undo()
    half = read_record(tmp_path / "set" / "tradeoff.json", Model)
    assert half is not None and models(half)[0].name == CENTRE and len(half.points) == 3

    again: list[str] = []

    def noted(trial: Trial, dataset: Dataset | None, events: Events) -> Outcome:
        again.append(trial.config.output_dir.name)
        return run_trial(trial, dataset, events)

    monkeypatch.setattr(session, "run_trial", noted)
    told: list[str] = []
    _, record = design_run(request(scene, tmp_path / "set"), told.append)
    assert (
        not set(trained) & set(again)
        and names(record) == SINGLES
        and any("3 models trained already are kept" in text for text in told)
    )
    assert [model.steps for model in models(record)][:3] == [model.steps for model in models(half)]
    assert models(record)[0].quality["psnr"] == models(measured[1])[0].quality["psnr"]


def test_what_is_done_is_not_done_again(
    scene: Path, measured: tuple[Path, Record], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, record = measured
    monkeypatch.setattr(session, "run_trial", lambda *args: pytest.fail("trained"))
    monkeypatch.setattr("neuprim.search.design.side_by_side.take_turns", lambda *args: pytest.fail("timed"))
    before = {path: path.read_bytes() for path in (folder / TRIALS).rglob("*") if path.is_file()}
    _, again = design_run(request(scene, folder))
    assert again.points == record.points and again.speed == record.speed
    assert {path: path.read_bytes() for path in (folder / TRIALS).rglob("*") if path.is_file()} == before


def test_other_views_are_measured_anew_and_nothing_is_trained(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = request(scene, tmp_path / "set", knobs=("train.iterations",))
    first = design_run(asked)[1]
    monkeypatch.setattr(
        "neuprim.core.train.trainer.Trainer.run", lambda self: iter(()) if self.finished else pytest.fail("trained")
    )
    told: list[str] = []
    _, record = design_run(DesignRequest(**{**vars(asked), "views": 1}), told.append)
    assert any("measured with views of before; models are kept, and measured anew" in text for text in told)
    assert names(record) == names(first) and models(record)[0].quality["psnr"] != models(first)[0].quality["psnr"]


def test_another_set_is_not_written_over(scene: Path, measured: tuple[Path, Record]) -> None:
    folder, _ = measured
    with pytest.raises(
        ConfigError, match=r"a set: holds a set with another centre; expected the same words, or another output_dir=DIR"
    ):
        design_run(request(scene, folder, "model.neurons=8"))


def test_somebody_s_folder_is_left_alone(scene: Path, tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("x")
    with pytest.raises(ConfigError, match=r"output_dir=.*mine: holds something else; expected a new directory"):
        design_run(request(scene, tmp_path / "mine"))
    with pytest.raises(ConfigError, match=r"notes\.txt: is a file; expected a directory"):
        design_run(request(scene, tmp_path / "mine" / "notes.txt"))
    assert [path.name for path in (tmp_path / "mine").iterdir()] == ["notes.txt"]


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"plan": {"steps": 0, "seconds": 1, "whole": 1, "paces": {}}}, "plan is damaged"),
        ({"plan": 7}, "plan is damaged"),
        ({"points": [{"knob": "x"}]}, "not a record of `neuprim tradeoff`"),
        ({"same": {}}, "of a finished run's drawing; expected another output_dir"),
    ],
)
def test_a_damaged_record_is_refused(
    scene: Path, measured: tuple[Path, Record], tmp_path: Path, change: dict[str, Any], text: str
) -> None:
    record = json.loads((measured[0] / "tradeoff.json").read_text())
    (tmp_path / "tradeoff.json").write_text(json.dumps({**record, **change}))
    with pytest.raises(DataError, match=r"tradeoff\.json: " + text):
        design_run(request(scene, tmp_path))


# ---------------------------------------------------------------- what is written


def test_the_table_has_the_columns_of_the_survey(measured: tuple[Path, Record]) -> None:
    folder, record = measured
    rows = list(csv.DictReader(io.StringIO((folder / "tradeoff.csv").read_text())))
    assert list(rows[0])[: len(COLUMNS)] == list(COLUMNS) and len(rows) == len(record.points)
    for row, model in zip(rows, models(record), strict=True):
        assert (
            row["Submethod"] == model.name
            and int(row["#Gaussians"]) == model.primitives
            and int(row["Size [Bytes]"]) == model.bytes
        )
        assert int(row["training steps"]) == model.steps and float(row["ms per step"]) == pytest.approx(
            model.ms_per_step, abs=1e-3
        )
        assert (
            row["command"] == command(model.words)
            and int(row["numbers per primitive"]) == model.parameters_per_primitive
        )
        assert float(row["PSNR"]) == pytest.approx(model.quality["psnr"], rel=1e-5)


def test_the_page_stands_alone_with_the_pictures_and_words_of_both_fronts(measured: tuple[Path, Record]) -> None:
    folder, record = measured
    page = (folder / "tradeoff.html").read_text()
    assert "http" not in re.sub(r"http-equiv|http://www\.w3\.org/\S+", "", page) and record.facts[
        "length"
    ] in html.unescape(page)
    cards = [number for front in (record.speed, record.size) for number in ([] if 0 in front else [0]) + front]
    codes = [html.unescape(text) for text in re.findall(r"<code>(.*?)</code>", page)]
    assert codes == [command(models(record)[i].words) for i in cards], (
        "the centre stands beside a front that it is not on"
    )
    assert page.count("<img ") == 2 * len(cards) + 2, (
        "each with its difference from the truth, which stands once per front"
    )
    assert all(f"<th scope=row>{html.escape(model.name)}</th>" in page for model in models(record))
    assert Image.open(folder / "front.png").width > 500


def test_the_command_prints_the_fronts_and_the_words_that_train_them(
    scene: Path, measured: tuple[Path, Record], capsys: pytest.CaptureFixture[str]
) -> None:
    folder, record = measured
    flags = ["--views", "2", "--repeats", "3", "--knobs", *KNOBS]
    assert main(["tradeoff", *words(scene, folder, STEPS), "budget=10m", *flags]) == 0
    out, err = capsys.readouterr()
    assert f"{len(record.points)} models trained already are kept" in err and record.facts["length"] in out.replace(
        "\n", " "
    )
    lines = [line.rpartition("  # ")[0] for line in out.splitlines() if line.startswith("neuprim run ")]
    assert lines == [command(models(record)[i].words) for i in (*record.speed, *record.size)]
    for line in lines:
        assert compose(shlex.split(line)[2:], check_output=False).train.population.every >= 1
    assert out.splitlines()[-4:] == [
        str(folder / name) for name in ("tradeoff.json", "tradeoff.csv", "tradeoff.html", "front.png")
    ]


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("typed", "text"),
    [
        (["budget=5"], "budget=5: expected a time such as 90s, 5m or 1h"),
        (["budget=5m", "--budget", "5m"], "budget=5m and --budget 5m: expected one of them"),
        (["--budget", "5"], "--budget 5: expected a time such as 90s, 5m or 1h"),
        (
            ["--knobs", "model.neuron"],
            "--knobs model.neuron: no such knob of a model of task 'static'; did you mean 'model.neurons'",
        ),
        (["model.primitive=3"], "model.primitive: no such setting; did you mean 'model.primitives'"),
        (["scene=solid"], "scene=solid"),
        (["model.neurons=2,4"], "model.neurons=2,4: several values"),
        (["--seed", "2"], "--seed: no such argument of `neuprim tradeoff`"),
    ],
)
def test_wrong_words_are_one_line(
    typed: list[str], text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["tradeoff", "task=static", f"output_dir={tmp_path / 'set'}", *typed]) == 2
    out, err = capsys.readouterr()
    assert (
        out == ""
        and err.startswith(f"neuprim: error: {text}")
        and err.count("\n") == 1
        and not (tmp_path / "set").exists()
    )


def test_seeds_are_of_trainings(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["tradeoff", str(tmp_path), "--seeds", "2"]) == 2
    assert "--seeds: of models that are trained" in capsys.readouterr().err


def test_an_interruption_says_what_goes_on(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def stop(*args: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(session, "run_trial", stop)
    assert main(["tradeoff", *words(scene, tmp_path / "set", STEPS), "--knobs", "train.iterations"]) == 130
    assert "; what is trained is kept, and the same command goes on" in capsys.readouterr().err


def test_without_a_place_it_is_among_the_outputs(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    typed = [word for word in words(scene, tmp_path, STEPS) if not word.startswith("output_dir=")]
    folder, _ = design_run(DesignRequest(typed, 1e-3, 1, 1))
    assert folder == Path("outputs/tradeoff-static-blender") and (folder / "tradeoff.html").exists()
