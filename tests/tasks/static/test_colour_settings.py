"""Which colour a static scene has: model.colour.form, and what it takes."""

from __future__ import annotations

import pytest

from neuprim.config import compose
from neuprim.core.errors import ConfigError
from neuprim.core.train.settings import build_settings
from neuprim.tasks.static import TASK, SphericalHarmonics, SphericalLobes
from tests.core import tiny


def colour(*words: str) -> object:
    config = compose(["task=static", "scene=solids", *words], False)
    return TASK.build(build_settings(TASK, config.model, config.options), tiny.two_primitives())[1]


def test_forms() -> None:
    default, three, harmonics = colour(), colour("model.colour.lobes=3"), colour("model.colour.form=sh")
    assert isinstance(default, SphericalLobes) and default.settings() == {"lobes": 2, "channels": 3}
    assert isinstance(three, SphericalLobes) and three.lobes == 3
    assert isinstance(harmonics, SphericalHarmonics) and harmonics.degree == 3
    assert isinstance(colour("preset=paper"), SphericalHarmonics)


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["preset=paper", "model.colour.lobes=2"], "model.colour.lobes=2: used only with model.colour.form="),
        (
            ["model.colour.form=lobes", "model.sh_degree=1"],
            "model.sh_degree=1: not used with model.colour.form=lobes; expected",
        ),
        (["model.colour.form=lobes", "model.colour.lobes=9"], "model.colour.lobes=9: 9 lobes; expected 0..8"),
        (["model.colour.form=lobes", "model.colour.lobes=1.5"], "model.colour.lobes=1.5: expected a whole number"),
        (["model.colour.form=lobe"], "model.colour.form=lobe: expected"),
        (["model.colour.lobe=1"], "model.colour.lobe: no such setting; did you mean 'model.colour.lobes'?"),
    ],
)
def test_what_does_not_go_together_is_refused(words: list[str], text: str) -> None:
    with pytest.raises(ConfigError) as caught:
        colour(*words)
    assert str(caught.value).startswith(text) and "\n" not in str(caught.value)


def test_another_form_takes_none_of_an_earlier_runs_lobes() -> None:
    earlier = compose(["task=static", "scene=solids", "model.colour.form=lobes", "model.colour.lobes=2"], False)
    assert compose(["model.colour.form=sh"], False, stored=earlier).model.colour == {"form": "sh"}
    assert compose(["model.primitives=50"], False, stored=earlier).model.colour == {"form": "lobes", "lobes": 2}


def test_what_a_search_may_change() -> None:
    for words, key in ((["model.colour.form=sh"], "model.sh_degree"), ([], "model.colour.lobes")):
        config = compose(["task=static", "scene=solids", *words], False)
        assert key in TASK.tunable_settings(build_settings(TASK, config.model, config.options))
