"""Runs in chunks, small and whole: what they leave, that every command reads it, and that what is done is not done
again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any, cast

import pytest
import torch

from neuprim.cli import main
from neuprim.config import compose
from neuprim.core import checkpoint
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.vdb import write_vdb
from neuprim.core.train.process_group import ProcessGroup
from neuprim.runs import sweep
from neuprim.runs.fit import Event, Note, Preparing, Step, fit, ignore_run_event
from neuprim.runs.open import load_run, read_metrics
from neuprim.runs.run import CHUNKS_FILE, ChunksMissing, run
from neuprim.runs.sweep import read_launch_record
from neuprim.tasks.dynamic.time_density import TimeDensity
from tests.short_runs import command_line
from tests.tasks.dynamic.sequences import blob

NAMES = ["frames_1-4", "frames_3-6"]
STEPS = 100


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ball")
    for number in range(1, 7):
        write_vdb(folder / f"ball_{number}.vdb", blob(5.0 + 2 * number))
    return folder


def words(files: Path, out: Path, *more: str) -> list[str]:
    return [
        "task=dynamic", "scene=vdb", f"scene.vdb='{files}'", "scene.look=smoke_fire", "scene.size=24",
        "scene.cameras=6", "scene.samples=1",
        "scene.chunks=2", "model.primitives=80", f"train.iterations={STEPS}", "train.population.every=10",
        "train.eval_every=0.5", "train.rates.log_gain=0.2",  # 40 steps a chunk learn little with the preset's rate
        "train.log_every=10", f"output_dir='{out}'", *more,
    ]  # fmt: skip


@pytest.fixture(scope="module")
def told() -> list[Event]:
    return []


@pytest.fixture(scope="module")
def finished(files: Path, told: list[Event], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run(compose(words(files, tmp_path_factory.mktemp("runs") / "whole")), told.append)


def model_of(folder: Path) -> dict[str, torch.Tensor]:
    return checkpoint.read_tensors(folder / "model.safetensors", "model")[1]


# ---------------------------------------------------------------- what it is


def test_one_model_of_two_chunks_with_the_whole_number_of_primitives(finished: Path) -> None:
    stored = load_run(finished)
    config, model, header = stored.config, stored.model, stored.header
    assert config.scene["chunks"] == 2 and model.count == 80
    assert isinstance(model.density, TimeDensity) and len(model.density.seams) == 1
    assert model.density.seams[0] == pytest.approx((0.4, 0.6))
    own = [load_run(finished / "chunks" / name) for name in NAMES]
    counts = [int((model.params["chunk"] == number).sum()) for number in range(2)]
    assert counts == [chunk.model.count for chunk in own]
    assert header["iterations"] == STEPS
    assert [(chunk.config.train.iterations, chunk.config.train.population.every) for chunk in own] == [(40, 4)] * 2


def test_it_is_judged_on_all_frames_and_has_learned(finished: Path) -> None:
    metrics = read_metrics(finished)
    assert len(metrics["per_frame"]) == 6 and metrics["psnr_mask"] > metrics["psnr_black_image_mask"] + 2
    assert len(read_metrics(finished / "chunks" / NAMES[0])["per_frame"]) == 4
    assert metrics["train_seconds"] > sum(read_metrics(finished / "chunks" / name)["train_seconds"] for name in NAMES)
    assert (finished / "report.html").is_file() and (finished / "renders" / "clip_cam_04.webp").is_file()


def test_progress_is_that_of_all_chunks_and_then_of_the_joined_model(finished: Path, told: list[Event]) -> None:
    said = [event for event in told if isinstance(event, Preparing) and "chunks" in event.text]
    assert said[0].text == "fitting 2 chunks (0 done)" and said[-1].text == "fitting 2 chunks (2 done)"
    assert [event.fraction for event in said] == sorted(event.fraction for event in said) and said[-1].fraction == 1.0
    steps = [event.report.step for event in told if isinstance(event, Step)]
    assert steps == list(range(81, 101))


def test_a_chunk_is_a_run_that_can_be_made_by_hand(finished: Path, tmp_path: Path) -> None:
    config = load_run(finished / "chunks" / NAMES[1]).config
    assert config.scene["span"] == "3:6" and config.scene["chunks"] is None
    again = run(compose([*config.overrides, f"output_dir='{tmp_path / 'again'}'"]))
    first, second = model_of(finished / "chunks" / NAMES[1]), model_of(again)
    assert first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first)


@pytest.mark.slow
def test_every_command_reads_it(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for command in (
        ["eval", str(finished)],
        ["render", str(finished), "--camera", "orbit", "--time", "0:1:3", "--out", str(tmp_path / "images")],
        ["export", str(finished), "--format", "vdb", "--out", str(tmp_path / "vdb")],
        ["export", str(finished), "--format", "html", "--out", str(tmp_path / "page.html")],
        ["export", str(finished), "--format", "npz", "--out", str(tmp_path / "model.npz")],
        ["import", str(tmp_path / "model.npz"), "--out", str(tmp_path / "imported")],
        ["compress", str(finished), "--out", str(tmp_path / "small.neuprim")],
    ):
        assert main(command) == 0, (command, capsys.readouterr().err)
    back = load_run(tmp_path / "imported").model
    assert isinstance(back.density, TimeDensity) and len(back.density.seams) == 1


# ---------------------------------------------------------------- going on


def test_what_is_done_is_kept(finished: Path, files: Path, tmp_path: Path) -> None:
    """The joined model's training, too, goes on where it was left."""
    shutil.copytree(finished, tmp_path / "copy")
    before = {name: (tmp_path / "copy" / "chunks" / name / "model.safetensors").stat().st_mtime_ns for name in NAMES}
    told: list[Event] = []
    run(compose(words(files, tmp_path / "copy", "resume=true")), told.append)
    assert not [event for event in told if isinstance(event, Step)]
    for name, when in before.items():
        assert (tmp_path / "copy" / "chunks" / name / "model.safetensors").stat().st_mtime_ns == when
    assert all(torch.equal(value, model_of(finished)[name]) for name, value in model_of(tmp_path / "copy").items())


def test_one_that_fails_does_not_stop_the_others_and_is_all_that_is_made_again(
    files: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sweep, "FIT_JOB", f"{__name__}:{_fail_first.__name__}")
    out, told = tmp_path / "run", list[Event]()
    with pytest.raises(
        ChunksMissing,
        match=r"frames_1-4: no luck; 1 of 2 chunks are finished; run again with resume=true --out \S+ to train",
    ):
        run(compose(words(files, out)), told.append)
    assert [event.text.partition("chunks/")[2] for event in told if isinstance(event, Note)] == ["frames_1-4: no luck"]
    record = read_launch_record(out / CHUNKS_FILE)
    assert record is not None and [(row.state, row.line) for row in record.runs] == [
        ("failed", "no luck"),
        ("done", ""),
    ]
    monkeypatch.undo()
    when = (out / "chunks" / NAMES[1] / "model.safetensors").stat().st_mtime_ns
    run(compose(words(files, out, "resume=true")))
    assert (out / "chunks" / NAMES[1] / "model.safetensors").stat().st_mtime_ns == when
    assert all(torch.equal(value, model_of(finished)[name]) for name, value in model_of(out).items())


def _fail_first(data: Any, attempt: int, events: Any) -> str:
    from neuprim.runs.run import fit_job

    if str(data["output_dir"]).endswith(NAMES[0]):
        raise DataError("no luck")
    return fit_job(data, attempt, events)


def test_other_chunks_than_it_was_begun_with_are_refused(finished: Path, files: Path, tmp_path: Path) -> None:
    shutil.copytree(finished, tmp_path / "copy")
    with pytest.raises(
        ConfigError,
        match=r"chunks.json: contains the runs frames_1-4, .* now give frames_1-3, .*; expected the same settings",
    ):
        run(compose(words(files, tmp_path / "copy", "scene.chunks=3", "resume=true")))
    (tmp_path / "copy" / "chunks.json").write_text("{}")
    with pytest.raises(DataError, match=r"chunks.json: not a record of launched runs"):
        run(compose(words(files, tmp_path / "copy", "resume=true")))


def test_a_budget_in_seconds_is_shared_out_and_the_joined_steps_are_kept(files: Path, tmp_path: Path) -> None:
    out = run(compose(words(files, tmp_path / "run", "train.iterations=null", "train.max_seconds=0.5")))
    record = json.loads((out / "chunks.json").read_text())
    assert ["train.max_seconds=0.2" in run["words"] for run in record["runs"]] == [True] * 2
    assert record["joined_steps"] >= 1
    assert read_metrics(out)["iterations"] == round(record["joined_steps"] / 0.2)


# ---------------------------------------------------------------- when it is not


def test_few_frames_in_auto_are_one_run(files: Path, tmp_path: Path) -> None:
    told: list[Event] = []
    automatic = run(
        compose([*words(files, tmp_path / "auto"), "train.iterations=10", "scene.chunks=auto"]), told.append
    )
    assert Note("scene.chunks=auto: fitted as one run") in told and not (automatic / "chunks.json").exists()
    plain = run(compose([*words(files, tmp_path / "plain"), "train.iterations=10", "scene.chunks=null"]))
    one = run(compose([*words(files, tmp_path / "one"), "train.iterations=10", "scene.chunks=1"]))
    for other in (automatic, one):
        assert all(torch.equal(value, model_of(plain)[name]) for name, value in model_of(other).items())


@pytest.mark.parametrize(
    ("typed", "said"),
    [
        (
            ["scene.chunks=4"],
            "scene.chunks=4: there are 6 frames for training; expected at most 3, because a chunk needs at least "
            "two training frames",
        ),
        (["model.primitives=9"], "model.primitives=9: expected at least 16 for 2 chunks"),
        (
            ["scene.chunks=2", "viewer=true"],
            "scene.chunks=2: viewer=true shows one training; expected scene.chunks=null",
        ),
    ],
)
def test_what_cannot_be_is_said_in_one_line(
    typed: list[str], said: str, files: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", *command_line(words(files, tmp_path / "run")), *typed]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == f"neuprim: error: {said}"


def test_what_trains_one_model_at_once_says_so(files: Path, tmp_path: Path) -> None:
    config = compose(words(files, tmp_path / "run"))
    with pytest.raises(ConfigError, match=r"scene.chunks=2: this function trains one model"):
        fit(config)
    with pytest.raises(ConfigError, match=r"scene.chunks=2: several ranks train one model together"):
        run(config, ignore_run_event, group=cast(ProcessGroup, _Two()))
    assert not (tmp_path / "run").exists()


class _Two:
    size, is_first = 2, True
