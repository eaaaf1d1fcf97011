"""Whole runs of a tiny scene: what they leave on disk, and that neither Ctrl-C nor a kill costs more than a step."""

from __future__ import annotations

import errno
import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image
from torch import Tensor

from neuprim.cli import main
from neuprim.config import RunConfig, compose
from neuprim.core import checkpoint, errors
from neuprim.core.data import Clip, Dataset
from neuprim.core.errors import CheckpointError, ConfigError, DataError, NeuprimWarning
from neuprim.core.io.files import write_text
from neuprim.core.train.settings import ModelSettings, TrainSettings
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import Event, Note, compile_run_kernels, measure_run_curve_point, prepare_training, train_to_end
from neuprim.runs.measure import evaluate_run, measure_views
from neuprim.runs.open import read_metrics, result_files
from neuprim.runs.render_images import RenderRequest, render_run
from neuprim.runs.run import run
from neuprim.runs.training import add_run_curve_line, cut_run_curve
from neuprim.tasks.static import TASK
from tests.core import tiny
from tests.lpips_weights import weights, written
from tests.short_runs import STEPS, command_line, fit, words
from tests.systems import posix


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


@pytest.fixture(scope="module")
def whole(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An uninterrupted run."""
    return fit(words(scene, tmp_path_factory.mktemp("runs") / "whole"))


def tensors(run_dir: Path, kind: str = "model") -> dict[str, Tensor]:
    return checkpoint.read_tensors(run_dir / f"{kind}.safetensors", kind)[1]


def curve(run_dir: Path) -> list[dict[str, Any]]:
    lines = [json.loads(text) for text in (run_dir / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in line.items() if k != "seconds"} for line in lines]


def assert_same_run(a: Path, b: Path) -> None:
    for kind in ("model", "checkpoint"):
        first, second = tensors(a, kind), tensors(b, kind)
        assert first.keys() == second.keys()
        for name, value in first.items():
            assert value.dtype == second[name].dtype and value.numpy().tobytes() == second[name].numpy().tobytes(), name
    assert curve(a) == curve(b)
    timings = ("train_seconds", "render_fps", "per_view", "model_bytes", "non_default")
    first, second = ({k: v for k, v in read_metrics(d).items() if k not in timings} for d in (a, b))
    assert first == second


# ---------------------------------------------------------------- what a run leaves


def test_contents(whole: Path) -> None:
    files = "config.yaml model.safetensors checkpoint.safetensors metrics.jsonl metrics.json renders report.html"
    assert set(files.split()) <= {p.name for p in whole.iterdir()}
    assert not list(whole.rglob("*.tmp"))
    pictures = sorted(p.name for p in (whole / "renders").iterdir())
    assert "orbit.webp" in pictures
    shown = [p for p in pictures if p.startswith("test_")]
    assert len(shown) == 6, "two views, each rendered, true and the error"
    assert all(Image.open(whole / "renders" / p).size[1] == tiny.SIZE for p in shown)
    assert "<html" in (whole / "report.html").read_text(encoding="utf-8")


def test_the_report_shows_the_median_and_the_worst_view(tmp_path: Path) -> None:
    """Of many held-out views, these are among the pictures."""
    typed = "task=static scene=solids scene.size=16 scene.supersampling=1 model.primitives=20 train.iterations=3"
    out = run(compose([*typed.split(), f"output_dir={tmp_path / 'run'}"]))
    views = read_metrics(out)["per_view"]
    order = sorted(range(len(views)), key=lambda i: views[i]["psnr"])
    pictured = {int(path.name[5:8]) for path in (out / "renders").glob("test_*_error.png")}
    assert len(views) == 20 and {order[0], order[9]} <= pictured and 6 <= len(pictured) <= 8
    text = (out / "report.html").read_text()
    for name, view in (("Median", order[9]), ("Worst", order[0])):
        assert f'data-view="view-{view}" hidden>{name} view</button>' in text and f'id="view-{view}"' in text
    assert f"<code>neuprim run {typed}</code>" in text


def test_metrics(whole: Path) -> None:
    metrics = read_metrics(whole)
    expected = {
        "task": "static", "scene": "blender", "split": "test", "checkpoint": "last", "primitives": 40,
        "parameters_per_primitive": 10 + 22 + 48, "parameters": 40 * 80, "iterations": STEPS, "seed": 3,
        "background": [1.0, 1.0, 1.0], "backend": "cpu", "data_source": "real", "downsampling": "none",
    }  # fmt: skip
    assert {name: metrics[name] for name in expected} == expected
    assert metrics["model_bytes"] == (whole / "model.safetensors").stat().st_size > 40 * 79 * 4
    assert metrics["train_seconds"] > 0 and metrics["render_fps"] > 1 and "device" in metrics
    assert {"neuprim", "python", "torch", "numpy"} <= metrics["versions"].keys()
    views = metrics["per_view"]
    assert len(views) == 2 and metrics["psnr"] > 12
    for name in ("psnr", "ssim", "ssim_3dgs"):
        assert metrics[name] == pytest.approx(sum(view[name] for view in views) / 2)


def test_lpips_is_measured_where_there_are_weights(whole: Path, scene: Path, tmp_path: Path) -> None:
    """From disk, or where a run names them; a missing LPIPS says so, in metrics.json and in the report."""
    metrics = read_metrics(whole)
    assert metrics["lpips"] is None and "no weights were given" in metrics["not_measured"]["lpips"]
    assert all("lpips" not in view for view in metrics["per_view"])
    assert "LPIPS</dt><dd>not measured: no weights were given" in (whole / "report.html").read_text()
    for name in ("vgg", "alex"):
        (tmp_path / name).mkdir()
    vgg, alex = (written(tmp_path / name, weights(name)) for name in ("vgg", "alex"))
    found = evaluate_run(whole, vgg)
    assert found["lpips_network"] == "vgg" and "not_measured" not in found and found["psnr"] == metrics["psnr"]
    for name in ("lpips", "lpips_3dgs"):
        assert found[name] == pytest.approx(sum(v[name] for v in found["per_view"]) / 2) and found[name] > 0
    found = evaluate_run(whole, alex)
    assert found["lpips"] is None and "narrower than 31 pixels" in found["not_measured"]["lpips"]
    with pytest.raises(DataError, match=r"absent[.]pth: cannot be read"):
        fit(words(scene, tmp_path / "early", 10**6, f"metrics.lpips={tmp_path / 'absent.pth'}"))  # before any training
    assert not (tmp_path / "early").exists()
    out = fit(words(scene, tmp_path / "with", 10, f"metrics.lpips={vgg}"))
    assert read_metrics(out)["lpips"] == evaluate_run(out)["lpips"] > 0
    assert "<dt>LPIPS (vgg)</dt>" in (out / "report.html").read_text()


def test_curve(whole: Path) -> None:
    lines = curve(whole)
    assert [line["step"] for line in lines if line["step"] % 10 == 0] == list(range(10, STEPS + 1, 10))
    assert [line["step"] for line in lines if "eval_psnr" in line] == [STEPS * i // 4 for i in (1, 2, 3, 4)]
    assert {"loss", "l1", "ssim", "psnr", "primitives"} <= lines[-1].keys()
    assert any("moved" in line.get("change", "") for line in lines)
    assert lines[-1]["eval_psnr"] > lines[0]["psnr"] + 3
    assert lines[-1]["eval_psnr"] == pytest.approx(read_metrics(whole)["psnr"], abs=1e-3)


def test_masked_pixels_do_not_count_on_the_curve() -> None:
    dataset = tiny.two_primitives()
    mask = torch.zeros(tiny.SIZE, tiny.SIZE, dtype=torch.bool)
    mask[8:14, 5:20] = True
    dataset.test.images = [  # type: ignore[attr-defined]
        replace(p, rgb=torch.where(mask[..., None], p.rgb, torch.tensor(7.0)), mask=mask)
        for p in dataset.test.images  # type: ignore[attr-defined]
    ]
    trainer = tiny.trainer(dataset, 3)
    views = measure_views(trainer.model, TASK, dataset, trainer.renderer)
    assert measure_run_curve_point(trainer) == pytest.approx(sum(v.psnr for v in views) / len(views), abs=1e-9)


def test_a_model_that_no_view_shows_says_so() -> None:
    dataset = tiny.two_primitives()
    trainer = tiny.trainer(dataset, 3)
    assert not any(v.empty for v in measure_views(trainer.model, TASK, dataset, trainer.renderer))
    trainer.model.params["means"] = trainer.model.params["means"].detach() + 1000.0
    with pytest.warns(NeuprimWarning, match=r"two: the model is invisible in all 2 test views.*ply_file_path"):
        views = measure_views(trainer.model, TASK, dataset, trainer.renderer)
    assert all(v.empty for v in views)


def test_the_near_plane_of_a_run_is_recorded_once(scene: Path, tmp_path: Path) -> None:
    near = RunConfig.from_yaml(fit(words(scene, tmp_path / "run", 3))).renderer.near
    assert isinstance(near, float) and 0 < near < 0.1
    assert RunConfig.from_yaml(fit(words(scene, tmp_path / "own", 3, "renderer.near=0.125"))).renderer.near == 0.125


def test_a_perfect_view_leaves_the_curve_a_number(monkeypatch: pytest.MonkeyPatch) -> None:
    dataset = tiny.two_primitives()
    trainer = tiny.trainer(dataset, 3)
    perfect = dataset.test.pixels(0).over(dataset.background)
    monkeypatch.setattr("neuprim.runs.fit.render_image", lambda *given: perfect)
    dataset.test.images = [dataset.test.images[0]] * 2  # type: ignore[attr-defined]
    assert measure_run_curve_point(trainer) == 200.0


def test_a_task_may_judge_views_and_make_films_and_tell_facts(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def own_metrics(dataset: Dataset, index: int, rendered: Tensor, truth: Tensor) -> dict[str, float]:
        return {"index": float(index), "mse_part": 0.1 if index else 0.2, "pixels_part": 3.0 if index == 0 else 1.0}

    mine = replace(
        TASK,
        metrics=own_metrics,
        mask=lambda dataset, index: dataset.test.pixels(index).alpha > 0.5,
        diagnose=lambda dataset, model: {"counted": [model.count, dataset.channels]},
        clips=lambda dataset: [Clip("round", [2, 0, 1], 10.0, dataset.train)],
        facts=lambda dataset: {"seen": len(dataset.train)},
        orbit=lambda dataset, frames: dataset.orbit(frames)[:3],
    )
    monkeypatch.setattr("neuprim.tasks.static.TASK", mine)
    out = fit(words(scene, tmp_path / "film", 20))
    metrics = read_metrics(out)
    count = len(metrics["per_view"])
    assert metrics["index"] == (count - 1) / 2 and [v["index"] for v in metrics["per_view"]] == list(range(count))
    pooled = (3 * 0.2 + (count - 1) * 0.1) / (3 + count - 1)
    assert (
        metrics["psnr_pooled_part"] == pytest.approx(-10 * math.log10(pooled))
        and metrics["pixels_part"] == 3 + count - 1
    )
    assert "per_frame" not in metrics
    assert metrics["counted"] == [metrics["primitives"], 3]
    assert all(math.isfinite(view["psnr_mask"] + view["mse_mask"]) for view in metrics["per_view"])
    header = checkpoint.read_tensors(out / "model.safetensors", "model")[0]
    assert header["data"] == {"up": [0.0, 0.0, 1.0], "center": header["data"]["center"], "seen": 6}
    with Image.open(out / "renders" / "orbit.webp") as film:
        assert getattr(film, "n_frames", 1) == 3
    with Image.open(out / "renders" / "clip_round.webp") as film:
        assert getattr(film, "n_frames", 1) == 3 and film.width == 2 * film.height
    assert evaluate_run(out)["index"] == metrics["index"]


def test_evaluating_again_gives_the_same_numbers(whole: Path) -> None:
    first, second = read_metrics(whole), evaluate_run(whole)
    assert first["psnr"] == second["psnr"] and first["ssim"] == second["ssim"]
    drop = lambda m: [{k: v for k, v in view.items() if k != "seconds"} for view in m["per_view"]]  # noqa: E731
    assert drop(first) == drop(second)
    for key in ("iterations", "train_seconds", "primitives", "model_bytes", "background"):
        assert first[key] == second[key]


# ---------------------------------------------------------------- pictures


def test_render_orbit_test_and_file(whole: Path, tmp_path: Path) -> None:
    paths = render_run(whole, RenderRequest("orbit", size=(30, 20), format="png", out=tmp_path / "orbit", frames=3))
    assert [Image.open(p).size for p in paths] == [(30, 20)] * 3
    assert len({p.read_bytes() for p in paths}) == 3
    paths = render_run(whole, RenderRequest("test", format="png", out=tmp_path / "test"))
    assert [Image.open(p).size for p in paths] == [(tiny.SIZE, tiny.SIZE)] * 2
    own = sorted(p for p in (whole / "renders").glob("test_*.png") if "truth" not in p.name and "error" not in p.name)
    assert [p.read_bytes() for p in paths] == [p.read_bytes() for p in own], "the pictures that the run made itself"

    cameras = tmp_path / "cameras.json"
    poses = json.loads((Path(RunConfig.from_yaml(whole).scene["path"]) / "transforms_test.json").read_text())
    cameras.write_text(json.dumps({**poses, "w": 18, "h": 14}))
    paths = render_run(whole, RenderRequest(str(cameras), format="png"))
    assert [Image.open(p).size for p in paths] == [(18, 14)] * 2
    (path,) = render_run(whole, RenderRequest(str(cameras), format="webp", out=tmp_path / "a.webp"))
    assert path == tmp_path / "a.webp" and Image.open(path).size == (18, 14) and Image.open(path).n_frames == 2  # type: ignore[attr-defined]
    paths = render_run(whole, RenderRequest("test", size=(8, 6), format="exr", out=tmp_path / "exr"))
    assert [p.suffix for p in paths] == [".exr", ".exr"]


# ---------------------------------------------------------------- stops


def wait_for_step(process: subprocess.Popen[bytes], run_dir: Path, step: int) -> None:
    """Until the checkpoint on disk has reached ``step``. Every state of the file that can be seen meanwhile is
    whole."""
    seen, snapshot = run_dir / "checkpoint.safetensors", run_dir.with_name("snapshot.safetensors")
    end = time.monotonic() + 120
    while time.monotonic() < end:
        assert process.poll() is None, process.communicate()
        if seen.exists():
            snapshot.write_bytes(seen.read_bytes())  # the file is replaced all the time; a copy stays
            if checkpoint.read_tensors(snapshot, "checkpoint")[0]["step"] >= step:
                return
        time.sleep(0.005)
    pytest.fail("no checkpoint appeared")


@posix
def test_ctrl_c_leaves_a_checkpoint_that_goes_on(scene: Path, whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "stopped"
    overrides = words(scene, out, STEPS, "train.checkpoint_every_seconds=0")
    command = [sys.executable, "-m", "neuprim", "run", *command_line(overrides)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    try:
        wait_for_step(process, out, 30)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 130
    finally:
        process.kill()
    step = checkpoint.read_header(out / "checkpoint.safetensors", "checkpoint")["step"]
    assert 30 <= step < STEPS
    assert read_metrics(out)["iterations"] == step, "what was fitted until then is measured"
    assert checkpoint.read_header(out / "model.safetensors", "model")["iterations"] == step
    assert evaluate_run(out)["psnr"] == read_metrics(out)["psnr"]
    fit([*overrides, "resume=true"])
    assert_same_run(whole, out)


def test_what_cannot_go_on_leaves_an_earlier_run_alone(scene: Path, tmp_path: Path) -> None:
    """With other settings, without its data, or from a checkpoint of another task."""
    out = fit(words(scene, tmp_path / "run", 5))

    def refused(error: type[Exception], message: str, *overrides: str) -> None:
        before = {p: p.read_bytes() for p in out.rglob("*") if p.is_file()}
        with pytest.raises(error, match=message):
            fit([*words(scene, out, 10, "resume=true"), *overrides])
        assert {p: p.read_bytes() for p in out.rglob("*") if p.is_file()} == before

    refused(ConfigError, r"^model\.neurons=5: the run to resume was started with model\.neurons=", "model.neurons=5")
    refused(DataError, "nowhere", f"scene.path={tmp_path / 'nowhere'}")
    header, tensors = checkpoint.read_tensors(out / "checkpoint.safetensors", "checkpoint")
    checkpoint.write_tensors(out / "checkpoint.safetensors", "checkpoint", tensors, {**header, "task": "dynamic"})
    refused(CheckpointError, r"checkpoint\.safetensors.*'dynamic'.*'static'")


def test_a_preview_is_written_while_a_run_trains_and_changes_nothing(scene: Path, whole: Path, tmp_path: Path) -> None:
    """Within the first tenth, anew at half of the training, and at its end."""
    out, seen, notes = tmp_path / "run", list[bytes | None](), list[str]()
    preview = out / "renders" / "preview.png"

    def listen(event: Event) -> None:
        notes.extend([event.text] if isinstance(event, Note) and "picture" in event.text else [])

    def look(fitted: Any, stop: Any) -> None:
        seen.append(preview.read_bytes() if preview.is_file() else None)

    run(compose(words(scene, out)), listen, look)
    written = [i for i, (before, after) in enumerate(pairwise(seen)) if before != after]
    assert written == [math.ceil(0.01 * STEPS), 0.5 * STEPS] and seen[0] is None and preview.read_bytes() != seen[-1]
    assert notes == [f"first picture (left ground truth, right model): {preview}"]
    assert_same_run(whole, out)
    (drawn,) = (p for p in (out / "renders").glob("test_001_*.png") if not p.stem.endswith(("_truth", "_error")))
    pair = [Image.open(drawn.with_name(f"{drawn.stem}{end}.png")) for end in ("_truth", "")]
    assert np.array_equal(np.asarray(Image.open(preview)), np.hstack([np.asarray(picture) for picture in pair]))


# ---------------------------------------------------------------- results


class Stop(Exception):
    pass


def test_a_resumed_run_has_no_results_until_its_own(scene: Path, tmp_path: Path) -> None:
    out = fit(words(scene, tmp_path / "run", 6))
    (out / "renders" / "mine.png").touch()
    assert {"metrics.json", "report.html", "orbit.webp", "worst_000.png"} <= {path.name for path in result_files(out)}

    def killed(*_: Any) -> None:
        raise Stop

    with pytest.raises(Stop):
        run(compose([f"output_dir={out}", "resume=true", "train.iterations=9"]), between=killed)
    assert not result_files(out) and (out / "model.safetensors").exists() and (out / "renders" / "mine.png").exists()
    run(compose([f"output_dir={out}", "resume=true"]))
    assert read_metrics(out)["iterations"] == 9


def test_a_picture_of_the_report_is_replaced_only_where_that_is_said(
    scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = fit(words(scene, tmp_path / "run", 3))
    film = out / "renders" / "orbit.webp"
    before = film.read_bytes()
    words_of_film = ["render", str(out), "--camera", "orbit", "--frames", "2"]
    over = ["--out", str(out / "renders" / ".." / "renders" / "orbit.webp")]
    assert main([*words_of_film, *over]) == 2
    refusal = "orbit.webp: is a picture of the run's report; pass --force to replace it, or --out PATH to write"
    assert refusal in capsys.readouterr().err
    assert main([*words_of_film, "--format", "webp"]) == 0 and (out / "frames" / "orbit.webp").exists()
    assert film.read_bytes() == before
    assert main([*words_of_film, *over, "--force"]) == 0
    assert film.read_bytes() != before
    picture = next(path for path in result_files(out) if path.name.startswith("test_000"))
    assert main(["render", str(out), "--camera", "orbit", "--frames", "1", "--out", str(picture)]) == 2


def test_a_full_disk_costs_a_checkpoint_and_not_the_training(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(errors, "_said", set())
    failing, save_file = {3, 4}, checkpoint.save_file
    calls = 0

    def full(*given: Any, **more: Any) -> None:
        nonlocal calls
        calls += 1
        if calls in failing:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        save_file(*given, **more)

    monkeypatch.setattr(checkpoint, "save_file", full)
    said = ["train.checkpoint_every_seconds=0"]
    with pytest.warns(
        NeuprimWarning,
        match=r"checkpoint\.safetensors: could not write .*No space left.*; training goes on from step 2; "
        "neuprim tries again",
    ):
        out = fit(words(scene, tmp_path / "run", 6, *said))
    assert read_metrics(out)["iterations"] == 6
    failing = set(range(10**3))
    monkeypatch.setattr(errors, "_said", set())
    calls = 0
    with (
        pytest.warns(NeuprimWarning),
        pytest.raises(CheckpointError, match=r"last/checkpoint\.safetensors: could not write"),
    ):
        fit(words(scene, tmp_path / "last", 3, *said))


def test_a_full_disk_names_the_file_and_keeps_lines_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    cut_run_curve(tmp_path / "metrics.jsonl", 0)
    add_run_curve_line(tmp_path / "metrics.jsonl", '{"step": 1}\n')
    assert (tmp_path / "metrics.jsonl").read_text() == '{"step": 1}\n', "at once"
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left") as refused:
        write_text(tmp_path / "report.html", "x")
    assert refused.value.filename == str(tmp_path / "report.html") and not list(tmp_path.glob(".*"))


# ---------------------------------------------------------------- in memory


@pytest.mark.parametrize(("share", "first"), [(0.5, 20), (1, 40)])
def test_a_share_of_the_primitives_is_there_at_first_and_all_at_the_end(
    scene: Path, tmp_path: Path, share: float, first: int
) -> None:
    grown = [f"train.population.grow_from={share}", "train.population.every=10", "train.eval_every=0"]
    fitted = prepare_training(compose(words(scene, tmp_path / "out", 100, *grown)))
    assert fitted.model.count == first
    train_to_end(fitted)
    assert fitted.model.count == 40


@pytest.mark.parametrize(
    ("words_of_population", "said"),
    [
        (["grow_from=0.2", "every=30"], "32 primitives of model.primitives=40: too few interventions"),
        (["strategy=fixed", "grow_from=1"], "two offers 3 starting points for model.primitives=40"),
    ],
)
def test_a_count_that_is_not_reached_is_said(
    scene: Path, tmp_path: Path, words_of_population: list[str], said: str
) -> None:
    more = [f"train.population.{word}" for word in words_of_population]
    if "strategy=fixed" in words_of_population:
        names = "".join(f"property float {axis}\n" for axis in "xyz")
        head = f"ply\nformat ascii 1.0\nelement vertex 3\n{names}end_header\n"
        write_text(tmp_path / "three.ply", head + "0 0 0\n0.1 0 0\n0 0.1 0\n")
        more.append(f"model.init.points={tmp_path / 'three.ply'}")
    events: list[Event] = []
    fitted = prepare_training(compose(words(scene, tmp_path / "out", 100, *more, "train.eval_every=0")), events.append)
    train_to_end(fitted, events.append)
    notes = [event.text for event in events if isinstance(event, Note)]
    assert len(notes) == 1 and said in notes[0]


def test_the_number_of_primitives_follows_the_budget() -> None:
    auto, steps = ModelSettings(primitives="auto", auto_primitives=10.0), TrainSettings(iterations=400)
    seconds, both = replace(steps, iterations=None, max_seconds=8.0), replace(steps, max_seconds=8.0)
    assert auto.with_count_for(steps).count == 200, "10 sqrt(400)"
    # 8 seconds at 1e-4 a step and primitive: 400 steps of 200 primitives
    assert auto.with_count_for(seconds, 1e-4).count == auto.with_count_for(both, 1e-4).count == 200
    assert auto.with_count_for(both, 1e-5).count == 200 and auto.with_count_for(both, 8e-4).count == 100
    assert auto.with_count_for(seconds, 1e-30).count > 1e6 and auto.with_count_for(seconds, 1e9).count == 1
    assert ModelSettings(primitives=7).with_count_for(steps).count == 7
    with pytest.raises(ConfigError, match="primitives=auto: only a training can choose the number of primitives"):
        _ = auto.with_count_for(seconds).count


def test_a_run_chooses_its_number_of_primitives_once(scene: Path, tmp_path: Path) -> None:
    """By steps when it is composed, by seconds from its pace; it stores the number, and keeps it when it goes on."""
    out, events = tmp_path / "out", list[Event]()
    own = [word for word in words(scene, out, 400) if "primitives" not in word and "max_seconds" not in word]
    auto = [*own, "model.primitives=auto", "model.auto_primitives=2"]
    assert compose(auto).model.primitives == 40
    in_seconds = [*(word for word in auto if "iterations" not in word), "train.max_seconds=0.3"]
    run(compose(in_seconds), events.append)
    found = RunConfig.from_yaml(out).model.count
    said = [event.text for event in events if isinstance(event, Note) and "model.primitives=auto" in event.text]
    assert len(said) == 1 and f"auto: {found:,} for 0.3 s" in said[0] and read_metrics(out)["primitives"] == found
    again = compose([*in_seconds, "resume=true"])
    assert again.model.primitives == found and compose([f"output_dir={out}", "resume=true"]).model.primitives == found
    with pytest.raises(ConfigError, match=f"model.primitives={found + 1}: the run to resume was started with"):
        compose([f"output_dir={out}", "resume=true", f"model.primitives={found + 1}"])


def test_kernels_of_points_are_compiled_before_the_first_step(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = "task=dynamic scene=smoke_fire scene.size=16 scene.timesteps=4 scene.cameras=4 scene.resolution=16"
    fitted = prepare_training(compose([*scene.split(), "model.primitives=20", f"output_dir={tmp_path / 'out'}"]))
    assert fitted.trainer.settings.supervision == "both" and fitted.trainer.settings.voxels_every > 1
    compared, compare = [], Trainer.compare_points
    monkeypatch.setattr(Trainer, "compare_points", lambda *own: compared.append(1) or compare(*own))  # type: ignore[func-returns-value]
    compile_run_kernels(fitted.trainer)
    assert compared == [1] and fitted.trainer.step == 0


def test_a_sequence_is_judged_by_held_out_training_views(tmp_path: Path) -> None:
    """Its films are of test cameras, whose views nobody has then."""
    scene = "task=dynamic scene=smoke_fire scene.size=16 scene.timesteps=6 scene.cameras=6 scene.resolution=16"
    asked = [*scene.split(), "model.primitives=20"]
    config = compose([*asked, "train.iterations=2", "train.max_seconds=null", f"output_dir={tmp_path / 'out'}"])
    fitted = train_to_end(prepare_training(config, hold_out=3))
    metrics = fitted.metrics()
    assert metrics["split"] == "train, held out" and "per_frame" not in metrics
    assert len(metrics["per_view"]) == len(fitted.dataset.test) == 8
    assert not {view["name"] for view in metrics["per_view"]} & {
        fitted.dataset.train.view(i).name for i in range(len(fitted.dataset.train))
    }
