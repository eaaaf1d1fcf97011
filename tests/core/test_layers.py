"""Which layers there are: what a task may declare, and what a user may choose."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from neuprim.core.errors import ConfigError
from neuprim.core.layers import COMMON, LayerSpec, chosen_layers, layer_fault
from neuprim.plugins.members import fault
from neuprim.tasks.static import TASK as STATIC

HEAT = LayerSpec("heat", "temperature, kelvin", lambda frame: None, ("K",))
GLOW = LayerSpec("glow", "light of the glow", lambda frame: None)
USUAL = ["beauty", "alpha", "depth", "density"]


def names(text: str | None, several: bool = False) -> list[str]:
    return [spec.name for spec in chosen_layers(text, (HEAT, GLOW), several)]


def test_all_without_a_word_and_in_one_order_with() -> None:
    assert [spec.name for spec in COMMON] == USUAL
    assert names(None) == [*USUAL, "heat", "glow"] and names(None, several=True) == [*USUAL, "glow"]
    assert names("glow, depth ,beauty") == ["beauty", "depth", "glow"]
    assert names("beauty,lights", several=True) == ["beauty"], "lights are drawn beside the others"


@pytest.mark.parametrize(
    ("text", "several"),
    [("depht", False), ("lights", False), ("heat", True), ("", False), (",", False), ("beauty depth", False)],
)
def test_other_names_are_refused_with_those_that_there_are(text: str, several: bool) -> None:
    with pytest.raises(ConfigError, match=r"--layers .*; expected some of beauty, alpha, depth, density, .*glow"):
        chosen_layers(text, (HEAT, GLOW), several)


@pytest.mark.parametrize(
    ("layers", "words"),
    [
        ([HEAT], None),
        ((), None),
        (HEAT, "is of type LayerSpec; expected a tuple"),
        (("heat",), r"[0] is of type str; expected a LayerSpec"),
        ((replace(HEAT, name="depth"),), "[0].name is 'depth', which is taken"),
        ((replace(HEAT, name="lights"),), "[0].name is 'lights', which is taken"),
        ((replace(HEAT, name="light_007"),), "[0].name is 'light_007', which is taken"),
        ((HEAT, HEAT), "[1].name is 'heat', which is taken"),
        ((replace(HEAT, name="a.b"),), "[0].name is 'a.b'; expected at most 31 letters"),
        ((replace(HEAT, name="x" * 32),), "expected at most 31 letters"),
        ((replace(HEAT, summary=" "),), "[0].summary is ' '; expected text"),
        ((replace(HEAT, draw=3),), "[0].draw is of type int; expected a function"),  # type: ignore[arg-type]
        ((replace(HEAT, channels="K"),), "[0].channels is of type str; expected a tuple"),  # type: ignore[arg-type]
        ((replace(HEAT, channels=("K", "K")),), "[0].channels[1] is 'K' once more"),
    ],
)
def test_what_a_task_declares_is_checked(layers: Any, words: str | None) -> None:
    found = layer_fault(layers)
    assert found is None if words is None else words in str(found)
    member = fault(replace(STATIC, layers=layers))
    assert member is None if words is None else str(member).startswith("layers") and words in str(member)
