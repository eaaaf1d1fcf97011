"""A renderer backend is one row of one table: everything that names, chooses, compiles or judges backends reads it
there."""

from __future__ import annotations

import ast
import io
import json
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from rich.console import Console

import neuprim
from neuprim.cli import doctor, main
from neuprim.config import RunConfig, compose
from neuprim.core.cameras.projections import AnyCamera
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.core.model.fields import Constant, CustomDensity
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderOutput, RenderSettings, backends, probe_backend, render_lowered
from neuprim.core.render.backends import Backend
from neuprim.core.render.draw import Draw
from neuprim.core.render.reference.backend import render as reference
from tests import scenes
from tests.core import tiny
from tests.short_runs import words


@dataclass
class Fake:
    """The reference under another name, which knows constant colours alone."""

    frames: int = 0
    broken: str | None = None
    dim: float = 1.0

    def load(self) -> Draw:
        def render(lowered: Lowered, *rest: Any) -> RenderOutput:
            assert isinstance(lowered.colour, Constant)
            self.frames += 1
            output = reference(lowered, *rest)
            output.stats.backend = "fake"
            return replace(output, rgb=output.rgb * self.dim)

        return render

    def unsupported(self, lowered: Lowered, camera: AnyCamera | None) -> str | None:
        return None if isinstance(lowered.colour, Constant) else f"{type(lowered.colour).__name__} colour"

    def missing(self) -> str | None:
        return self.broken


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Iterator[Fake]:
    """Registered in the table, first, and nowhere else."""
    made = Fake()
    row = Backend("fake", made.load, made.unsupported, lambda: "fake device", made.missing)
    monkeypatch.setattr(backends, "TABLE", (row, *backends.TABLE))
    yield made


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


def test_commands_know_it(fake: Fake, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)
    monkeypatch.setattr(
        "neuprim.runs.compile.subprocess.Popen", lambda *a, **k: pytest.fail("nothing of this run compiles ahead")
    )
    folder = tmp_path / "run"
    assert main(["run", *words(scene, folder, 3, "renderer.backend=fake")]) == 0
    drawn = fake.frames
    assert drawn > 4 and RunConfig.from_yaml(folder).renderer.backend == "fake"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["backend"] == "fake" and metrics["device"] == "fake device"
    assert "fake" in (folder / "report.html").read_text()
    assert main(["eval", str(folder)]) == 0
    evaluated = fake.frames
    assert evaluated > drawn
    assert main(["render", str(folder), "--camera", "orbit", "--frames", "2", "--out", str(tmp_path / "frames")]) == 0
    assert fake.frames > evaluated


def test_a_run_without_it_says_what_there_is(
    fake: Fake, scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(backends, "TABLE", backends.TABLE[1:])
    with pytest.raises(ConfigError, match=r"^renderer\.backend=fake: expected auto, cuda, cpu or reference$"):
        compose(words(scene, tmp_path / "run", 3, "renderer.backend=fake"))


def test_a_wrong_name_is_told_the_table(fake: Fake, scene: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"^renderer\.backend=fke: expected auto, fake, cuda, cpu or reference$"):
        compose(words(scene, tmp_path / "run", 3, "renderer.backend=fke"))
    low, camera = scenes.lowered(scenes.tensors(3)), scenes.camera(8, 8)
    with pytest.raises(ConfigError, match=r"^renderer\.backend=gpu: expected auto, fake, cuda, cpu or reference$"):
        render_lowered(low, camera, RenderSettings(backend="gpu"))
    with pytest.raises(ConfigError, match=r"^renderer\.backend=null: expected auto or the name of a backend$"):
        RenderSettings(backend=None)  # type: ignore[arg-type]


def test_auto_is_the_first_that_does_not_refuse(fake: Fake) -> None:
    low, camera = scenes.lowered(scenes.tensors(3)), scenes.camera(8, 8)
    net = scenes.lowered(scenes.tensors(3, hidden=2))
    assert backends.choose_backend(low, RenderSettings(), camera).name == "fake"
    assert render_lowered(low, camera, RenderSettings()).stats.backend == "fake" and fake.frames == 1
    assert backends.choose_backend(net, RenderSettings(), camera).name == "cpu"
    assert (
        backends.choose_backend(
            replace(net, density=CustomDensity(lambda prim, o, d, t0, t1: t1 - t0)), RenderSettings(), camera
        ).name
        == "reference"
    )
    fake.broken = "no such device"
    assert backends.choose_backend(low, RenderSettings(), camera).name == "cpu"
    here = ["cpu", "reference"] if backends.gpu_unavailable() else ["cuda", "cpu", "reference"]
    assert [b.name for b in backends.available_backends()] == here and backends.backend_names() == (
        "fake",
        "cuda",
        "cpu",
        "reference",
    )


def test_a_refusal_names_it_and_one_that_can(fake: Fake) -> None:
    net, camera = scenes.lowered(scenes.tensors(3, hidden=2)), scenes.camera(8, 8)
    with pytest.raises(
        BackendUnavailable, match=r"^renderer\.backend=fake cannot draw RayNet colour\. Use renderer\.backend=cpu$"
    ):
        render_lowered(net, camera, RenderSettings(backend="fake"))
    fake.broken = "no such device"
    with pytest.raises(
        BackendUnavailable,
        match=r"^renderer\.backend=fake cannot run here: no such device\. Use renderer\.backend=cpu$",
    ):
        render_lowered(scenes.lowered(scenes.tensors(3)), camera, RenderSettings(backend="fake"))


def test_numbers_that_are_not_finite_are_refused_for_it(fake: Fake) -> None:
    t = scenes.tensors(5)
    t["w2"][3, 0] = torch.nan
    with pytest.raises(neuprim.core.errors.NonFiniteError, match="w2 of primitive 3 is not finite"):
        render_lowered(scenes.lowered(t), scenes.camera(8, 8), RenderSettings(backend="fake"))
    assert fake.frames == 0


def diagnosis() -> dict[str, str]:
    console = Console(file=io.StringIO(), width=200)
    doctor.doctor(console)
    text = console.file.getvalue()  # type: ignore[attr-defined]
    return dict(re.findall(r"^\W*(fake|cpu|reference)\W+((?:works|does not work)[^\n│]*?)\W*$", text, re.M))


def test_doctor_asks_every_row(fake: Fake, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        backends, "TABLE", tuple(b for b in backends.TABLE if b.name != "cpu")
    )  # whose kernels take long to load
    assert diagnosis() == {"fake": "works", "reference": "works"}
    assert fake.frames == 1
    fake.dim = 0.5
    assert "does not work: drew 0.43" in diagnosis()["fake"]
    fake.broken = "no such device"
    assert diagnosis()["fake"] == "does not work: no such device"
    assert probe_backend("reference") is None


def test_gradients_of_intrinsics_are_asked_of_the_row(fake: Fake, monkeypatch: pytest.MonkeyPatch) -> None:
    t = scenes.tensors(4)
    t["b2"] = t["b2"][:, 0]
    camera = scenes.camera(8, 6)
    K = torch.tensor(
        [[[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]]], dtype=torch.float64, requires_grad=True
    )

    def draw() -> Any:
        return neuprim.rasterize(**t, viewmats=camera.viewmat[None], Ks=K, width=8, height=6, backend="fake")

    with pytest.raises(
        BackendUnavailable, match=r'Ks requires a gradient, which backend="fake" .* pass backend="reference" or'
    ):
        draw()
    able = tuple(replace(b, differentiates_intrinsics=True) for b in backends.TABLE)
    monkeypatch.setattr(backends, "TABLE", able)
    draw().rgb.sum().backward()
    assert fake.frames == 1 and K.grad is not None and K.grad.abs().max() > 0


def test_what_compiles_is_compiled_ahead(fake: Fake, monkeypatch: pytest.MonkeyPatch) -> None:
    ahead = backends.precompiled_backend
    assert ahead(RenderSettings(backend="fake")) is None and ahead(RenderSettings(backend="reference")) is None
    assert ahead(RenderSettings()).name == "cpu"  # type: ignore[union-attr]
    monkeypatch.setattr(backends, "TABLE", (replace(backends.TABLE[0], compiles=True), *backends.TABLE[1:]))
    assert ahead(RenderSettings()).name == ahead(RenderSettings(backend="fake")).name == "fake"  # type: ignore[union-attr]


def test_a_table_costs_no_backend() -> None:
    """Numba alone takes a second to import."""
    program = "import sys, neuprim.core.render as r; r.backends.backend_names(); r.backends.available_backends(); print('numba' in sys.modules)"
    found = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert found.stdout.strip() == "False"


def named(file: Path) -> Iterator[int]:
    """Lines on which code compares a backend with a name, or passes one."""
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.keyword) and node.arg == "backend":
            values = [node.value]
        elif isinstance(node, ast.Compare) and "backend" in ast.unparse(node):
            values = [node.left, *node.comparators]
        else:
            continue
        constants = (n for value in values for n in ast.walk(value) if isinstance(n, ast.Constant))
        yield from (n.lineno for n in constants if isinstance(n.value, str) and n.value in backends.backend_names())


def test_nothing_else_names_a_backend(tmp_path: Path) -> None:
    """No code decides by a backend's name; who wants the oracle says so."""
    root = Path(neuprim.__file__).parent
    assert [f"{file.relative_to(root)}:{line}" for file in sorted(root.rglob("*.py")) for line in named(file)] == []
    (tmp_path / "x.py").write_text(
        'if settings.backend != "reference":\n    draw(RenderSettings(backend="cpu"))\nbackend = "cpu"\n'
    )
    assert list(named(tmp_path / "x.py")) == [1, 2]
