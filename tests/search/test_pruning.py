"""`neuprim prune`: what it writes and says, what it refuses, and that every command reads what is left."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from neuprim.cli import main
from neuprim.config import RunConfig
from neuprim.core import checkpoint
from neuprim.core.errors import ConfigError
from neuprim.runs.export import export_run, import_run_directory
from neuprim.runs.measure import evaluate_run
from neuprim.runs.open import load_run
from neuprim.runs.render_images import RenderRequest, render_run
from neuprim.search import pruning
from neuprim.search.compress import CompressRequest, compress_run
from neuprim.search.pruning import PruneRequest, Pruning, prune_run
from neuprim.search.pruning_cuts import count_unpruned_numbers
from tests.core import tiny
from tests.search.tradeoff_runs import copied
from tests.short_runs import fit, words

TOLERANCE = 1.0


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Forty primitives for two, and degree 3 for what is matte; all there from the start, so that none hides behind its
    parent, where it could go for nothing."""
    folder = tmp_path_factory.mktemp("whole")
    return fit(words(tiny.write_blender(folder / "two"), folder / "run", 240, "train.population.grow_from=1"))


@pytest.fixture(scope="module")
def made(whole: Path) -> Pruning:
    return prune_run(PruneRequest(whole, TOLERANCE, steps=0))


@pytest.fixture(scope="module")
def left(made: Pruning) -> Path:
    assert made.run_dir is not None
    return made.run_dir


# ---------------------------------------------------------------- what it does


def test_less_is_left_and_training_views_lose_no_more_than_the_tolerance(made: Pruning) -> None:
    assert made.after["numbers"] < 0.8 * made.before["numbers"] and made.after["bytes"] < made.before["bytes"]
    assert made.judged_psnr[0] - made.judged_psnr[1] <= TOLERANCE + 1e-6
    assert made.steps == 0 and all(stage.cut == stage.trained for stage in made.stages)


def test_the_run_of_what_is_left_is_a_run(whole: Path, left: Path, made: Pruning) -> None:
    config = RunConfig.from_yaml(left / "config.yaml")
    stored = load_run(left)
    model, header = stored.model, stored.header
    assert (
        model.count == made.after["primitives"] == config.model.primitives
        and count_unpruned_numbers(model) == made.after["numbers"]
    )
    assert header["iterations"] == 240 and config.output_dir == left
    found, recorded = evaluate_run(left), json.loads((left / "metrics.json").read_text())
    assert found["psnr"] == pytest.approx(made.after["psnr"], abs=1e-4) == pytest.approx(recorded["psnr"], abs=1e-4)
    assert found["model_bytes"] == (left / "model.safetensors").stat().st_size == made.after["bytes"]
    assert (left / "report.html").exists() and any((left / "renders").iterdir())
    assert evaluate_run(whole)["psnr"] == pytest.approx(made.before["psnr"], abs=1e-4)
    record = json.loads((left / "pruned.json").read_text())
    assert (
        record["pruned_from"] == str(whole)
        and record["tolerance"] == TOLERANCE
        and record["reduced"] == list(made.reduced)
    )


def test_every_command_reads_it(left: Path, tmp_path: Path) -> None:
    assert render_run(left, RenderRequest("test", out=tmp_path / "drawn", frames=4))
    export_run(left, "npz", tmp_path / "model.npz")
    again = import_run_directory(tmp_path / "model.npz", tmp_path / "again")
    assert evaluate_run(again)["psnr"] == pytest.approx(evaluate_run(left)["psnr"], abs=1e-5)
    small = compress_run(CompressRequest(left, level=1, out=tmp_path / "small.neuprim"))
    back, _ = checkpoint.load_model_checkpoint(small.file, load_run(left).task)
    model = load_run(left).model
    assert count_unpruned_numbers(back) <= count_unpruned_numbers(model)  # what is zero comes back as zero
    assert small.measured["psnr"][0] - small.measured["psnr"][1] < 0.2


def test_training_goes_on_where_it_was_left_and_what_is_gone_stays_gone(left: Path, tmp_path: Path) -> None:
    copy = copied(left, tmp_path / "on")
    config = RunConfig.from_yaml(copy / "config.yaml")
    typed = [word for word in config.overrides if not word.startswith(("train.iterations=", "output_dir=", "resume="))]
    before = load_run(copy).model
    fit([*typed, f"output_dir={copy}", "resume=true", "train.iterations=300", "train.population.strategy=fixed"])
    after = load_run(copy).model
    assert checkpoint.read_header(copy / "checkpoint.safetensors", "checkpoint")["step"] == 300
    assert after.count == before.count and count_unpruned_numbers(after) <= count_unpruned_numbers(before)
    assert not torch.equal(after.params["means"], before.params["means"])


def test_with_steps_more_may_go_and_the_result_is_the_same_again(whole: Path, made: Pruning, tmp_path: Path) -> None:
    runs = [prune_run(PruneRequest(whole, TOLERANCE, steps=100, out=tmp_path / str(i))) for i in range(2)]
    assert runs[0].steps == 100 and runs[0].judged_psnr[0] - runs[0].judged_psnr[1] <= TOLERANCE + 1e-6
    assert runs[0].after["numbers"] < made.before["numbers"] and runs[0].stages[0].cut < runs[0].stages[0].trained
    assert [s.numbers for s in runs[0].stages] == [s.numbers for s in runs[1].stages]
    a, b = (load_run(r.run_dir).model for r in runs if r.run_dir is not None)
    assert all(torch.equal(a.params[name], b.params[name]) for name in a.params)


@pytest.fixture
def nothing_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    """A model without anything to cut: of this one, single numbers may go by which it is better."""
    monkeypatch.setattr(pruning, "cut_to_loss", lambda model, *rest: model)
    monkeypatch.setattr(pruning, "list_pruning_reductions", lambda model: [])


@pytest.mark.usefixtures("nothing_goes")
def test_where_nothing_can_go_nothing_is_written(whole: Path, tmp_path: Path) -> None:
    made = prune_run(PruneRequest(whole, 1e-6, steps=0, out=tmp_path / "out"))
    assert made.run_dir is None and not (tmp_path / "out").exists() and made.before == made.after


# ---------------------------------------------------------------- what it says


def test_the_command_prints_what_was_kept(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "small"
    assert main(["prune", str(whole), "--tolerance", "1dB", "--seconds", "0", "--out", str(out)]) == 0
    text = capsys.readouterr().out
    assert str(out) in text and "before" in text and "PSNR, held-out views" in text and "frames/s" in text
    assert "of its numbers are kept" in text or "all primitives:" in text


def test_what_is_there_is_not_replaced(whole: Path, left: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="exists and is not empty"):
        prune_run(PruneRequest(whole, TOLERANCE, steps=0))
    with pytest.raises(ConfigError, match="is the run itself"):
        prune_run(PruneRequest(whole, TOLERANCE, steps=0, out=whole, overwrite=True))
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="is a file"):
        prune_run(PruneRequest(whole, TOLERANCE, steps=0, out=tmp_path / "file"))
