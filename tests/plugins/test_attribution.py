"""Errors in a plugin's code name its package, and what its functions return is checked."""

from __future__ import annotations

import errno
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.cli import main
from neuprim.core.data import Clip, View
from neuprim.core.data.dataset_check import DatasetError
from neuprim.core.errors import ConfigError, DataError
from neuprim.plugins.attribution import (
    PluginSource,
    ReturnError,
    RunPlugins,
    attribute_errors,
    call_task_clips,
    call_task_diagnose,
    call_task_facts,
    call_task_mask,
    call_task_metrics,
    call_task_orbit,
    call_task_tunable_settings,
    check_fields,
    find_plugin_source,
    guard_loss,
)
from neuprim.plugins.registry import EXPORTERS, PluginError, load_task
from tests.core import tiny
from tests.plugins.extras import LOSS, add
from tests.plugins.fakes import site

__all__ = ["site"]

STRANGER = PluginSource("task 'glow' of neuprim-glow 0.1", "tests")
DATA = tiny.two_primitives()
QUICK = (
    *("scene.size=8", "scene.train_views=3", "scene.test_views=1"),
    *("model.primitives=4", "train.iterations=1", "renderer.backend=reference"),
)


def test_a_crash_of_another_package_is_one_line() -> None:
    text = (
        r"^build of task 'glow' of neuprim-glow 0.1: ZeroDivisionError: division by zero \(test_attribution.py line \d+"
    )
    with pytest.raises(PluginError, match=text) as caught, attribute_errors(STRANGER, "build"):
        _ = 1 / 0
    assert isinstance(caught.value.__cause__, ZeroDivisionError)
    with pytest.raises(PluginError, match="SystemExit: 3"), attribute_errors(STRANGER, "build"):
        raise SystemExit(3)
    with pytest.raises(ZeroDivisionError), attribute_errors(PluginSource("task 'static' of neuprim 0.1", "")):
        _ = 1 / 0
    unchanged = (ConfigError("no"), KeyboardInterrupt(), OSError(errno.ENOSPC, "No space left on device"))
    for error in unchanged:
        with pytest.raises(type(error)) as refused, attribute_errors(STRANGER):
            raise error
        assert refused.value is error


def test_the_plugins_of_a_run(site: Path) -> None:
    add(site, "scene")
    add(site, "loss", package="fake_loss")
    plugins = RunPlugins("static", "extra", "extra")
    scene, loss = "scene 'extra' of fake-extra 0.3", "loss 'extra' of fake-loss 0.3"
    assert (plugins.task.built_in, plugins.scene.label, plugins.loss.label) == (True, scene, loss)
    with pytest.raises(ZeroDivisionError), plugins.attribute_errors():
        _ = 1 / 0
    variables: dict[str, Any] = {"__name__": "fake_loss.inner"}
    exec("def crash():\n    1 / 0", variables)
    with pytest.raises(PluginError, match=f"^{loss}: ZeroDivisionError: .*in crash"), plugins.attribute_errors():
        variables["crash"]()
    with pytest.raises(DataError, match=f"{scene}: two: no views"), plugins.attribute_errors():
        raise DatasetError("two: no views")
    with pytest.raises(PluginError, match=r"^task 'static' of neuprim .*: clips: found"), plugins.attribute_errors():
        raise ReturnError("clips: found nothing")
    assert RunPlugins("static", "solids").loss.built_in
    add(site, "exporter", package="neuprim_like", name="npz")
    assert find_plugin_source(EXPORTERS, "npz").built_in
    assert find_plugin_source(EXPORTERS, "neuprim-like:npz").label == "exporter 'npz' of neuprim-like 0.3"


@pytest.mark.parametrize(
    ("returned", "text"),
    [
        (lambda value: (3, {}), "value: found a int; expected one number as a tensor"),
        (lambda value: (value.expand(2), {}), "value: found torch.float32 of shape (2,)"),
        (lambda value: (value.detach(), {}), "value: found no gradient"),
        (lambda value: (value, 3), "parts: found a int"),
        (lambda value: (value, {"mse": value.reshape(1)}), "part 'mse': found torch.float32"),
    ],
)
def test_a_loss_that_returns_something_else_is_named(returned: Any, text: str) -> None:
    image = torch.ones(2, 2, 3, requires_grad=True)
    loss = guard_loss(lambda rendered, truth, frame: returned(rendered.mean()), STRANGER)
    with pytest.raises(PluginError) as caught:
        loss(image, image, None)  # type: ignore[arg-type]
    assert str(caught.value).startswith("loss of task 'glow' of neuprim-glow 0.1: ") and text in str(caught.value)
    with pytest.raises(PluginError, match="the loss is a int; expected a function"):
        guard_loss(3, STRANGER)  # type: ignore[arg-type]


def test_a_crash_is_one_line_of_the_command_and_does_not_end_a_sweep(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    add(site, "loss", LOSS.replace("        value = ", "        if weight == 2.0: [][1]\n        value = "))
    text = "loss of loss 'extra' of fake-extra 0.3: IndexError: list index out of range (__init__.py line 8, in loss)"
    words = ["task=static", "scene=solids", *QUICK, "train.loss=extra"]
    assert main(["run", "-m", *words, "task.options.weight=2.0,3.0", "--out", str(tmp_path / "s")]) == 2
    error = capsys.readouterr().err
    assert f": {text}" in error and "Traceback" not in error
    rows = (tmp_path / "s" / "sweep.csv").read_text()
    assert rows.count("failed") == 1 and rows.count("done") == 1, rows
    monkeypatch.setenv("NEUPRIM_TRACEBACK", "1")
    assert main(["run", *words, "task.options.weight=2.0", "--out", str(tmp_path / "r")]) == 2
    error = capsys.readouterr().err
    assert "Traceback" in error and error.splitlines()[-1] == f"neuprim: error: {text}"


CALLS: dict[str, Any] = {
    "clips": call_task_clips,
    "facts": call_task_facts,
    "diagnose": lambda task, data: call_task_diagnose(task, data, None),
    "orbit": lambda task, data: call_task_orbit(task, data, 3),
    "mask": lambda task, data: call_task_mask(task, data, 0),
    "metrics": lambda task, data: call_task_metrics(task, data, 0, DATA, DATA),
    "tunable_settings": lambda task, data: call_task_tunable_settings(task, {}),
}


@pytest.mark.parametrize(
    ("member", "found", "text"),
    [
        ("clips", 3, "clips: found a int; expected a list of neuprim.core.data.Clip"),
        ("clips", [Clip("x", (99,), 5.0)], "clips: 'x': found view 99; expected some below 2"),
        ("clips", [Clip("x", (), 5.0)], "clips: 'x': found no views"),
        ("facts", {"x": float("nan")}, "facts: x cannot be written as JSON"),
        ("orbit", [], "orbit: found no views"),
        ("mask", torch.ones(2, 2), "mask"),
        ("metrics", {"x": float("nan")}, "x: found nan"),
        ("metrics", {"psnr": 1.0}, "found the name psnr, which every"),
        ("tunable_settings", {"train.x": (1,)}, "tunable_settings: found 'train.x'; expected the name"),
        ("tunable_settings", {"model.x": "12"}, "tunable_settings: model.x: found '12'; expected a list"),
    ],
)
def test_what_a_tasks_function_returns_is_checked(member: str, found: Any, text: str) -> None:
    task = replace(load_task("static"), **{member: lambda *args: found})
    with pytest.raises(ReturnError, match=text):
        CALLS[member](task, DATA)


def test_what_a_task_returns_is_passed_on() -> None:
    task = replace(load_task("static"), metrics=lambda *args: {"x": float("inf")}, facts=lambda data: {"a": [1, "b"]})
    assert call_task_metrics(task, DATA, 0, DATA, DATA) == {"x": float("inf")}  # type: ignore[arg-type]
    assert call_task_facts(task, DATA).keys() == {"up", "center", "a"}
    assert all(isinstance(view, View) for view in call_task_orbit(task, DATA, 3))


def test_fields_of_a_build() -> None:
    model = tiny.trainer(DATA, 1).model
    check_fields(model.density, model.colour, DATA)
    with pytest.raises(
        ReturnError, match=r"build: density: found a NoneType; expected a neuprim.core.model.fields.Dens"
    ):
        check_fields(None, model.colour, DATA)
    model.colour.channels = 5
    with pytest.raises(ReturnError, match="build: channels of the colour: found 5; expected 3"):
        check_fields(model.density, model.colour, DATA)
