"""Settings of model.colour: each belongs to a form."""

from __future__ import annotations

import pytest

from neuprim.config import compose
from neuprim.core.errors import ConfigError


def colour(*words: str) -> dict[str, object]:
    return compose(["task=relight", "scene=lit_solids", *words], False).model.colour


def test_each_form_takes_its_own_settings() -> None:
    assert colour() == {"form": "surface"}
    assert colour("model.colour.lobes=1", "model.colour.indirect=0")["lobes"] == 1
    assert colour("model.colour.form=additive", "model.colour.hidden=3")["hidden"] == 3
    assert colour("model.colour.form=harmonics", "model.colour.degree=2")["degree"] == 2
    assert colour("preset=paper", "model.colour.hidden=2")["visibility"] == "none"


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (
            ["model.colour.hidden=4"],
            "model.colour.hidden=4: not a setting of form=surface; expected model.colour.form=",
        ),
        (
            ["model.colour.form=additive", "model.colour.lobes=1"],
            "model.colour.lobes=1: not a setting of form=additive",
        ),
        (
            ["model.colour.form=harmonics", "model.colour.visibility=none"],
            "model.colour.visibility=none: not a setting",
        ),
        (["model.colour.visibility=pixel"], "model.colour: visibility 'pixel'; expected none or primitive"),
        (["model.colour.form=surfaces"], "model.colour.form=surfaces: expected"),
    ],
)
def test_a_setting_of_another_form_is_refused(words: list[str], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        colour(*words)
    assert str(caught.value).startswith(text) and "\n" not in str(caught.value)
