"""Which layers there are: what a task may declare, and what a user may choose."""

from __future__ import annotations

import pytest

from neuprim.core.errors import ConfigError
from neuprim.core.render.layer_frame import COMMON, LayerSpec, select_layers

HEAT = LayerSpec("heat", "temperature, kelvin", lambda frame: None, ("K",))
GLOW = LayerSpec("glow", "light of the glow", lambda frame: None)
USUAL = ["beauty", "alpha", "depth", "density"]


def names(text: str | None, several: bool = False) -> list[str]:
    return [spec.name for spec in select_layers(text, (HEAT, GLOW), several)]


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
        select_layers(text, (HEAT, GLOW), several)
