"""A renderer backend is one row of one table: everything that names, chooses or compiles backends reads it there."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch

import neuprim
from neuprim.cli import main
from neuprim.config import RunConfig, compose
from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.errors import BackendUnavailable, ConfigError, NonFiniteError
from neuprim.core.model.fields import Constant, CustomDensity
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import RenderOutput, RenderSettings, backends, render_lowered
from neuprim.core.render.backends import Backend, choose_backend
from neuprim.core.render.output import Draw
from neuprim.core.render.reference import render as reference
from tests import scenes
from tests.core import tiny
from tests.short_runs import command_line, words


@dataclass
class Fake:
    """The reference under another name, which knows constant colours alone."""

    frames: int = 0
    broken: str | None = None
    dim: float = 1.0

    def load(self) -> Draw:
        def render(lowered: LoweredPrimitives, *rest: Any) -> RenderOutput:
            assert isinstance(lowered.colour, Constant)
            self.frames += 1
            output = reference(lowered, *rest)
            output.stats.backend = "fake"
            return replace(output, rgb=output.rgb * self.dim)

        return render

    def unsupported(self, lowered: LoweredPrimitives, camera: AnyCamera | None) -> str | None:
        return None if isinstance(lowered.colour, Constant) else f"{type(lowered.colour).__name__} colour"


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Fake:
    """Registered in the table, first, and nowhere else."""
    made = Fake()
    row = Backend("fake", made.load, made.unsupported, lambda: "fake device", lambda: made.broken)
    monkeypatch.setattr(backends, "TABLE", (row, *backends.TABLE))
    return made


def test_commands_know_it(fake: Fake, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)
    scene, folder = tiny.write_blender(tmp_path / "two"), tmp_path / "run"
    assert main(["run", *command_line(words(scene, folder, 3, "renderer.backend=fake"))]) == 0
    drawn = fake.frames
    assert drawn > 4 and RunConfig.from_yaml(folder).renderer.backend == "fake"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["backend"] == "fake" and metrics["device"] == "fake device"
    assert main(["eval", str(folder)]) == 0 and fake.frames > drawn


def test_a_wrong_name_is_answered_with_the_table(fake: Fake, tmp_path: Path) -> None:
    valid = r"expected auto, fake, cuda, cpu or reference$"
    with pytest.raises(ConfigError, match=r"^renderer\.backend=fke: " + valid):
        compose(words(tmp_path, tmp_path / "run", 3, "renderer.backend=fke"))
    low, camera = scenes.lowered(scenes.tensors(3)), scenes.camera(8, 8)
    with pytest.raises(ConfigError, match=r"^renderer\.backend=gpu: " + valid):
        render_lowered(low, camera, RenderSettings(backend="gpu"))
    with pytest.raises(ConfigError, match=r"^renderer\.backend=null: expected auto or the name of a backend$"):
        RenderSettings(backend=None)  # type: ignore[arg-type]


def test_auto_is_the_first_that_can_draw_the_frame(fake: Fake) -> None:
    low, camera = scenes.lowered(scenes.tensors(3)), scenes.camera(8, 8)
    net = scenes.lowered(scenes.tensors(3, hidden=2))
    custom = replace(net, density=CustomDensity(lambda prim, o, d, t0, t1: t1 - t0))
    chosen = [choose_backend(x, RenderSettings(), camera).name for x in (low, net, custom)]
    assert chosen == ["fake", "cpu", "reference"]
    assert render_lowered(low, camera, RenderSettings()).stats.backend == "fake" and fake.frames == 1
    fake.broken = "no such device"
    assert choose_backend(low, RenderSettings(), camera).name == "cpu"
    here = ["cpu", "reference"] if backends.gpu_backends_unavailable() else ["cuda", "cpu", "reference"]
    assert [b.name for b in backends.available_backends()] == here
    assert backends.backend_names() == ("fake", "cuda", "cpu", "reference")


def test_a_refusal_names_it_and_one_that_can(fake: Fake) -> None:
    low, camera, settings = scenes.lowered(scenes.tensors(3)), scenes.camera(8, 8), RenderSettings(backend="fake")
    with pytest.raises(
        BackendUnavailable, match=r"^renderer\.backend=fake cannot draw RayNet.* renderer\.backend=cpu$"
    ):
        render_lowered(scenes.lowered(scenes.tensors(3, hidden=2)), camera, settings)
    t = scenes.tensors(5)
    t["w2"][3, 0] = torch.nan
    with pytest.raises(NonFiniteError, match="w2 of primitive 3 is not finite"):
        render_lowered(scenes.lowered(t), camera, settings)
    assert fake.frames == 0
    fake.broken = "no such device"
    with pytest.raises(BackendUnavailable, match=r"^renderer\.backend=fake cannot run here: no such device\. Use "):
        render_lowered(low, camera, settings)


def test_gradients_of_intrinsics_are_asked_of_the_row(fake: Fake, monkeypatch: pytest.MonkeyPatch) -> None:
    t = scenes.tensors(4)
    t["b2"] = t["b2"][:, 0]
    camera = scenes.camera(8, 6)
    K = torch.tensor([[[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]], dtype=torch.float64)
    K.requires_grad_()

    def draw() -> Any:
        return neuprim.rasterize(t, camera.viewmat[None], K, (8, 6), backend="fake")

    with pytest.raises(BackendUnavailable, match=r'Ks requires a gradient, which backend="fake" .*backend="reference"'):
        draw()
    able = tuple(replace(b, differentiates_intrinsics=True) for b in backends.TABLE)
    monkeypatch.setattr(backends, "TABLE", able)
    draw().rgb.sum().backward()
    assert K.grad is not None and K.grad.abs().max() > 0


def test_the_table_imports_no_backend() -> None:
    """Numba alone takes a second to import."""
    program = "import sys, neuprim.core.render.backends as b, neuprim.cli; b.available_backends()"
    program += "; b.gpu_backends_unavailable()"
    program += "; print('numba' in sys.modules, 'warp' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["False", "False"]
