"""Settings from plain values: what is converted, what is refused, and in which words."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import pytest

from neuprim.core.errors import ConfigError
from neuprim.core.validation import (
    Range,
    infer_type_to_validate,
    nonempty_text,
    option_type_to_validate,
    validate_choices,
    validate_fields,
    validate_settings,
    validate_value,
)


@dataclass(frozen=True)
class Inner:
    size: Annotated[int, Range(8, 64)] = 16
    name: Annotated[str, nonempty_text("the name of a file")] = "a"


@dataclass
class Outer:
    """What a plugin may declare: some fields without defaults, and nothing that checks when Python code makes one."""

    path: Annotated[Path, nonempty_text("a folder")]
    inner: Inner = field(default_factory=Inner)
    every: Annotated[int, Range(at_least=2, also=(0,))] = 0
    form: Literal["sharp", "soft"] = "soft"
    exposure: Annotated[float, Range(above=0)] | Literal["auto"] = 1.0
    rates: dict[str, Annotated[float, Range(at_least=0)]] = field(default_factory=dict)
    grids: Mapping[Literal["density", "flames"], str] = field(default_factory=dict)
    range: tuple[float, float] | None = None
    free: Any = None


def test_what_loses_nothing_is_converted() -> None:
    values = {"path": 123, "inner": {"size": 32.0}, "exposure": "1e-3", "rates": {"a": 1}, "range": [0, 1]}
    made = validate_settings(Outer, {**values, "free": object}, "scene")
    assert made.path == Path("123") and made.inner == Inner(size=32) and isinstance(made.inner.size, int)
    assert (
        made.exposure == 1e-3
        and isinstance(made.rates["a"], float)
        and made.range == (0.0, 1.0)
        and made.free is object
    )
    assert validate_settings(Outer, {"path": "x", "exposure": "auto", "inner": Inner(9)}).inner.size == 9
    assert validate_settings(Outer, made) is made


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"pth": "x"}, "scene.pth: no such setting; did you mean 'scene.path'?"),
        ({}, "scene.path: required and not given; expected a folder"),
        ({"path": ""}, "scene.path='': expected a folder"),
        ({"path": "a\0b"}, "scene.path='a\\x00b': expected a folder"),
        ({"path": "x", "inner": {"size": 7}}, "scene.inner.size=7: expected a whole number from 8 to 64"),
        ({"path": "x", "inner": {"size": True}}, "scene.inner.size=true: expected a whole number from 8 to 64"),
        ({"path": "x", "inner": {"size": "32"}}, "scene.inner.size='32': expected a whole number from 8 to 64"),
        ({"path": "x", "inner": {"sise": 32}}, "scene.inner.sise: no such setting; did you mean 'scene.inner.size'?"),
        ({"path": "x", "inner": 3}, "scene.inner=3: expected settings, each as scene.inner.KEY=VALUE"),
        ({"path": "x", "every": 1}, "scene.every=1: expected 0, or a whole number of at least 2"),
        ({"path": "x", "form": "soft\n"}, "scene.form='soft\\n': expected sharp or soft"),
        ({"path": "x", "exposure": 0}, "scene.exposure=0: expected a number above 0, or auto"),
        ({"path": "x", "exposure": math.nan}, "scene.exposure=nan: expected a finite number above 0, or auto"),
        (
            {"path": "x", "exposure": 10**400},
            f"scene.exposure=1{76 * '0'}...: expected a finite number above 0, or auto",
        ),
        ({"path": "x", "rates": {"a": -1}}, "scene.rates.a=-1: expected a number of at least 0"),
        ({"path": "x", "rates": 1}, "scene.rates=1: expected entries, each as scene.rates.KEY=VALUE"),
        (
            {"path": "x", "grids": {"smoke": "s"}},
            "scene.grids.smoke: no such setting; valid: scene.grids.density, scene.grids.flames",
        ),
        ({"path": "x", "range": [0]}, "scene.range=[0]: expected a list of a finite number, a finite number, or null"),
    ],
)
def test_one_line_with_key_value_and_what_is_expected(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError) as caught:
        validate_settings(Outer, values, "scene")
    assert str(caught.value) == message


@dataclass(frozen=True)
class Verified:
    low: Annotated[float, Range(at_least=0)] = 0.0
    high: Annotated[float, Range(at_least=0)] = 1.0

    def __post_init__(self) -> None:
        validate_fields(self, "scene")
        if self.low > self.high:
            raise ConfigError(f"scene.low={self.low:g}: expected at most scene.high, {self.high:g}")


def test_python_code_is_checked_too_and_rules_between_fields_see_converted_values() -> None:
    assert isinstance(Verified(low="0.5").low, float)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=r"^scene\.low=-1: expected a number of at least 0$"):
        replace(Verified(), low=-1)
    with pytest.raises(ConfigError, match=r"^scene\.low=2: expected at most scene\.high, 1$"):
        validate_settings(Verified, {"low": "2"}, "scene")


def test_free_settings_take_hints_types_and_tuples() -> None:
    offered = {"count": Annotated[int, Range(1, 4)], "form": ("a", "b"), "scale": float, "name": str}
    validate_choices({"count": 4, "form": "b", "scale": 3, "name": "x"}, "model.density", offered)
    for found, message in (
        ({"count": 5}, "model.density.count=5: expected a whole number from 1 to 4"),
        ({"count": 4.0}, "model.density.count=4.0: expected a whole number from 1 to 4"),
        ({"scale": "1e-3"}, "model.density.scale='1e-3': expected a finite number"),
        ({"form": "c"}, "model.density.form=c: expected a or b"),
        ({"name": 3}, "model.density.name=3: expected text (quote it: model.density.name='...')"),
        ({"cuont": 3}, "model.density.cuont: no such setting; did you mean 'model.density.count'?"),
    ):
        with pytest.raises(ConfigError) as caught:
            validate_choices(found, "model.density", offered)
        assert str(caught.value) == message
    with pytest.raises(ConfigError, match=r"^model\.colour\.x: no such setting; this group has no settings$"):
        validate_choices({"x": 1}, "model.colour", {})


def test_options_have_the_type_of_their_default_or_their_own() -> None:
    assert option_type_to_validate((1.0, "help")) is float and option_type_to_validate((None, "help")) is Any
    assert option_type_to_validate(("a", "help", ("a", "b"))) == Literal["a", "b"]
    assert validate_value([3], infer_type_to_validate([1, 2]), "x") == [3]
    with pytest.raises(ConfigError, match=r"^x=3: expected a list such as \[1, 2\]$"):
        validate_value(3, infer_type_to_validate([1, 2]), "x")
