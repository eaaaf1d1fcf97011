"""The table of population strategies: one that stands there and nowhere else is chosen, run, recorded and resumed like
the others."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from neuprim.cli import main
from neuprim.config import RunConfig, compose
from neuprim.core.errors import ConfigError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions
from neuprim.core.train import population
from neuprim.core.train.population import Population, PopulationChange, make_population
from neuprim.core.train.settings import PopulationSettings
from tests.core import tiny


class Decimate(Population):
    """Drops the last primitive every time; remembers how often it was asked."""

    asked = 0

    def observe(self, model: Primitives, tally: Contributions) -> None:
        pass

    def intervene(self, model: Primitives, extent: float) -> PopulationChange | None:
        type(self).asked += 1
        keep = torch.arange(model.count - 1)
        params = {name: value.detach()[keep].clone() for name, value in model.params.items()}
        return PopulationChange(params, keep, torch.zeros(len(keep), dtype=torch.bool), "dropped 1")


@pytest.fixture
def third(monkeypatch: pytest.MonkeyPatch) -> type[Decimate]:
    monkeypatch.setitem(population.STRATEGIES, "decimate", Decimate)
    monkeypatch.setattr(Decimate, "asked", 0)
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)
    return Decimate


def words(folder: Path, strategy: str) -> list[str]:
    scene = tiny.write_blender(folder / "two")
    return [
        "task=static", "scene=blender", f"scene.path={scene}", "model.primitives=9", "model.neurons=1",
        "model.sh_degree=0",
        "train.iterations=8", "train.max_seconds=null", "train.population.every=2", "train.population.start=0",
        "train.population.stop=1", f"train.population.strategy={strategy}", "renderer.backend=reference",
        f"output_dir={folder / 'run'}",
    ]  # fmt: skip


def test_a_strategy_of_the_table_is_all_that_a_run_needs(third: type[Decimate], tmp_path: Path) -> None:
    assert main(["run", *words(tmp_path, "decimate")]) == 0
    assert third.asked == 4 and RunConfig.from_yaml(tmp_path / "run").train.population.strategy == "decimate"
    assert json.loads((tmp_path / "run" / "metrics.json").read_text())["primitives"] == 9 - 4
    assert main(["eval", str(tmp_path / "run")]) == 0


def test_a_wrong_name_is_told_the_table(third: type[Decimate], tmp_path: Path) -> None:
    message = r"^train\.population\.strategy='grow': expected fixed, relocate, gradient or decimate$"
    with pytest.raises(ConfigError, match=message):
        compose(words(tmp_path, "grow"))
    with pytest.raises(ConfigError, match=message):
        make_population(PopulationSettings(strategy="grow"))


def test_a_file_that_asks_for_another_is_refused(
    third: type[Decimate], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "config.yaml").write_text(compose(words(tmp_path, "decimate")).to_yaml())
    assert RunConfig.from_yaml(tmp_path / "config.yaml").train.population.strategy == "decimate"
    monkeypatch.delitem(population.STRATEGIES, "decimate")
    with pytest.raises(
        ConfigError,
        match=r"config\.yaml: train\.population\.strategy='decimate': expected fixed, relocate or gradient$",
    ):
        RunConfig.from_yaml(tmp_path / "config.yaml")
