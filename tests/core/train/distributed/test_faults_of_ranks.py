"""A rank that fails, dies or differs: the others say which, and have the state of the last whole step."""

from __future__ import annotations

from typing import Any

import pytest
import torch

from neuprim.core.data import Dataset, Pixels
from neuprim.core.errors import NeuprimError, NonFiniteError, RankError
from neuprim.core.train.distributed import group as groups
from neuprim.core.train.distributed import pulse
from neuprim.core.train.distributed.beginning import beginning
from neuprim.core.train.distributed.group import Group
from neuprim.core.train.trainer import Trainer
from tests.core import tiny
from tests.ranks import Killed, done, together


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pulse, "BEAT", 0.05)
    monkeypatch.setattr(pulse, "SILENCE", 1.0)
    monkeypatch.setattr(pulse, "LONG_SILENCE", 1.0)
    monkeypatch.setattr(groups, "LOOK", 0.02)


@pytest.fixture(scope="module")
def scene() -> Dataset:
    return tiny.two_primitives(random_background=True)


def make(scene: Dataset, group: Group | None = None, views: int = 1) -> Trainer:
    trainer = tiny.trainer(scene, 20, views_per_step=views, population={"strategy": "relocate", "fraction": 0.2})
    if group is not None:
        trainer.join(group)
    return trainer


@pytest.mark.parametrize("dead", [0, 1, 2])
def test_a_rank_that_dies_is_named_and_costs_no_step(dead: int, scene: Dataset) -> None:
    trainers: dict[int, Trainer] = {}

    def work(group: Group) -> None:
        trainer = trainers[group.rank] = make(scene, group)
        for _ in trainer.run():
            if group.rank == dead and trainer.step == 8:
                raise Killed

    found = together(3, work)
    assert isinstance(found.pop(dead), Killed)
    assert {str(error) for error in found} == {f"rank {dead} died, in step 9"}
    assert any(isinstance(error, RankError) and not error.told for error in found), "somebody has to say so"

    whole = make(scene, views=3)
    list(whole.run())
    survivor = trainers[(dead + 1) % 3]
    assert survivor.step == 8
    again = make(scene, views=3)
    again.load_state(*survivor.state(), "state")
    list(again.run())
    for name, value in whole.state()[0].items():
        assert torch.equal(value, again.state()[0][name]), name


def test_what_one_rank_finds_wrong_all_are_told(scene: Dataset) -> None:
    class Spoiled(tiny.Views):
        def pixels(self, index: int) -> Pixels:
            whole = super().pixels(index)
            return Pixels(whole.rgb * float("nan"), whole.alpha) if index == 3 else whole

    spoiled = tiny.two_primitives(views=Spoiled)

    def work(group: Group) -> None:
        for _ in make(spoiled, group).run():
            pass

    found = together(2, work)
    own = [error for error in found if not isinstance(error, RankError)]
    told = [error for error in found if isinstance(error, RankError)]
    assert len(own) == len(told) == 1 and isinstance(own[0], NeuprimError)
    assert told[0].told and str(own[0]) in str(told[0])


def test_a_gradient_of_the_sum_that_is_not_finite_is_all_ranks_error(
    scene: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    def work(group: Group) -> None:
        trainer = make(scene, group)
        look = trainer._go_back

        def spoil(*given: Any) -> float:
            cost = look(*given)
            if group.rank == 1 and trainer.step == 2:
                trainer.model.params["means"].grad[4] = float("inf")  # type: ignore[index]
            return cost

        trainer._go_back = spoil  # type: ignore[method-assign]
        for _ in trainer.run():
            pass

    found = together(2, work)
    assert all(
        isinstance(error, NonFiniteError) and "gradient of means of primitive 4" in str(error) for error in found
    ), found


def test_a_rank_that_computes_otherwise_is_found_at_the_next_step(scene: Dataset) -> None:
    def work(group: Group) -> None:
        trainer = make(scene, group)
        for _ in trainer.run():
            if group.rank == 1 and trainer.step == 3:
                trainer.model.params["means"].detach()[0, 0] += 1e-7

    for error in together(2, work):
        assert (
            isinstance(error, RankError)
            and "rank 1 does not compute as rank 0 does" in str(error)
            and "in step 4" in str(error)
        )


@pytest.mark.parametrize(
    ("change", "what"), [({"seed": 5}, "state"), ({"final_rate": 0.5}, "settings"), ({"views": 5}, "training views"), ({"steps": 1}, "steps done")]
)  # fmt: skip
def test_ranks_that_begin_differently_are_refused(change: dict[str, Any], what: str, scene: Dataset) -> None:
    def work(group: Group) -> None:
        mine = dict(change) if group.rank == 1 else {}
        dataset, steps = scene, mine.pop("steps", 0)
        if mine.pop("views", 0):
            dataset = tiny.two_primitives()
            dataset.train.cameras = dataset.train.cameras[:5]  # type: ignore[attr-defined]
        trainer = tiny.trainer(dataset, 20, **mine)
        trainer.step += steps
        group.agree("expected the same words", beginning(trainer))

    for error in together(2, work):
        assert (
            isinstance(error, RankError)
            and f"rank 1 has other {what} than rank 0" in str(error)
            and "expected the same words" in str(error)
        )


def test_ranks_go_in_turn(scene: Dataset) -> None:
    went: list[int] = []

    def work(group: Group) -> None:
        with group.in_turn():
            if group.first:
                assert not went
            went.append(group.rank)

    done(together(3, work))
    assert went[0] == 0 and sorted(went) == [0, 1, 2]


def test_who_waits_for_its_turn_learns_why_it_never_comes() -> None:
    def work(group: Group) -> None:
        with group.in_turn():
            raise NeuprimError("no such folder") if group.first else AssertionError("its turn came")

    first, second = together(2, work)
    assert type(first) is NeuprimError
    assert isinstance(second, RankError) and second.told and str(second) == "no such folder"


def test_who_waits_for_its_turn_notices_a_death() -> None:
    def work(group: Group) -> None:
        with group.in_turn():
            raise Killed if group.first else AssertionError("its turn came")

    _, second = together(2, work)
    assert isinstance(second, RankError) and str(second) == "rank 0 died"


@pytest.mark.parametrize("length", [0, 2030, 2044, 2045, 100_000])
def test_letters_of_any_length_arrive(length: int) -> None:
    def work(group: Group) -> list[dict[str, Any]]:
        return group.tell({"rank": group.rank, "text": "ä" * (length if group.rank == 1 else 3), "no": float("nan")})

    for letters in done(together(3, work)):
        assert [letter["rank"] for letter in letters] == [0, 1, 2]
        assert [len(letter["text"]) for letter in letters] == [3, length, 3]
        assert all(letter["no"] != letter["no"] for letter in letters)
