"""Which settings a search turns, in which order, and configurations with other settings."""

from __future__ import annotations

from pathlib import Path

import pytest

from neuprim.config import compose, task_of
from neuprim.runs.open import load_dataset
from neuprim.search.changed import changed, value_of
from neuprim.search.target.knobs import ladders, next_turn
from neuprim.search.target.record import Setting, Turn

SCENES = {
    "static": ("scene=solids", "scene.size=16", "scene.train_views=4", "scene.test_views=1"),
    "dynamic": ("scene=smoke_fire", "scene.size=16", "scene.cameras=4"),
    "relight": ("scene=lit_solids", "scene.size=16"),
}


def known(task: str, out: Path, *more: str) -> dict[str, tuple[Setting, ...]]:
    config = compose([f"task={task}", *SCENES[task], f"output_dir={out}", *more])
    spec = task_of(config)
    return ladders(config, spec, load_dataset(config, spec))


def test_of_surfaces_bands_come_before_neurons(tmp_path: Path) -> None:
    found = known("static", tmp_path / "a", "model.neurons=3")
    assert list(found.items()) == [("model.sh_degree", (0, 1, 2, 3)), ("model.neurons", (0, 1, 2, 3))]


def test_what_saves_nothing_is_not_turned(tmp_path: Path) -> None:
    assert known("static", tmp_path / "a", "model.neurons=0", "model.sh_degree=0") == {}


def test_of_light_the_networks_become_narrower(tmp_path: Path) -> None:
    assert known("relight", tmp_path / "a") == {"model.colour.hidden": (0, 4, 8)}


@pytest.mark.slow  # simulates
def test_of_volumes_parts_of_time_go(tmp_path: Path) -> None:
    assert known("dynamic", tmp_path / "a") == {"model.density.time": ("none", "phase", "window", "window+motion")}


@pytest.mark.parametrize(
    ("worth", "tried"),
    [
        ((), [1, 0]),  # everything pays
        ((1, 0), [1, 2]),  # nothing does
        ((0,), [1, 0]),
        ((1,), [1, 2]),
    ],
)
def test_a_setting_goes_down_by_half_of_its_ladder(worth: tuple[int, ...], tried: list[int]) -> None:
    """``worth``: values that are refused."""
    ladder, turns = {"model.sh_degree": (0, 1, 2, 3)}, []
    while (turn := next_turn(ladder, turns)) is not None:
        key, before, after = turn
        turns.append(Turn(key, before, after, {}, 0.5, after not in worth and after != 2))
    assert [turn.after for turn in turns] == tried


def test_values_that_are_words_have_the_order_of_their_ladder() -> None:
    ladder = {"model.density.time": ("none", "phase", "window", "window+motion")}
    first = next_turn(ladder, [])
    assert first == ("model.density.time", "window+motion", "phase")
    refused = Turn(*first, loss={}, size=0.6, adopted=False)
    second = next_turn(ladder, [refused])
    assert second == ("model.density.time", "window+motion", "window")
    assert next_turn(ladder, [refused, Turn(*second, loss={}, size=0.7, adopted=True)]) is None


def test_a_configuration_with_other_settings_says_so(tmp_path: Path) -> None:
    before = compose(["task=relight", "scene=lit_solids", f"output_dir={tmp_path / 'a'}"])
    after = changed(before, {"model.colour.hidden": 4, "model.primitives": 7, "task.options.own": 1})
    assert (value_of(after, "model.colour.hidden"), after.model.primitives, after.options["own"]) == (4, 7, 1)
    assert value_of(before, "model.colour.hidden") == 8, "the one before is as it was"
    assert after.model.colour.keys() == before.model.colour.keys()
    assert after.non_default["model.colour.hidden"] == (8, 4)
    assert changed(after, {"model.colour.hidden": 8}).non_default.keys() == after.non_default.keys() - {
        "model.colour.hidden"
    }
    assert value_of(before, "model.colour.nothing.here") is None
