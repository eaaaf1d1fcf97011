"""Kernels are compiled by a second process, once per task."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from neuprim.config import RunConfig, compose
from neuprim.core.train.trainer import Trainer
from neuprim.runs import kernel_compiler
from neuprim.runs.fit import Preparing
from neuprim.runs.kernel_compiler import KernelCompiler

LIT = "scene.lights=4"
RUNS = ["task=static scene=solids", "task=dynamic scene=smoke_fire", f"task=dynamic scene=smoke_fire {LIT}",
        "task=relight scene=lit_solids"]  # fmt: skip


def configured(words: str, folder: Path) -> RunConfig:
    return compose([*words.split(), f"output_dir={folder / 'run'}"])


@pytest.mark.parametrize("words", RUNS)
def test_a_step_on_noise_is_like_a_step_of_the_run(words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It has the run's fields and loss, and looks at points where the run has voxels."""
    taken: list[Trainer] = []
    step = Trainer.train_step
    monkeypatch.setattr(Trainer, "train_step", lambda self: taken.append(self) or step(self))  # type: ignore[func-returns-value]
    kernel_compiler._compile(RunConfig.from_dict(configured(words, tmp_path).to_dict()))
    (trainer,) = taken
    assert trainer.step > 0 and trainer.model.count <= 64
    assert (trainer.settings.supervision == "both") == ("dynamic" in words)
    assert ("light" in trainer.dataset.train.view(0).conditions) == ("relight" in words or LIT in words)


def test_it_runs_once_per_task(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_compiler, "cache_directory", lambda: tmp_path)
    monkeypatch.setattr(kernel_compiler, "core_count", lambda: 2)
    started: list[list[str]] = []
    popen = kernel_compiler.subprocess.Popen

    def recorded(command: list[str], **rest: Any) -> Any:
        started.append(command)
        return popen(command, **rest)

    monkeypatch.setattr(kernel_compiler.subprocess, "Popen", recorded)
    config, heard = configured(RUNS[0], tmp_path), list[Any]()
    first = KernelCompiler(config)
    first.wait(heard.append)
    assert first._process is not None and first._process.returncode == 0 and len(started) == 1
    assert [type(event) for event in heard] == [Preparing]
    KernelCompiler(config)
    assert len(started) == 2, "a run that was interrupted has compiled nothing"
    first.finish()
    KernelCompiler(configured(f"{RUNS[0]} model.neurons=3", tmp_path))
    assert len(started) == 2
    KernelCompiler(configured(RUNS[1], tmp_path))
    assert len(started) == 3, "another task"


@pytest.mark.parametrize("reason", ["one core", "a GPU", "a task of others"])
def test_it_does_not_run_where_it_cannot_help(reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(kernel_compiler, "cache_directory", lambda: tmp_path)
    monkeypatch.setattr(kernel_compiler, "core_count", lambda: 1 if reason == "one core" else 2)
    if reason == "a GPU":
        monkeypatch.setattr(kernel_compiler.device, "cuda_unavailable", lambda: None)
    if reason == "a task of others":
        found = [replace(info, distribution="others") for info in kernel_compiler.TASKS.list_plugins()]
        monkeypatch.setattr(type(kernel_compiler.TASKS), "list_plugins", lambda self: found)
    compiler = KernelCompiler(configured(RUNS[0], tmp_path))
    assert compiler._process is None
    compiler.wait(pytest.fail)
