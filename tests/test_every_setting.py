"""Every field of every settings dataclass, found by introspection: a new field is covered by itself."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from neuprim.core.errors import ConfigError
from neuprim.core.validation import field_types, join_setting_key, validate_settings
from tests.settings_classes import bad_values, required, settings_classes, unbounded_numbers

CLASSES = settings_classes()
FIELDS = [(cls, name) for cls in CLASSES for name in field_types(cls)]

GROUPS = {
    "RunSettings": "",
    "_StoredConfig": "",
    "RenderSettings": "renderer",
    "MetricsSettings": "metrics",
    "ModelSettings": "model",
    "TrainSettings": "train",
    "PopulationSettings": "train.population",
    "Optics": "scene.optics",
    "Light": "scene.optics.light",
    "LauncherSettings": "launcher",
    "ViewerSettings": "viewer",
}
"""The dotted names under which users type them; of all others it is ``scene``."""


def group(cls: type) -> str:
    """The dotted name under which users type the settings."""
    return GROUPS.get(cls.__name__, "scene")


def named(value: object) -> str:
    return value.__name__ if isinstance(value, type) else str(value)


def refusal(cls: type, values: dict[str, Any]) -> str:
    with pytest.raises(ConfigError) as caught:
        validate_settings(cls, values, group(cls))
    return str(caught.value)


def test_they_are_found() -> None:
    names = {cls.__name__ for cls in CLASSES}
    assert names >= {
        "RenderSettings",
        "TrainSettings",
        "VdbSceneSettings",
        "OlatSettings",
        "SolidsSettings",
        "Optics",
    }
    assert all(dataclasses.is_dataclass(cls) for cls in CLASSES) and len(FIELDS) > 100


@pytest.mark.parametrize("cls", CLASSES, ids=named)
def test_defaults_are_what_they_accept(cls: type) -> None:
    made = validate_settings(cls, required(cls), group(cls))
    assert validate_settings(cls, {f.name: getattr(made, f.name) for f in dataclasses.fields(cls)}, group(cls)) == made


@pytest.mark.parametrize(("cls", "field"), FIELDS, ids=named)
def test_a_number_has_bounds_or_says_why_not(cls: type, field: str) -> None:
    assert unbounded_numbers(field_types(cls)[field]) == []


@pytest.mark.parametrize(("cls", "field"), FIELDS, ids=named)
def test_what_a_field_does_not_take_is_refused_in_one_line_with_its_key(cls: type, field: str) -> None:
    values = bad_values(field_types(cls)[field])
    key = join_setting_key(group(cls), field)
    for value in values:
        text = refusal(cls, {**required(cls), field: value})
        assert text.startswith(key) and "\n" not in text, (value, text)
        assert "expected " in text or "no such setting" in text, (value, text)
    assert values or "Any" in str(field_types(cls)[field])


@pytest.mark.parametrize(("cls", "field"), FIELDS, ids=named)
def test_python_code_is_told_the_same(cls: type, field: str) -> None:
    """The dataclass itself, and ``dataclasses.replace``, refuse what users may not type."""
    made = cls(**required(cls))
    for value in bad_values(field_types(cls)[field]):
        for make in (
            lambda v=value: cls(**{**required(cls), field: v}),
            lambda v=value: dataclasses.replace(made, **{field: v}),
        ):
            with pytest.raises(ConfigError) as caught:
                make()
            assert str(caught.value) == refusal(cls, {**required(cls), field: value})


@pytest.mark.parametrize(("cls", "field"), FIELDS, ids=named)
def test_a_name_that_is_nearly_a_field_is_told_the_field(cls: type, field: str) -> None:
    wrong = f"{field}s"
    text = refusal(cls, {**required(cls), wrong: 1})
    assert (
        text.startswith(f"{join_setting_key(group(cls), wrong)}: no such setting; did you mean ") and "\n" not in text
    )
    assert repr(join_setting_key(group(cls), field)) in text
