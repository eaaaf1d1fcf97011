"""Combinations of what was found alone, and the fronts of all."""

from __future__ import annotations

import pytest

from neuprim.search.design.combine import combinations, fronts
from neuprim.search.design.record import Model
from neuprim.search.design.variants import CENTRE, LENGTH


def model(knob: str, turned: str, psnr: float, size: int, ratio: float, length: float = 1.0) -> Model:
    return Model(
        knob, (), {"psnr": psnr}, size, ms=[ratio] * 9, ratios=[ratio] * 9, turned=tuple(turned.split()), length=length
    )


FOUND = [
    model(CENTRE, "", 30.0, 1000, 1.0),
    model("model.primitives", "model.primitives=50", 28.0, 500, 0.6),
    model("model.primitives", "model.primitives=25", 25.0, 250, 0.4),
    model("model.primitives", "model.primitives=200", 31.0, 2000, 1.7),
    model("model.neurons", "model.neurons=0", 29.9, 800, 0.9),
    model("model.neurons", "model.neurons=8", 30.3, 1300, 1.2),
    model("model.sh_degree", "model.sh_degree=0", 29.0, 700, 1.0),
    model(LENGTH, "", 29.0, 1000, 1.0, 0.5),
]


def names(found: list[Model], most: int) -> list[set[str]]:
    return [set(variant.turned) for variant in combinations(found, most)]


def test_down_by_what_loses_least_and_up_by_what_gains_most() -> None:
    found = names(FOUND, 12)
    assert {"model.neurons=0", "model.primitives=50"} in found and {"model.neurons=0", "model.sh_degree=0"} in found, (
        "smaller"
    )
    assert {"model.neurons=0", "model.sh_degree=0", "model.primitives=25"} in found
    assert {"model.primitives=200", "model.neurons=8"} in found, "better"
    assert all(len({word.partition("=")[0] for word in words}) == len(words) > 1 for words in found), (
        "one value per knob, several knobs"
    )
    assert len({frozenset(words) for words in found}) == len(found)


def test_as_many_as_there_is_time_for_from_every_way() -> None:
    few = names(FOUND, 3)
    assert len(few) == 3 and {"model.primitives=200", "model.neurons=8"} in few
    assert names(FOUND, 0) == [] and names(FOUND, -4) == [] and len(names(FOUND, 1)) == 1


def test_what_is_trained_already_is_not_proposed_again() -> None:
    known = model("combined", "model.primitives=200 model.neurons=8", 31.2, 2600, 2.0)
    assert set(known.turned) not in names([*FOUND, known], 12)


def test_what_gains_nothing_is_not_joined() -> None:
    worse = [FOUND[0], model("a", "a=1", 29.0, 1000, 1.0), model("b", "b=1", 29.0, 1000, 1.0)]
    assert names(worse, 12) == []


def test_the_fronts_are_those_of_all_models() -> None:
    speed, size = fronts(FOUND)
    assert [FOUND[i].quality["psnr"] for i in size] == [31.0, 30.3, 30.0, 29.9, 29.0, 28.0, 25.0]
    assert (
        [FOUND[i].turned for i in speed][:2] == [("model.primitives=200",), ("model.neurons=8",)]
        and 6 not in speed
        and 7 not in speed
    )
    untimed = [*FOUND, Model("x", (), {"psnr": 40.0}, 1)]
    assert 8 not in fronts(untimed)[0] and fronts(untimed)[1] == [8]


def test_a_model_is_read_back_as_it_was() -> None:
    made = Model(
        *("model.neurons", ("task=static", "model.neurons=0"), {"psnr": 29.9, "ssim": 0.9}, 800, 4096),
        turned=("model.neurons=0",),
        centre_ms=4.0,
        primitives=100,
        parameters_per_primitive=20,
        steps=50,
        seconds=2.0,
        steps_in_turns=(0.9, 1.1),
        seeds=(29.8, 30.0),
        run_dir="trials/neurons-0",
    )
    made.ratios, made.ms = [0.5, 0.6, 0.7], [9.0, 9.0, 9.0]
    assert made.time == pytest.approx(2.4), "of the centre's, whatever the load was"
    back = Model.from_dict(made.to_dict())
    assert (
        back == made
        and back.name == "neurons=0"
        and back.ms_per_step == 40.0
        and back.seed_spread == pytest.approx(0.1414, abs=1e-4)
    )
    assert Model.from_dict(FOUND[7].to_dict()).name == "0.5 of the length"
