"""Trainings in memory: how many primitives there are, and which views are measured."""

from __future__ import annotations

from pathlib import Path

import pytest

from neuprim.config import compose
from neuprim.core.errors import ConfigError
from neuprim.runs.fit import prepare_training, train_to_end
from tests.core import tiny
from tests.short_runs import words


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tiny.write_blender(tmp_path_factory.mktemp("data") / "two")


@pytest.mark.parametrize(("share", "first"), [(0.5, 20), (1, 40)])
def test_a_share_of_the_primitives_is_there_at_first_and_all_at_the_end(
    scene: Path, tmp_path: Path, share: float, first: int
) -> None:
    grown = [f"train.population.grow_from={share}", "train.population.every=10", "train.eval_every=0"]
    fitted = prepare_training(compose(words(scene, tmp_path / "out", 100, *grown)))
    assert fitted.model.count == first
    train_to_end(fitted)
    assert fitted.model.count == 40


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
