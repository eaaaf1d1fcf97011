"""Lengths of trainings: equal in seconds, as long as the budget and no longer than the words say."""

from __future__ import annotations

import json

import pytest

from neuprim.config import RunConfig, compose
from neuprim.config.overrides import parse
from neuprim.core.errors import ConfigError
from neuprim.search.design.plan import Plan, planned
from neuprim.search.design.variants import CENTRE, Variant

WORDS = ["task=static", "scene=solids", "train.iterations=1000", "train.population.every=100"]


def centre(*more: str) -> RunConfig:
    return compose([*WORDS, *more], check_output=False)


def values(words: list[str]) -> dict[str, object]:
    found = {a.key: a.value for a in parse(words)}
    assert len(found) == len(words), "each setting once"
    return found


def test_all_the_seconds_there_are_are_used() -> None:
    plan = planned(centre(), pace=0.01, available=20.0, lengths=[1.0, 1.0, 0.5], starting=1.0)
    assert plan.steps == int((20.0 - 3.0) / 2.5 / 0.01) == 680 and plan.seconds == pytest.approx(6.8)
    assert plan.whole == 1000 and plan.paces == {CENTRE: 1.0}


def test_never_more_than_the_words_say_and_not_much_less() -> None:
    assert planned(centre(), 0.01, 1e6, [1.0], 0.0).steps == 1000
    assert planned(centre(), 0.01, 0.0, [1.0] * 20, 1.0).steps == 50, "what does not fit then is left out"
    seconds = centre("train.iterations=null", "train.max_seconds=5")
    assert planned(seconds, 0.01, 1e6, [1.0], 0.0).steps == 500 and planned(seconds, 0.01, 0.0, [1.0], 0.0).steps == 100
    with pytest.raises(ConfigError, match="nothing to train"):
        planned(centre(), 0.01, 1.0, [], 0.0)


def test_every_model_trains_as_long_as_the_centre() -> None:
    small, short = Variant("model.primitives", ("model.primitives=100",)), Variant("train.iterations", length=0.25)
    plan = Plan(400, 4.0, 1000, {CENTRE: 1.0}).knowing(small, 0.5).knowing(short, 1.0)
    assert [plan.steps_of(v) for v in (Variant(CENTRE), small, short)] == [400, 800, 100]


def test_words_have_the_length_and_as_many_interventions_as_a_whole_run() -> None:
    variant = Variant("model.neurons", ("model.neurons=4",))
    plan = Plan(400, 4.0, 1000, {CENTRE: 1.0}).knowing(variant, 0.8)
    typed = ["task=static", "scene=solids", "train.iterations=1000", "model.neurons=2"]
    config = compose(typed, check_output=False)
    assert config.train.population.every == 200
    found = values(plan.words_of(variant, typed, config))
    assert found == {
        "task": "static",
        "scene": "solids",
        "model.neurons": 4,
        "train.iterations": 500,
        "train.population.every": 100,
    }
    assert values(plan.words_of(variant, WORDS, centre()))["train.population.every"] == 100, "as typed"
    whole = Plan(1000, 10.0, 1000, {CENTRE: 1.0})
    assert whole.words_of(Variant(CENTRE), typed, config) == [
        "task=static",
        "scene=solids",
        "model.neurons=2",
        "train.iterations=1000",
    ]


def test_a_budget_in_seconds_becomes_one_in_steps() -> None:
    words = ["task=static", "scene=solids", "train.max_seconds=5"]
    config = compose(words, check_output=False)
    plan = Plan(300, 3.0, 0, {CENTRE: 1.0})
    made = compose(plan.words_of(Variant(CENTRE), words, config), check_output=False)
    assert (
        made.train.iterations == 300
        and made.train.max_seconds is None
        and made.train.population.every == config.train.population.every
    )


def test_a_plan_is_read_back_as_it_was() -> None:
    plan = Plan(400, 4.0, 1000, {CENTRE: 1.0, "neurons=4": 0.8})
    assert Plan.from_dict(json.loads(json.dumps(plan.to_dict()))) == plan
    for wrong in ({"steps": 0}, {"paces": {CENTRE: 0.0}}, {"paces": 3}, {"seconds": "x"}):
        with pytest.raises((ValueError, TypeError, AttributeError)):
            Plan.from_dict({**plan.to_dict(), **wrong})
