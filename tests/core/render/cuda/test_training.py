"""Every task trains through the kernels on Warp's CPU blocks as it does through the cpu backend, and says that this is
slow."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.config import compose
from neuprim.core import notices
from neuprim.core.io.vdb import write_vdb
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.runs.fit import start
from neuprim.runs.open import read_metrics
from neuprim.runs.run import run
from tests import scenes
from tests.core import tiny
from tests.short_runs import words
from tests.tasks.dynamic.sequences import blob

BLOCKS = ("renderer.backend=cuda", "renderer.device=cpu")
SMALL = [
    "model.primitives=80", "model.neurons=2", "train.max_seconds=null", "train.iterations=12", "train.population.every=5",
    "train.population.start=0.0",
]  # fmt: skip
LIT = [
    "task=relight",
    "scene=lit_solids",
    "scene.size=24",
    "scene.train_views=6",
    "scene.test_views=2",
    "scene.supersampling=1",
]


def configured(task: str, folder: Path) -> list[str]:
    if task == "static":
        return words(
            tiny.write_blender(folder / "two"),
            folder / "run",
            12,
            "train.population.every=5",
            "train.population.start=0.0",
        )
    if task == "relight":
        return [*LIT, *SMALL, "model.colour.hidden=3", f"output_dir='{folder / 'run'}'"]
    (folder / "ball").mkdir()
    for number in range(1, 4):
        write_vdb(folder / "ball" / f"ball_{number}.vdb", blob(6.0 + 3 * number))
    own = [
        "task=dynamic",
        "scene=vdb",
        f"scene.vdb='{folder / 'ball'}'",
        "scene.look=smoke_fire",
        "scene.size=24",
        "scene.cameras=4",
    ]
    return [*own, *SMALL, "scene.samples=1", f"output_dir='{folder / 'run'}'"]


@pytest.mark.parametrize("task", ["static", "dynamic", "relight"])
def test_first_gradients_are_the_cpu_backends(task: str, tmp_path: Path) -> None:
    """Before Adam divides them by their size, after which rounding of what is nearly zero is a step like any other."""
    config = configured(task, tmp_path)
    one = start(compose([*config, "renderer.backend=cpu"]))
    other = start(compose([*config, *BLOCKS]), dataset=one.dataset)
    reports = [x.trainer.train_step() for x in (one, other)]
    assert reports[1].loss == pytest.approx(reports[0].loss, rel=1e-5) and reports[0].loss > 1e-3
    for name, value in one.trainer.optimizer.m.items():
        found = other.trainer.optimizer.m[name]
        least = 1e-8 if name == "quats" else 0.0  # all of it is rounding, as fresh primitives are balls
        assert torch.allclose(found, value, rtol=1e-4, atol=1e-4 * float(value.abs().max()) + least), name
    assert float(one.trainer.optimizer.m["means"].abs().max()) > 0


@pytest.mark.parametrize("task", ["static", "dynamic", "relight"])
def test_a_run_is_the_cpu_backends(task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From data to report. Adam's first steps are as long where a gradient is nothing but rounding, so that runs drift
    apart a little."""
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)
    monkeypatch.setattr(notices, "_said", set())
    numbers: list[dict[str, Any]] = []
    for name, more in (("cpu", ["renderer.backend=cpu"]), ("cuda", [*BLOCKS])):
        folder = tmp_path / name
        folder.mkdir()
        config = configured(task, folder)
        if name == "cuda":
            with pytest.warns(notices.NeuprimWarning, match=r"^renderer\.backend=cuda is slow on the cpu") as said:
                numbers.append(read_metrics(run(compose([*config, *more]))))
            assert sum("is slow" in str(w.message) for w in said) == 1
        else:
            numbers.append(read_metrics(run(compose([*config, *more]))))
    one, other = numbers
    assert (one["backend"], other["backend"]) == ("cpu", "cuda")
    assert one["primitives"] == other["primitives"] and one["device"] == other["device"]
    assert other["psnr"] == pytest.approx(one["psnr"], abs=0.2) and other["psnr"] > 5


def test_the_warning_is_said_of_this_backend_alone(
    monkeypatch: pytest.MonkeyPatch, recwarn: pytest.WarningsRecorder
) -> None:
    monkeypatch.setattr(notices, "_said", set())
    low, camera = scenes.lowered(scenes.tensors(3)), scenes.camera(8, 8)
    for backend in ("cpu", "reference", "auto"):
        render_lowered(low, camera, RenderSettings(backend=backend, device="cpu"))
    assert not [w for w in recwarn if issubclass(w.category, notices.NeuprimWarning)]
    for _ in range(2):
        render_lowered(low, camera, RenderSettings(backend="cuda", device="cpu"))
    (said,) = [w for w in recwarn if issubclass(w.category, notices.NeuprimWarning)]
    assert (
        str(said.message)
        == "renderer.backend=cuda is slow on the cpu, where only its tests draw; renderer.backend=cpu is made for it"
    )
