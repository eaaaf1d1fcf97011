"""``neuprim bench paper``: its tables as the appendix prints them, and runs beside them on data of ours."""

from __future__ import annotations

import math
from functools import partial
from pathlib import Path
from statistics import mean

import pytest

from neuprim.cli import main
from neuprim.cli.measure_commands import parse_table_numbers
from neuprim.config import list_task_presets
from neuprim.core.errors import ConfigError
from neuprim.plugins.registry import load_task
from neuprim.runs.open import read_metrics
from neuprim.runs.paper import find_paper_figure, load_paper_run_tables, plan_paper_runs
from tests.core.tiny import write_blender

SMALL = ["model.neurons=2", "model.sh_degree=1", "train.iterations=12"]


def test_the_tables_are_those_of_the_appendix() -> None:
    """Samples of every table, and the averages that it prints."""
    tables = load_paper_run_tables()
    assert [table["tables"] for table in tables] == [[3, 4, 5], [6], [7], [7]]
    least, middle, most = (partial(find_paper_figure, tables[0], row) for row in tables[0]["rows"])
    assert (least("ship", "psnr"), middle("mic", "ssim"), most("drums", "lpips")) == (24.23, 0.9866, 0.047)
    assert middle("materials", "ssim") is None, "0.0471 in the paper"
    assert [row["beside"]["psnr"][0] for row in tables[0]["rows"]] == [22.91, 29.19, 35.83]
    assert find_paper_figure(tables[1], tables[1]["rows"][0], "stump", "primitives") == 330_000
    for table, ssim, lpips in zip(tables[1:], (0.7907, 0.8478, 0.8921), (0.2160, 0.1597, 0.2644), strict=True):
        row = table["rows"][0]
        assert math.isclose(mean(row["ssim"]), ssim, abs_tol=6e-4)
        assert math.isclose(mean(row["lpips"]), lpips, abs_tol=6e-4)
    presets_of_rows = {row["preset"] for table in tables for row in table["rows"]}
    assert presets_of_rows == {name for name in list_task_presets(load_task("static")) if name.startswith("paper")}


def test_without_data_it_lists(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "paper", "--tables", "6"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "table 6: Mip-NeRF 360 (task=static scene=colmap)" and len(lines) == 2 + 9 + 1
    assert lines[9].split() == ["stump", "PSNR", "24.73", "SSIM", "0.6862", "LPIPS", "0.2780", "330,000", "primitives"]


def test_words() -> None:
    assert parse_table_numbers("3-5,7") == {3, 4, 5, 7}
    for wrong in ("2", "3-8", "5-3", "", "all"):
        with pytest.raises(ConfigError, match=f"--tables {wrong}: .*expected table numbers from 3 to 7"):
            parse_table_numbers(wrong)


@pytest.fixture
def data(tmp_path: Path) -> Path:
    folder = tmp_path / "data"
    write_blender(folder / "Chair")
    write_blender(folder / "LEGO")
    for name in ("images", "images_2", "sparse"):
        (folder / "bonsai" / name).mkdir(parents=True)
    (folder / "garden").mkdir()
    return folder


def test_the_plan_is_the_protocol(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    planned = plan_paper_runs(data, load_paper_run_tables(), [], [], "10m", 2, Path("out"), ["train.ssim_weight=0"])
    assert [(p.scene, p.row["name"], p.config.seed) for p in planned] == [
        *((scene, row, seed) for scene in ("chair", "lego") for row in ("200", "5k", "nolimit") for seed in (0, 1)),
        *((scene, "real", seed) for scene in ("bonsai", "garden") for seed in (0, 1)),
    ]
    chair, bonsai, garden = planned[0].config, planned[-4].config, planned[-1].config
    assert (chair.preset, chair.model.primitives, chair.train.max_seconds) == ("paper_200", 200, 600)
    assert Path(chair.scene["path"]) == data / "Chair" and chair.output_dir == Path("out/chair-200-10m-seed0")
    assert (bonsai.preset, bonsai.scene["images"], garden.scene["images"]) == ("paper_real", "images_2", "images")


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--scenes", "chiar"], "--scenes chiar: not in the chosen tables; did you mean 'chair'?"),
        (["--rows", "real", "--tables", "3"], "--rows real: not in the chosen tables"),
        (["--tables", "7"], "--data DATA: no folder named like a scene; expected one of train, truck, playroom"),
        (["budget=soon"], "budget=soon: expected"),
    ],
)
def test_what_cannot_be_is_said_in_one_line(
    data: Path, capsys: pytest.CaptureFixture[str], words: list[str], text: str
) -> None:
    assert main(["bench", "paper", "--data", str(data), *words]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and text.replace("DATA", str(data)) in err


def test_it_runs_and_compares(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    names = ["--data", str(data), "--scenes", "chair,lego", "--rows", "200", "--tables", "3"]
    words = ["bench", "paper", *names, *SMALL]
    assert main(words) == 0
    out = capsys.readouterr().out
    metrics = read_metrics(Path("outputs/paper/lego-200-full-seed0"))
    assert metrics["image_size"] == [24, 24] and metrics["preset"] == "paper_200" and metrics["iterations"] == 12
    assert "lego, 200: preset=paper_200, seed 0, last checkpoint after 12 steps in" in out
    assert "images of 24x24, down-sampling none, model.neurons=2 model.sh_degree=1 train.iterations=12" in out
    lines = [line.split() for line in out.split("lego, 200")[1].splitlines()]
    assert ["PSNR", f"{metrics['psnr']:.2f}", "paper", "22.56", "3DGS", "500", "20.99"] in lines
    assert ["SSIM", f"{metrics['ssim_3dgs']:.4f}", "paper", "0.8247", "3DGS", "500", "0.7819"] in lines
    assert ["LPIPS", "–", "paper", "0.2000", "3DGS", "500", "0.3090"] in lines, "no weights, no number"
    average = (metrics["psnr"] + read_metrics(Path("outputs/paper/chair-200-full-seed0"))["psnr"]) / 2
    assert ["PSNR", f"{average:.2f}", "paper", f"{(24.60 + 22.56) / 2:.2f}"] in lines
    assert "means over 2 scenes, 1 seed; ours of the last checkpoint, the paper's of the best" in out
    assert main(words) == 2 and "exists and is not empty" in capsys.readouterr().err
