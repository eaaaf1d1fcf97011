"""What is offered to be turned: what the task declares and its settings have, and nothing else."""

from __future__ import annotations

from dataclasses import replace

import pytest

from neuprim.config import compose, task_of
from neuprim.config.overrides import parse, quote_override
from neuprim.core.errors import ConfigError
from neuprim.core.task import TaskSpec
from neuprim.plugins.judging import TaskFault
from neuprim.search.design.variants import CENTRE, LENGTH, Variant, check_knobs, in_turn, merged, singles


def offered(*words: str) -> dict[str, list[Variant]]:
    config = compose(words, check_output=False)
    return singles(config, task_of(config))


def turned(ladder: list[Variant]) -> list[str]:
    return [" ".join(variant.turned) for variant in ladder]


def test_the_static_task_has_its_knobs_next_to_the_centre_first() -> None:
    found = offered("task=static", "scene=solids")
    assert list(found) == ["model.primitives", "model.neurons", "model.density.edge", "model.sh_degree", LENGTH]
    assert turned(found["model.primitives"]) == [
        f"model.primitives={count}" for count in (1400, 5600, 700, 11200, 350, 175, 88, 44)
    ]
    few = offered("task=static", "scene=solids", "model.primitives=4")["model.primitives"]
    assert turned(few) == [f"model.primitives={count}" for count in (2, 8, 1, 16)], "each once"
    assert turned(found["model.neurons"]) == ["model.neurons=0", "model.neurons=4", "model.neurons=8"], (
        "the preset has two"
    )
    assert turned(found["model.density.edge"]) == ["model.density.edge=1", "model.density.edge=0"]
    assert turned(found["model.sh_degree"]) == ["model.sh_degree=2", "model.sh_degree=1", "model.sh_degree=0"]
    assert [variant.length for variant in found[LENGTH]] == [0.5, 0.25]


def test_every_task_has_its_own_and_no_other() -> None:
    assert not {"model.neurons", "model.density.edge"} & offered("task=static", "model.density.form=gaussian").keys()
    dynamic = offered("task=dynamic", "scene=smoke_fire")
    assert {"model.density.time", "model.colour.powers", "model.colour.waves", "model.sh_degree"} <= dynamic.keys()
    assert "model.density.time=phase" in turned(dynamic["model.density.time"])
    relight = offered("task=relight")
    assert "model.sh_degree" not in relight and "model.colour.degree" not in relight
    assert turned(relight["model.colour.hidden"]) == [
        "model.colour.hidden=4",
        "model.colour.hidden=12",
        "model.colour.hidden=0",
    ]
    assert "model.colour.hidden" not in offered("task=relight", "model.colour.form=harmonics")


@pytest.mark.parametrize(
    "words",
    [("task=static",), ("task=dynamic", "scene=smoke_fire"), ("task=relight",), ("task=static", "preset=paper")],
)
def test_every_word_composes(words: tuple[str, ...]) -> None:
    for ladder in offered(*words).values():
        for variant in ladder:
            config = compose(merged(words, variant.turned), check_output=False)
            for assignment in parse(variant.turned):
                assert quote_override(assignment.key, assignment.value) == assignment.text
            assert config.task


def test_a_plugin_offers_what_it_likes_and_is_told_what_is_wrong() -> None:
    config = compose(["task=static"], check_output=False)

    def with_trade(found: object) -> dict[str, list[Variant]]:
        mine: TaskSpec = replace(task_of(config), trade=lambda model: found)
        return singles(config, mine)

    assert list(with_trade({})) == ["model.primitives", LENGTH]
    assert turned(with_trade({"task.options.haze": (True, "deep blue", 0.5)})["task.options.haze"]) == [
        "task.options.haze=true",
        "task.options.haze=deep blue",
        "task.options.haze=0.5",
    ]
    for wrong, text in (
        ([], "found a list"),
        ({"train.rates.means": (1,)}, "'train.rates.means'; expected"),
        ({"model.x": "abc"}, "has 'abc'"),
    ):
        with pytest.raises(TaskFault, match=text):
            with_trade(wrong)


def test_short_budgets_turn_as_many_knobs_as_they_can() -> None:
    a, b = [Variant("a", (f"a={i}",)) for i in range(3)], [Variant("b", ("b=0",))]
    assert turned(list(in_turn({"a": a, "b": b}))) == ["a=0", "b=0", "a=1", "a=2"]


def test_names_of_people_and_of_folders() -> None:
    assert Variant(CENTRE).name == CENTRE == Variant(CENTRE).folder
    both = Variant("combined", ("model.density.time='phase+window'", "model.neurons=0"), 0.5)
    assert both.name == "density.time='phase+window' neurons=0 0.5 of the length"
    assert both.folder == "density.time-phase+window-_neurons-0_0.5_of_the_length"
    assert (
        Variant("x", tuple(f"model.init.some_long_name_{i}=1" for i in range(9))).folder
        != Variant("x", ("model.init.some_long_name_0=1",)).folder
    )


def test_words_over_others_replace_them() -> None:
    assert merged(["a.b=1", "c=2", "a.b=3"], ["a.b=4", "d=5"]) == ["c=2", "a.b=4", "d=5"]


def test_no_such_knob() -> None:
    with pytest.raises(
        ConfigError,
        match=r"--knobs model\.neuron: no such knob of a model of task 'static'; did you mean 'model\.neurons'",
    ):
        check_knobs(["model.neuron"], offered("task=static"), "static")
