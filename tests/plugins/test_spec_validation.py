"""Descriptions of plugins are checked when they are loaded."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any

import pytest

from neuprim.core.extensions import Exporter, ExportReport, Inspector, SceneExtension
from neuprim.core.model.fields import ConditionSpec, DensityField
from neuprim.core.render.layer_frame import LayerSpec
from neuprim.core.task import SceneSpec
from neuprim.core.train.settings import OPTIONAL
from neuprim.core.validation import Range
from neuprim.plugins.registry import LOSSES, PLUGIN_GROUPS, load_task
from neuprim.plugins.spec_validation import validate_spec

TASK = load_task("static")
LOSS = LOSSES.load("photometric")
SCENE = SceneSpec("ball", "one ball", print)  # type: ignore[arg-type]
EXTENSION = SceneExtension(1, "static", SCENE, "package.conf")
TIME = ConditionSpec("time", (), "1", (0.0, 1.0), lambda text: [])
HEAT = LayerSpec("heat", "temperature, K", lambda frame: None, ("T",))
EXPORTER = Exporter(1, "mine", "nothing", lambda job: ExportReport((), False))
INSPECTOR = Inspector(1, "mine", "nothing", lambda frame: [])


def test_all_built_in_plugins_are_valid() -> None:
    for group in PLUGIN_GROUPS:
        assert all(report.error is None for report in group.survey() if report.info.built_in)
    assert validate_spec(replace(TASK, uses=OPTIONAL, conditions=(TIME,), layers=(HEAT,))) is None
    assert validate_spec(EXTENSION) is validate_spec(EXPORTER) is validate_spec(INSPECTOR) is None


@pytest.mark.parametrize(
    ("spec", "member", "value", "text"),
    [
        (TASK, "build", 3, "build is of type int; expected a function"),
        (TASK, "summary", "", "summary is ''; expected text"),
        (TASK, "scenes", ("ball",), "scenes[0] is of type str; expected a SceneSpec"),
        (TASK, "scenes", (SCENE, SCENE), "scenes has a name twice: ball, ball"),
        (TASK, "conditions", 3, "conditions is of type int; expected a tuple of ConditionSpec"),
        (TASK, "conditions", (replace(TIME, parse=None),), "conditions[0].parse is of type NoneType; expected a func"),
        (TASK, "conditions", (replace(TIME, range=(1.0, 1.0)),), "range is (1.0, 1.0); expected a lower and a higher"),
        (TASK, "fields", {"X": int}, "fields['X'] is <class 'int'>; expected a subclass"),
        (TASK, "fields", {"X": DensityField}, "fields['X'] lacks the methods density, lower"),
        (TASK, "channels", "RGB", "channels is of type str; expected a tuple"),
        (TASK, "channels", ("A",), "channels[0] is 'A'; expected another name"),
        (TASK, "layers", (replace(HEAT, name="a b"),), "layers[0].name is 'a b'; expected at most 31 letters"),
        (TASK, "layers", (replace(HEAT, name="depth"),), "layers[0].name is 'depth', which is taken"),
        (TASK, "layers", (replace(HEAT, channels=("T", "T")),), "layers[0].channels[1] is 'T' again"),
        (EXTENSION, "scene", None, "scene is of type NoneType; expected a SceneSpec"),
        (EXTENSION, "scene", replace(SCENE, load=None), "scene.load is of type NoneType; expected a function"),
        (LOSS, "uses", ("model.neurons",), "uses has 'model.neurons'; expected some of train.ssim_weight"),
        (EXPORTER, "options", {"size": 1}, "options['size'] is 1; expected (default, one line of help)"),
        (EXPORTER, "default", "../x", "default is '../x'; expected the name of a file or folder"),
    ],
)
def test_a_member_that_cannot_be_used_is_named(spec: Any, member: str, value: Any, text: str) -> None:
    assert text in (validate_spec(replace(spec, **{member: value})) or "")


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"options": 3}, "options is of type int; expected a mapping"),
        ({"options": {"gain": 1.0}}, "options['gain'] is 1.0; expected (default, one line of help)"),
        ({"options": {"gain": (1.0, None)}}, "options['gain'] is (1.0, None); expected (default, one line of help)"),
        ({"options": {"a b": (1.0, "x")}}, "options has 'a b'; expected a name"),
        ({"options": {"gain": (object, "x")}}, "options['gain'] has a default of type type; expected what YAML can"),
        (
            {"options": {"gain": (2.0, "x", Annotated[float, Range(0, 1)])}},
            "the default of options['gain']=2.0: expect",
        ),
        ({"options": {"gain": ("soft", "x", ("hard", "even"))}}, "options['gain']=soft: expected hard or even"),
        ({"uses": 3}, "uses is of type int; expected a tuple"),
        ({"uses": ("neurons",)}, "uses has 'neurons'; expected some of"),
    ],
)
@pytest.mark.parametrize("spec", [TASK, LOSS], ids=["task", "loss"])
def test_options_and_uses_are_checked(spec: Any, changes: dict[str, Any], text: str) -> None:
    assert text in (validate_spec(replace(spec, **changes)) or "")
