"""The words that ask for a viewer."""

from __future__ import annotations

import pytest

from neuprim.config.viewer import LOOPBACK, ViewerSettings, take_viewer
from neuprim.core.errors import ConfigError


@pytest.mark.parametrize(
    ("words", "found"),
    [
        ([], None),
        (["viewer=false", "viewer.port=1"], None),
        (["viewer=true"], ViewerSettings(LOOPBACK, 8080)),
        (["viewer.port=0"], ViewerSettings(LOOPBACK, 0)),
        (["++viewer=true", "viewer.port=9000", "viewer.host=0.0.0.0"], ViewerSettings("0.0.0.0", 9000)),
    ],
)
def test_words_about_the_viewer_are_taken_out(words: list[str], found: ViewerSettings | None) -> None:
    assert take_viewer(["task=static", *words, "seed=1"]) == (found, ["task=static", "seed=1"])


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["viewer=yes"], "viewer=yes: expected true or false"),
        (["viewer.port=70000"], r"viewer\.port=70000: expected a port, 1 to 65535, or 0 for any"),
        (["viewer.prot=80"], r"viewer\.prot: no such setting; did you mean 'viewer\.port'"),
        (["viewer.port=1,2"], r"viewer\.port: several values; expected one"),
    ],
)
def test_words_that_make_no_sense(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        take_viewer(words)
