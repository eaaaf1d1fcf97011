"""Paces: what is measured in turns, and what tells two models apart."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

import neuprim.search.design.pace as pace
from neuprim.config import RunConfig, compose
from neuprim.core.data import Dataset
from neuprim.core.train.trainer import Trainer
from neuprim.runs.open import load_dataset
from neuprim.search.design.pace import Paces
from neuprim.tasks.static import TASK
from tests.core import tiny
from tests.short_runs import words

COST = {40: 0.10, 20: 0.04}
"""Primitives -> seconds of a turn."""


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


@pytest.fixture
def turns(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[int]]:
    """Primitives of every turn taken, each of which takes as long as it should; every fifth is disturbed."""
    taken: list[int] = []

    def turn(trainer: Trainer) -> float:
        assert 0.4 < trainer.progress < 0.6, "in the middle of the schedule"
        taken.append(trainer.model.count)
        return COST[trainer.model.count] * (9.0 if len(taken) % 5 == 0 else 1.0)

    monkeypatch.setattr(pace, "_turn", turn)
    yield taken


def config(scene: Path, *more: str) -> RunConfig:
    return compose(words(scene, scene / "never", 40, *more), check_output=False)


def loaded(scene: Path) -> Dataset:
    return load_dataset(config(scene), TASK)


def test_models_take_turns_with_the_centre(scene: Path, turns: list[int]) -> None:
    paces = Paces(config(scene), loaded(scene))
    turns.clear()
    found = paces.of(config(scene, "model.primitives=20"))
    assert turns[0] == 20 and turns[1:] == [40, 20] * (len(turns) // 2), "once to warm up, then beside each other"
    assert found.ratios[0] == pytest.approx(0.4) and len(found.ratios) == len(turns) // 2 >= 4
    assert found.ratio == pytest.approx(sum(_disturbed(turns, 20)) / sum(_disturbed(turns, 40)))
    assert paces.seconds == pytest.approx(0.10 / 4), "a moment's noise does not count"


def _disturbed(turns: list[int], count: int) -> list[float]:
    """Without the turn that warms up."""
    return [COST[c] * (9.0 if (i + 1) % 5 == 0 else 1.0) for i, c in enumerate(turns) if c == count and i > 0]


def test_a_model_is_known_by_what_it_is_and_not_by_its_words(scene: Path, turns: list[int]) -> None:
    paces = Paces(config(scene), loaded(scene))
    same = paces.of(config(scene, "model.density.omega0=30.0"))
    assert same.like == paces.centre.like != paces.of(config(scene, "model.primitives=20")).like
    assert paces.of(config(scene, "model.sh_degree=1")).like != paces.centre.like and paces.compiling > 0
