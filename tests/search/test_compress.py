"""`neuprim compress`: what it writes and says, and that every command reads it as it reads the run itself."""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.cli import main
from neuprim.core import checkpoint
from neuprim.core.compression.quantizers import LEVELS
from neuprim.core.errors import CheckpointError, ConfigError, DataError
from neuprim.runs.export import import_run_directory
from neuprim.runs.measure import evaluate_run
from neuprim.runs.open import load_dataset, load_run, model_file
from neuprim.search import compress
from neuprim.search.compress import Compression, CompressRequest
from neuprim.search.model_quality import SearchQuality
from tests.search.tradeoff_runs import tiny_run


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose data are there."""
    return tiny_run(tmp_path_factory.mktemp("whole"))


@pytest.fixture(scope="module")
def small(whole: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The same run, whose one model is a compressed one."""
    copy = tmp_path_factory.mktemp("compressed") / "small"
    shutil.copytree(whole, copy)
    compress_run(copy, level=3)
    (copy / "model.safetensors").unlink()
    (copy / "checkpoint.safetensors").unlink()
    return copy


def compress_run(run_dir: Path, **options: Any) -> Compression:
    return compress.compress_run(CompressRequest(run_dir, **options))


def error_line(capsys: pytest.CaptureFixture[str]) -> str:
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("neuprim: error: ") and err.count("\n") == 1
    return err


# ---------------------------------------------------------------- what it writes and says


def test_the_command_says_what_became_of_every_parameter(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "m.neuprim"
    command = ["compress", str(whole), "--seconds", "0", "--level", "2", "--out", str(out)]
    assert main([*command, "bits.W1=12", "bits.means=20", "bits.sh_rest=9,7"]) == 0
    lines = capsys.readouterr().out.splitlines()
    model = load_run(whole).model
    rows = {line.split()[0]: line.split()[1:] for line in lines[2 : 2 + len(model.specs)]}
    assert lines[0] == str(out) and rows.keys() == model.params.keys()
    assert all(int(rows[s.name][-3].replace(",", "")) == 4 * model.count * s.size for s in model.specs)
    assert rows["W1"][0] == "12" and rows["means"][0] == "20" and rows["sh_rest"][:3] == ["7", "to", "9"]
    total = lines[2 + len(model.specs)]
    assert total.startswith("all, and the header") and f"{out.stat().st_size:,}" in total
    (psnr,) = [line for line in lines if line.startswith("psnr")]
    before, after = map(float, re.findall(r"(\d+\.\d+)", psnr)[:2])
    assert before == pytest.approx(evaluate_run(whole)["psnr"], abs=2e-3) and 0.0 < abs(before - after) < 0.5


def test_what_is_measured_is_what_eval_measures_and_again_it_is_the_same(
    whole: Path, small: Path, tmp_path: Path
) -> None:
    made = compress_run(whole, level=3, out=tmp_path / "m")
    found = [evaluate_run(d) for d in (whole, small)]
    for name in ("psnr", "ssim"):
        assert made.measured[name] == pytest.approx([f[name] for f in found], abs=1e-4)
    assert found[1]["model_bytes"] == (small / "model.neuprim").stat().st_size == made.after
    assert 4 * found[0]["parameters"] == made.before and found[1]["iterations"] == found[0]["iterations"] == 60
    again = compress_run(small, level=3, out=tmp_path / "again")
    assert again.file.read_bytes() == (small / "model.neuprim").read_bytes()


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--level", "9"], "--level 9: expected one of 1, 2, 3, 4, 5"),
        (["--tolerance", "0dB"], "expected decibels above 0"),
        (
            ["--tolerance", "0.2", "--level", "3"],
            "--tolerance 0.2: the tolerance determines the bits of all numbers; leave --level out",
        ),
        (["--tolerance", "0.2dB", "bits.W1=3"], "leave bits.NAME=BITS out"),
        (["bits.sh=3"], "no parameter 'sh'; did you mean"),
        (["W1=3"], "W1=3: no setting of `neuprim compress`; expected bits.NAME=BITS"),
        (["--output", "m"], "--output: no such argument of `neuprim compress`; did you mean '--out'"),
    ],
)
def test_wrong_words(whole: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str) -> None:
    assert main(["compress", str(whole), "--seconds", "0", *more]) == 2
    assert message in error_line(capsys) and not (whole / "model.neuprim").exists()


def test_a_file_in_the_way_stays(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "m.neuprim"
    out.write_bytes(b"mine")
    with pytest.raises(ConfigError, match="already exists; pass --force to replace it"):
        compress_run(whole, level=3, out=out)
    with pytest.raises(ConfigError, match="is a folder"):
        compress_run(whole, level=3, out=tmp_path)
    assert out.read_bytes() == b"mine"
    compress_run(whole, level=3, out=out, overwrite=True)
    assert out.read_bytes()[1:8] == b"NEUPRIM"


def test_the_best_of_both_is_read(whole: Path, tmp_path: Path) -> None:
    """A run keeps its model. The compressed one is read where it is gone."""
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    compress_run(run, level=5)
    exact = checkpoint.read_tensors(whole / "model.safetensors", "model")[1]
    assert model_file(run) == run / "model.safetensors" and torch.equal(load_run(run).model.params["b1"], exact["b1"])
    (run / "model.safetensors").unlink()
    assert model_file(run) == run / "model.neuprim" and not torch.equal(load_run(run).model.params["b1"], exact["b1"])
    (run / "model.neuprim").unlink()
    with pytest.raises(CheckpointError, match=r"model\.safetensors: no such model"):
        load_run(run)


# ---------------------------------------------------------------- as few bits as views allow


@pytest.mark.parametrize("steps", [0, 80])
def test_training_views_decide_how_coarse_numbers_are(whole: Path, tmp_path: Path, steps: int) -> None:
    stored = load_run(whole)
    config, task, model = stored.config, stored.task, stored.model
    quality = SearchQuality.of_run(config, load_dataset(stored))
    base, sizes = quality(model), []
    for tolerance in (0.05, 0.3, 1.5):
        made = compress_run(whole, tolerance=tolerance, steps=steps, out=tmp_path / f"{tolerance}")
        assert base - quality(checkpoint.load_model_checkpoint(made.file, task)[0]) <= tolerance + 1e-4
        assert made.steps == steps and any("the last bit of every number" in note for note in made.notes)
        sizes.append(sum(parameter.after for parameter in made.parameters))
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < 0.9 * sizes[0]
    again = compress_run(whole, tolerance=1.5, steps=steps, out=tmp_path / "again")
    assert again.file.read_bytes() == made.file.read_bytes()


def test_the_command_trains_for_few_bits(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plain, trained = (compress_run(whole, level=5, steps=n, out=tmp_path / str(n)) for n in (0, 60))
    assert trained.measured["psnr"][1] > plain.measured["psnr"][1]
    out = tmp_path / "again"
    assert main(["compress", str(whole), "--level", "5", "--steps", "60", "--out", str(out)]) == 0
    assert "with 60 steps of training" in capsys.readouterr().out and out.read_bytes() == trained.file.read_bytes()


def test_without_data_nothing_is_trained_and_it_is_said(whole: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(whole, copy)
    config = (copy / "config.yaml").read_text()
    (copy / "config.yaml").write_text(re.sub(r"(?m)^(\s+path: ).*$", r"\1/nowhere", config))
    made = compress_run(copy, steps=40)
    assert made.steps == 0 and any("it was not trained for few bits" in note for note in made.notes)
    assert made.measured == {}
    *_, measured, bits = compress_run(copy, steps=0, overwrite=True).notes
    assert measured.startswith("the loss was not measured, as") and bits.endswith("of --level 3")
    assert (copy / "model.neuprim").read_bytes() == compress_run(copy, level=3, out=tmp_path / "m").file.read_bytes()


# ---------------------------------------------------------------- every command


def test_import_makes_a_run_directory_of_the_file_alone(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, run = tmp_path / "sent by somebody", tmp_path / "run"
    shutil.copyfile(small / "model.neuprim", file)
    assert main(["import", str(file), "--out", str(run)]) == 0
    assert capsys.readouterr().out == f"{run}\n"
    assert sorted(p.name for p in run.iterdir()) == ["config.yaml", "model.neuprim"]
    assert (run / "config.yaml").read_bytes() == (small / "config.yaml").read_bytes()
    assert evaluate_run(run)["psnr"] == pytest.approx(evaluate_run(small)["psnr"], abs=1e-6)


def test_files_that_import_refuses(small: Path, tmp_path: Path) -> None:
    (tmp_path / "cut.neuprim").write_bytes((small / "model.neuprim").read_bytes()[:-1])
    checkpoint.save_compressed(tmp_path / "bare.neuprim", load_run(small).model, "static", {}, LEVELS[3])
    (tmp_path / "wrong.neuprim").write_bytes(b"something else")
    for name, error, message in (
        ("cut", CheckpointError, r"cut\.neuprim: the table states"),
        ("bare", DataError, r"bare\.neuprim: contains no config\.yaml"),
        ("wrong", ConfigError, r"cannot import \.neuprim files; expected a file of `neuprim compress`"),
    ):
        with pytest.raises(error, match=message):
            import_run_directory(tmp_path / f"{name}.neuprim", tmp_path / "out")
    assert not (tmp_path / "out").exists()
