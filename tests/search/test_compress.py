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
from neuprim.core.compression import LEVELS
from neuprim.core.errors import CheckpointError, ConfigError, DataError
from neuprim.runs.export import export_run, import_run
from neuprim.runs.measure import evaluate_run
from neuprim.runs.open import load_dataset, load_run, model_file
from neuprim.search.compress import Compression, CompressRequest
from neuprim.search.compress import compress_run as compress_request
from neuprim.search.training_quality import TrainingQuality
from tests.core import tiny
from tests.plugins import marked
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


def compress_run(run_dir: Path, *args: Any, **options: Any) -> Compression:
    return compress_request(CompressRequest(run_dir, *args, **options))


def error_line(capsys: pytest.CaptureFixture[str]) -> str:
    out, err = capsys.readouterr()
    assert out == "" and err.startswith("neuprim: error: ") and err.count("\n") == 1
    return err


# ---------------------------------------------------------------- what it writes and says


def test_the_command_says_what_became_of_every_parameter(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "m.neuprim"
    assert (
        main(
            [
                "compress",
                str(whole),
                "--seconds",
                "0",
                "--level",
                "2",
                "--bits",
                "W1=12",
                "means=20",
                "sh_rest=9,7",
                "--out",
                str(out),
            ]
        )
        == 0
    )
    lines = capsys.readouterr().out.splitlines()
    _, _, model, _ = load_run(whole)
    assert lines[0] == str(out) and lines[1].split() == ["bits", "bytes", "before", "after", "times"]
    rows = {line.split()[0]: line.split()[1:] for line in lines[2 : 2 + len(model.specs)]}
    assert rows.keys() == model.params.keys()
    assert all(int(rows[s.name][-3].replace(",", "")) == 4 * model.count * s.size for s in model.specs)
    assert rows["W1"][0] == "12" and rows["means"][0] == "20" and rows["sh_rest"][:3] == ["7", "to", "9"]
    total = lines[2 + len(model.specs)]
    assert total.startswith("all, and the header") and f"{out.stat().st_size:,}" in total
    (psnr,) = [line for line in lines if line.startswith("psnr")]
    before, after = map(float, re.findall(r"(\d+\.\d+)", psnr)[:2])
    assert before == pytest.approx(evaluate_run(whole)["psnr"], abs=2e-3) and 0.0 < abs(before - after) < 0.5
    assert any(line.startswith("ssim") for line in lines) and lines[-1].startswith("compressed in ")


def test_what_is_measured_is_what_eval_measures(whole: Path, small: Path, tmp_path: Path) -> None:
    made = compress_run(whole, level=3, out=tmp_path / "m")
    found = [evaluate_run(d) for d in (whole, small)]
    for name in ("psnr", "ssim"):
        assert made.measured[name] == pytest.approx([f[name] for f in found], abs=1e-4)
    assert found[1]["model_bytes"] == (small / "model.neuprim").stat().st_size == made.after
    assert 4 * found[0]["parameters"] == made.before and found[1]["iterations"] == found[0]["iterations"] == 60


def test_a_run_without_its_data_is_compressed_too(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    scene = tiny.write_blender(tmp_path / "two")
    run = marked.write_run(
        tmp_path / "run", marked.static_model(), ["task=static", "scene=blender", f"scene.path='{scene}'"]
    )
    shutil.rmtree(scene)
    assert main(["compress", str(run), "--seconds", "0"]) == 0
    out = capsys.readouterr().out
    assert "psnr" not in out and "note: the loss was not measured, as the run's data cannot be read: " in out
    assert load_run(run)[2].count == 5


def test_a_file_in_the_way_stays(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "m.neuprim"
    out.write_bytes(b"mine")
    assert main(["compress", str(whole), "--seconds", "0", "--out", str(out)]) == 2
    assert f"{out}: exists; --force replaces it" in error_line(capsys) and out.read_bytes() == b"mine"
    assert main(["compress", str(whole), "--seconds", "0", "--output", str(tmp_path)]) == 2
    assert f"--out {tmp_path}: is a folder" in error_line(capsys)
    assert main(["compress", str(whole), "--seconds", "0", "--out", str(out), "--force"]) == 0
    assert out.read_bytes()[1:8] == b"NEUPRIM"


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["--level", "9"], "--level 9: expected one of 1, 2, 3, 4, 5"),
        (["--level", "x"], "expected a positive count"),
        (["--tolerance", "0dB"], "expected decibels above 0, for example 0.1dB"),
        (
            ["--tolerance", "0.2", "--level", "3"],
            "--tolerance 0.2: decides the bits of every number; expected no --level",
        ),
        (["--tolerance", "0.2dB", "--bits", "W1=3"], "expected no --bits"),
        (["--bits", "sh=3"], "no parameter 'sh'; did you mean"),
        (["--bit", "W1=3"], "--bit: no such argument of `neuprim compress`; did you mean '--bits'"),
    ],
)
def test_wrong_words(whole: Path, capsys: pytest.CaptureFixture[str], more: list[str], message: str) -> None:
    assert main(["compress", str(whole), "--seconds", "0", *more]) == 2
    assert message in error_line(capsys) and not (whole / "model.neuprim").exists()


def test_the_best_of_both_is_read(whole: Path, tmp_path: Path) -> None:
    """A run keeps its model; the compressed one stands in where it is gone, and the message names the usual one where
    both are."""
    run = tmp_path / "run"
    shutil.copytree(whole, run)
    compress_run(run, 5)
    exact = checkpoint.read(whole / "model.safetensors", "model")[1]
    assert model_file(run) == run / "model.safetensors" and torch.equal(load_run(run)[2].params["b1"], exact["b1"])
    (run / "model.safetensors").unlink()
    assert model_file(run) == run / "model.neuprim" and not torch.equal(load_run(run)[2].params["b1"], exact["b1"])
    (run / "model.neuprim").unlink()
    with pytest.raises(CheckpointError, match=r"model\.safetensors: no such model"):
        load_run(run)


def test_what_was_compressed_is_compressed_again_to_the_same(small: Path, tmp_path: Path) -> None:
    made = compress_run(small, level=3, out=tmp_path / "m")
    assert made.file.read_bytes() == (small / "model.neuprim").read_bytes()
    assert made.measured["psnr"][0] == pytest.approx(made.measured["psnr"][1], abs=1e-6)


# ---------------------------------------------------------------- as few bits as views allow


def judged(run: Path, files: list[Path]) -> list[float]:
    """What training views lose by each file, dB."""
    config, task, model, _ = load_run(run)
    judge = TrainingQuality.of_run(config, load_dataset(config, task, run_dir=run))
    base = judge(model)
    return [base - judge(checkpoint.load_model(file, task)[0]) for file in files]


@pytest.mark.parametrize("steps", [0, 80])
def test_training_views_decide_how_coarse_numbers_are(whole: Path, tmp_path: Path, steps: int) -> None:
    tolerances = [0.05, 0.3, 1.5]
    made = [compress_run(whole, tolerance=t, steps=steps, out=tmp_path / f"{t}") for t in tolerances]
    lost = judged(whole, [m.file for m in made])
    assert all(found <= allowed + 1e-4 for allowed, found in zip(tolerances, lost, strict=True))
    sizes = [sum(parameter.after for parameter in m.parameters) for m in made]
    assert sizes == sorted(sizes, reverse=True) and sizes[-1] < 0.9 * sizes[0]
    assert all(
        m.steps == steps and any("the last bit of every number is worth the same" in note for note in m.notes)
        for m in made
    )
    again = compress_run(whole, tolerance=tolerances[1], steps=steps, out=tmp_path / "again")
    assert again.file.read_bytes() == made[1].file.read_bytes()


def test_a_tenth_of_a_decibel_unless_said_otherwise(
    whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = [tmp_path / name for name in ("usual", "said")]
    assert main(["compress", str(whole), "--seconds", "0", "--out", str(out[0])]) == 0
    assert main(["compress", str(whole), "--seconds", "0", "--tolerance", "0.1dB", "--out", str(out[1])]) == 0
    assert out[0].read_bytes() == out[1].read_bytes() and "rounding may add" in capsys.readouterr().out


# ---------------------------------------------------------------- every command


@pytest.mark.parametrize("form", ["ply", "npz", "gaussian-ply"])
def test_export(small: Path, tmp_path: Path, form: str) -> None:
    (file,) = export_run(small, form, tmp_path / f"m.{form.rpartition('-')[2]}").files
    if form != "gaussian-ply":
        back = import_run(file, tmp_path / "back")
        wanted = load_run(small)[2].params
        assert all(torch.equal(value, wanted[name]) for name, value in load_run(back)[2].params.items())


def test_import_makes_a_run_directory_of_the_file_alone(
    small: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "sent by somebody"
    shutil.copyfile(small / "model.neuprim", file)
    assert main(["import", str(file), "--out", str(tmp_path / "run")]) == 0
    assert capsys.readouterr().out == f"{tmp_path / 'run'}\n"
    assert sorted(p.name for p in (tmp_path / "run").iterdir()) == ["config.yaml", "model.neuprim"]
    assert (tmp_path / "run" / "config.yaml").read_bytes() == (small / "config.yaml").read_bytes()
    assert evaluate_run(tmp_path / "run")["psnr"] == pytest.approx(evaluate_run(small)["psnr"], abs=1e-6)


def test_files_that_import_refuses(small: Path, tmp_path: Path) -> None:
    data = (small / "model.neuprim").read_bytes()
    (tmp_path / "cut.neuprim").write_bytes(data[:-1])
    with pytest.raises(CheckpointError, match=r"cut\.neuprim: the sections take"):
        import_run(tmp_path / "cut.neuprim", tmp_path / "out")
    _, _, model, _ = load_run(small)
    checkpoint.save_compressed(tmp_path / "bare.neuprim", model, "static", {}, LEVELS[3])
    with pytest.raises(DataError, match=r"bare\.neuprim: holds no config\.yaml"):
        import_run(tmp_path / "bare.neuprim", tmp_path / "out")
    (tmp_path / "wrong.neuprim").write_bytes(b"something else")
    with pytest.raises(
        ConfigError,
        match=r"no format reads \.neuprim files; expected one of `neuprim compress`, or of --format ply or npz",
    ):
        import_run(tmp_path / "wrong.neuprim", tmp_path / "out")
    assert not (tmp_path / "out").exists()


# ---------------------------------------------------------------- training for few bits


def test_the_command_trains_for_few_bits(whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = [tmp_path / name for name in ("plain", "trained")]
    assert main(["compress", str(whole), "--level", "5", "--steps", "0", "--out", str(out[0])]) == 0
    assert "steps of training" not in capsys.readouterr().out
    assert main(["compress", str(whole), "--level", "5", "--steps", "60", "--out", str(out[1])]) == 0
    text = capsys.readouterr().out
    assert "with 60 steps of training" in text
    measured = [
        compress_run(whole, level=5, steps=steps, out=tmp_path / f"m{steps}").measured["psnr"][1] for steps in (0, 60)
    ]
    assert measured[1] > measured[0]
    assert (tmp_path / "m60").read_bytes() == out[1].read_bytes()  # steps, not seconds: the same file


def test_without_data_nothing_is_trained_and_it_is_said(whole: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(whole, copy)
    config = (copy / "config.yaml").read_text()
    (copy / "config.yaml").write_text(re.sub(r"(?m)^(\s+path: ).*$", r"\1/nowhere", config))
    made = compress_run(copy, steps=40)
    assert made.steps == 0 and any("it was not trained for few bits" in note for note in made.notes)
    *_, measured, bits = compress_run(copy, steps=0, overwrite=True).notes
    assert measured.startswith("the loss was not measured, as") and bits.endswith("of --level 3")
    assert (copy / "model.neuprim").read_bytes() == compress_run(copy, level=3, out=tmp_path / "m").file.read_bytes()
