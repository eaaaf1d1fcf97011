"""Whole runs of the dynamic task, small: files, simulation and images in; report, films and animations out."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from neuprim.cli import main
from neuprim.config import compose
from neuprim.core.errors import ConfigError
from neuprim.core.io.vdb import read_grid, write_vdb
from neuprim.runs.open import load_run
from neuprim.runs.run import run
from neuprim.tasks.dynamic import TASK, parse_dynamic_time
from tests.reports import offered
from tests.tasks.dynamic import sequences
from tests.tasks.dynamic.sequences import blob

SMALL = (
    "scene.size=24 scene.cameras=6 scene.samples=1 model.primitives=60 model.neurons=2 train.max_seconds=null".split()
)


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("ball")
    for number in range(1, 5):
        write_vdb(folder / f"ball_{number}.vdb", blob(6.0 + 3 * number))
    return folder


@pytest.fixture(scope="module")
def finished(files: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return fit(files, tmp_path_factory.mktemp("run") / "run", "train.iterations=500")


def fit(files: Path, target: Path, *words: str) -> Path:
    scene = ["task=dynamic", "scene=vdb", f"scene.vdb='{files}'", "scene.look=smoke_fire"]
    return run(compose([*scene, *SMALL, f"output_dir='{target}'", *words]))


def metrics(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "metrics.json").read_text())  # type: ignore[no-any-return]


def test_a_run_learns_and_reports_every_number(finished: Path) -> None:
    m = metrics(finished)
    assert m["psnr_mask"] > m["psnr_black_image_mask"] + 4
    assert m["psnr"] > m["psnr_mask"] and m["psnr_pooled_mask"] <= m["psnr_mask"] + 1e-9
    assert len(m["per_frame"]) == 4
    assert all({"psnr", "psnr_mask", "psnr_black_image"} <= f.keys() for f in m["per_frame"])
    assert m["psnr_srgb"] > 0 and m["ssim_srgb"] > 0 and m["color_space"] == "linear"
    assert m["sigma_correlation_middle"] > 0.5 and 0 < m["sigma_relative_l2_middle"] < 1
    assert m["sigma_psnr_active_middle"] > 5 and 0 < m["sigma_max_error_middle"] < 2
    assert m["vdb_bytes"] > 0 and 0 <= m["invisible_fraction"] <= 1 and m["data_source"] == "real"


def test_the_report_offers_commands_that_work(finished: Path, tmp_path: Path) -> None:
    commands = offered(finished / "report.html")
    assert ["render", str(finished), "--camera", "orbit", "--time", "0:1"] in commands
    for i, words in enumerate(commands):
        out = ["--out", str(tmp_path / str(i))]
        small = {"render": ["--size", "6x5", "--frames", "2", *out], "compress": ["--steps", "0", *out]}
        if words[0] != "view":  # serves a page until it is stopped
            assert main([*words, *small.get(words[0], [])]) == 0, words


@pytest.mark.parametrize("suffix", ["webp", "mp4"])
def test_an_animation_over_time(finished: Path, tmp_path: Path, suffix: str) -> None:
    if suffix == "mp4":
        pytest.importorskip("av", reason="MP4 needs neuprim[video]")
    target = tmp_path / f"film.{suffix}"
    words = ["render", str(finished), "--camera", "orbit", "--time", "0:1:7", "--frames", "7", "--out", str(target)]
    assert main(words) == 0
    if suffix == "mp4":
        import av

        with av.open(str(target)) as film:
            frames = [f.to_ndarray(format="rgb24") for f in film.decode(video=0)]
        assert len(frames) == 7 and frames[3].shape == (24, 24, 3) and frames[3].max() > 60
    else:
        with Image.open(target) as image:
            assert getattr(image, "n_frames", 1) == 7


def test_cameras_of_a_file_need_a_time(finished: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    task = load_run(finished).task
    assert [spec.name for spec in task.conditions] == ["time"]
    matrix = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 2.7], [0, 0, 0, 1]]
    cameras = {"w": 24, "h": 24, "camera_angle_x": 0.5, "frames": [{"name": "a", "transform_matrix": matrix}]}
    path = tmp_path / "cameras.json"
    path.write_text(json.dumps(cameras))
    assert main(["render", str(finished), "--camera", str(path)]) == 2
    assert "has no time, which task 'dynamic' needs; give --time" in capsys.readouterr().err
    words = ["render", str(finished), "--camera", str(path), "--time", "0.5", "--out", str(tmp_path / "a.png")]
    assert main(words) == 2, "the camera is in the unit box, and the files' world is elsewhere"
    assert "all 1 images are empty: the model is within" in capsys.readouterr().err
    assert main([*words, "--space", "scene"]) == 0


@pytest.mark.parametrize("text", ["2", "-0.1", "nan", "a", "0:1", ""])
def test_impossible_times(text: str) -> None:
    with pytest.raises(ConfigError, match=r"expected a time from 0 to 1"):
        parse_dynamic_time(text)


def test_a_simulated_scene_says_so(tmp_path: Path) -> None:
    words = "task=dynamic scene=smoke_fire scene.resolution=16 scene.timesteps=4 train.iterations=5".split()
    folder = run(compose([*words, *SMALL, f"output_dir='{tmp_path / 'run'}'"]))
    m = metrics(folder)
    assert m["data_source"] == "simulated" and "simulated" in m["dataset"]
    assert "simulated data" in (folder / "report.html").read_text()


def test_the_preset_of_the_equations_is_the_papers_form_at_the_bytes_of_quick(files: Path, tmp_path: Path) -> None:
    quick, equations, paper = (compose(["task=dynamic", f"preset={name}"]) for name in ("quick", "equations", "paper"))
    assert equations.model.density == paper.model.density == {"time": "phase"}
    assert equations.model.colour == {"powers": 4, "waves": 4, "frequencies": "printed"}
    assert equations.model.sh_degree == 3
    assert equations.train.voxels_every == quick.train.voxels_every == 4
    assert equations.train.rates.keys() == quick.train.rates.keys()
    train = dataclasses.replace(equations.train, rates=quick.train.rates)
    assert (train, equations.renderer) == (quick.train, quick.renderer), "the budget and the population are quick's"
    words = "preset=equations train.iterations=20 train.population.every=5 train.population.start=0 model.neurons=8"
    model = load_run(fit(files, tmp_path / "run", *words.split())).model
    assert model.parameters_per_primitive == 143 + 1
    assert bool(model.params["W_t"].any()) and bool(model.params["time_sin"].any())
    # the form alone, without shares of components
    data = dataclasses.replace(sequences.dataset(files, tmp_path), points=None)
    fields = TASK.build(vars(quick.model), data)
    numbers = 10 + sum(spec.size for field in fields for spec in field.parameters())
    assert abs(143 * equations.model.primitives - numbers * quick.model.primitives) <= 143 / 2


def test_a_preview_renders_four_cameras_and_learns_from_voxels(files: Path, tmp_path: Path) -> None:
    words = ["task=dynamic", "scene=vdb", f"scene.vdb='{files}'", "preset=preview", "scene.size=24"]
    config = compose([*words, "train.iterations=40", "model.primitives=60", f"output_dir='{tmp_path / 'run'}'"])
    assert config.scene["cameras"] == 4 and config.train.supervision == "voxels"
    assert len(metrics(run(config))["per_frame"]) == 4
    assert compose([*words, "scene.cameras=6"]).scene["cameras"] == 6
    with pytest.raises(
        ConfigError, match=r"preset=preview: the preset sets scene\.cameras, which scene=multiview does not have"
    ):
        compose(["task=dynamic", "scene=multiview", f"scene.path='{tmp_path}'", "preset=preview"])


def test_frames_are_chosen_by_number_and_name_their_files(finished: Path, tmp_path: Path) -> None:
    words = ["render", str(finished), "--camera", "orbit", "--size", "16x16"]
    out = tmp_path / "shot"
    assert main([*words, "--frame", "2-4x2,3", "--format", "exr", "--layers", "beauty", "--out", str(out)]) == 0
    assert sorted(file.name for file in out.iterdir()) == [f"orbit.{number:04d}.exr" for number in (2, 3, 4)]
    assert main([*words, "--frame", "1-4", "--out", str(tmp_path / "film.webp")]) == 0
    with Image.open(tmp_path / "film.webp") as film:
        assert getattr(film, "n_frames", 1) == 4


def test_exports_and_inspections_take_frame_numbers(finished: Path, tmp_path: Path) -> None:
    words = ["export", str(finished), "--format", "vdb"]
    assert main([*words, "--frame", "2-4x2", "--out", str(tmp_path / "some")]) == 0
    assert sorted(file.name for file in (tmp_path / "some").iterdir()) == ["density_0002.vdb", "density_0004.vdb"]
    assert main([*words, "--out", str(tmp_path / "all")]) == 0
    for number in (2, 4):  # the same files as those of the whole sequence
        one, same = (tmp_path / folder / f"density_{number:04d}.vdb" for folder in ("some", "all"))
        assert np.array_equal(read_grid(one, "density").to_dense(), read_grid(same, "density").to_dense())
    assert main([*words, "--time", "0,0.5", "--out", str(tmp_path / "between")]) == 0  # the second lies between files
    assert sorted(file.name for file in (tmp_path / "between").iterdir()) == ["density_0000.vdb", "density_0001.vdb"]
    picture = tmp_path / "inside.png"
    assert main(["inspect", str(finished), "--frame", "3", "--grid", "16", "--out", str(picture)]) == 0
    assert picture.stat().st_size > 100


@pytest.mark.parametrize("command", [["render", "--camera", "orbit"], ["export", "--format", "vdb"], ["inspect"]])
@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--frame", "1-5"], "--frame 1-5: not in the sequence; expected frames from 1 to 4"),
        (["--frame", "4-1"], "--frame 4-1: expected numbers and ranges such as 1001-1048x2,1060"),
        (["--frame", "1-4x0"], "expected numbers and ranges"),
        (["--frame", "a"], "expected numbers and ranges"),
        (["--frame", "0-999999999"], "expected numbers and ranges"),
        (["--frame", "1", "--time", "0"], "--frame and --time: give only one of these flags"),
    ],
)
def test_impossible_frames(
    finished: Path, command: list[str], words: list[str], message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([command[0], str(finished), *command[1:], *words]) == 2
    assert message in capsys.readouterr().err
