"""What a training in memory says of the number of primitives that it was asked for."""

from __future__ import annotations

from pathlib import Path

import pytest

from neuprim.config import compose
from neuprim.core.errors import ConfigError
from neuprim.runs.fit import Event, Note, prepare_training, train_to_end
from tests.core import tiny
from tests.short_runs import words


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


def trained(scene: Path, tmp_path: Path, *more: str) -> tuple[int, int, list[str]]:
    """Primitives at the start, at the end, and what was noted."""
    events: list[Event] = []
    fitted = prepare_training(compose(words(scene, tmp_path / "out", 100, "train.eval_every=0", *more)), events.append)
    first = fitted.model.count
    train_to_end(fitted, events.append)
    return first, fitted.model.count, [event.text for event in events if isinstance(event, Note)]


def test_a_share_of_the_primitives_is_there_at_first_and_all_at_the_end(scene: Path, tmp_path: Path) -> None:
    assert trained(scene, tmp_path, "train.population.grow_from=0.5", "train.population.every=10") == (20, 40, [])
    assert trained(scene, tmp_path, "train.population.grow_from=1") == (40, 40, [])


def test_a_count_that_is_not_reached_is_said(scene: Path, tmp_path: Path) -> None:
    first, last, notes = trained(scene, tmp_path, "train.population.grow_from=0.2", "train.population.every=30")
    assert (first, last) == (8, 32), "two interventions, and a primitive splits once in each"
    assert notes == [
        "32 primitives of model.primitives=40: too few interventions, or places with an error, to split for the "
        "others; see train.population.every"
    ]


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (["train.population.grow_from=0"], r"train\.population\.grow_from.*0.*expected a share of model\.primitives"),
        (
            ["train.population.grow_from=0.5", "train.population.strategy=fixed"],
            r"grow_from=0\.5: fixed does not grow that way; expected train",
        ),
    ],
)
def test_shares_that_cannot_be(scene: Path, tmp_path: Path, more: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        compose(words(scene, tmp_path / "out", 100, *more))


def test_a_sequence_is_judged_by_held_out_training_views(tmp_path: Path) -> None:
    """Its films are of test cameras, whose views nobody has then."""
    scene = "task=dynamic scene=smoke_fire scene.size=16 scene.timesteps=6 scene.cameras=6 scene.resolution=16"
    asked = [*scene.split(), "model.primitives=20"]
    config = compose([*asked, "train.iterations=2", "train.max_seconds=null", f"output_dir={tmp_path / 'out'}"])
    fitted = train_to_end(prepare_training(config, hold_out=3))
    metrics = fitted.metrics()
    assert metrics["split"] == "train, held out" and "per_frame" not in metrics
    assert len(metrics["per_view"]) == len(fitted.dataset.test) == 8
    assert not {view["name"] for view in metrics["per_view"]} & {
        fitted.dataset.train.view(i).name for i in range(len(fitted.dataset.train))
    }
