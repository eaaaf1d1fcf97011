"""The forecast of a run: before the data are loaded, close to what the steps take, and without effect on the result."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.config import compose
from neuprim.core.train.trainer import Trainer
from neuprim.runs import fit, training
from neuprim.runs.fit import Note, Preparing
from neuprim.runs.forecast import Forecast, forecast_training, has_forecast
from neuprim.runs.kernel_compiler import KernelCompiler
from neuprim.runs.training import train_in_directory

SOLIDS = ["task=static", "scene=solids", "scene.size=24", "scene.train_views=3", "scene.test_views=2"]
SMALL = [*SOLIDS, "model.primitives=40", "train.iterations=500", "train.eval_every=0"]


def test_which_runs_have_one() -> None:
    assert has_forecast(compose(SMALL))
    for word in ("train.iterations=499", "model.primitives=auto", "resume=true"):
        assert not has_forecast(compose([*SMALL, word, "train.max_seconds=60"])), word


def test_what_it_says() -> None:
    found, config = Forecast(150.0, 0.1), compose(SMALL)
    assert found.describe(config) == "forecast: images are loaded or rendered, then about 2 min of training (500 steps)"
    expected = "forecast: about 2 min of training (500 steps), then about 20 s of measuring 200 held-out views"
    assert found.describe(config, 200) == expected
    seconds = compose([*SMALL, "train.iterations=null", "train.max_seconds=40"])
    assert (
        Forecast(40.0, 0.1).describe(seconds) == "forecast: images are loaded or rendered, then about 40 s of training"
    )


@pytest.mark.parametrize("limits", [["train.max_seconds=0.001"], ["train.iterations=null", "train.max_seconds=33"]])
def test_a_budget_in_seconds_is_kept(limits: list[str]) -> None:
    config = compose([*SMALL, *limits])
    found = forecast_training(config, 24, 24)
    assert found is not None and found.training == config.train.max_seconds


@pytest.mark.parametrize(
    "words", [SMALL, [*SMALL, "train.exposure_rate=1e-3"],
              ["task=dynamic", "scene=smoke_fire", "model.primitives=50", "scene.lights=4"],
              ["task=relight", "scene=lit_solids", "model.primitives=50"]],
)  # fmt: skip
def test_the_trial_has_the_settings_of_the_middle(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    taken: list[tuple[int, int]] = []
    step = Trainer.train_step

    def recorded(self: Trainer) -> Any:
        taken.append((self.step, self.model.count))
        return step(self)

    monkeypatch.setattr(Trainer, "train_step", recorded)
    config = compose(words)
    state = torch.random.get_rng_state()
    found = forecast_training(config, 24, 16)
    assert torch.equal(torch.random.get_rng_state(), state)
    assert taken[0][0] == (config.train.iterations or 0) // 2 and taken[0][1] == config.model.count
    assert 4 <= len(taken) <= 43 and found is not None and found.view > 0 and found.training > 0


def test_settings_that_noise_does_not_suit_have_none() -> None:
    assert forecast_training(compose([*SMALL, "model.init.points=nothing.ply"]), 24, 24) is None


@pytest.mark.parametrize("ready", [True, False])
def test_it_comes_before_the_data_and_changes_nothing(
    ready: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the kernels are not compiled yet, it comes after the data."""
    monkeypatch.setattr(KernelCompiler, "ready", ready)
    heard: list[Any] = []
    load = fit.load_dataset
    monkeypatch.setattr(fit, "load_dataset", lambda *given: heard.append(Note("data")) or load(*given))
    config = compose([*SMALL, f"output_dir={tmp_path / 'run'}"])
    fitted, _ = train_in_directory(config, heard.append)
    texts = [event.text for event in heard if isinstance(event, Note | Preparing)]
    forecasts = [i for i, text in enumerate(texts) if text.startswith("forecast: ")]
    assert len(forecasts) == 1 + ready and "measuring 2 held-out views" in texts[forecasts[-1]]
    assert (forecasts[0] < texts.index("data")) == ready
    monkeypatch.setattr(training, "has_forecast", lambda config: False)
    other, _ = train_in_directory(compose([*SMALL, f"output_dir={tmp_path / 'plain'}"]))
    assert all(torch.equal(other.model.params[name], value) for name, value in fitted.model.params.items())
