"""What photographs need of a training: coarse views first, a gain per view, primitives that do not veil a camera."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neuprim.core import checkpoint
from neuprim.core.compute import device
from neuprim.core.data import Dataset, Pixels, View, ViewSet
from neuprim.core.errors import CheckpointError, ConfigError
from neuprim.core.train import training_views
from neuprim.core.train.losses import MaxScreenSize
from neuprim.core.train.trainer import Trainer
from neuprim.core.train.training_views import Exposures
from tests.core import tiny


@pytest.fixture(scope="module")
def plain() -> Dataset:
    return tiny.two_primitives()


@pytest.fixture(autouse=True)
def small_is_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    """The images here are tiny to begin with."""
    monkeypatch.setattr(training_views, "_MIN_SIDE", 4)


class Gained(ViewSet):
    """The views of another set as opaque photographs before a white wall, each with a gain of its own."""

    def __init__(self, views: ViewSet, gains: torch.Tensor) -> None:
        self.views, self.gains = views, gains

    def __len__(self) -> int:
        return len(self.views)

    def view(self, index: int) -> View:
        return self.views.view(index)

    def pixels(self, index: int) -> Pixels:
        found = self.views.pixels(index)
        return Pixels(found.over(torch.ones(3)) * self.gains[index])


def test_gains_are_found_and_their_mean_is_one(plain: Dataset) -> None:
    count = len(plain.train)
    gains = torch.exp(torch.linspace(-0.2, 0.2, count)[:, None] * torch.tensor([1.0, 0.5, -0.5]))
    data = replace(plain, train=Gained(plain.train, gains))
    with_gains, without = tiny.trainer(data, 400, exposure_rate=0.01), tiny.trainer(data, 400)
    errors = []
    for trainer in (with_gains, without):
        reports = list(trainer.run())
        errors.append(sum(r.psnr for r in reports[-count:]) / count)
    assert errors[0] > errors[1] + 1.0, errors
    assert with_gains.exposures is not None
    found = with_gains.exposures.numbers
    assert found.mean(0).abs().max() < 1e-6
    assert (found - (gains.log() - gains.log().mean(0))).abs().max() < 0.06
    assert without.exposures is None and not any(k.startswith("exposure") for k in without.state()[0])


def test_gains_are_saved_and_go_on(plain: Dataset, tmp_path: Path) -> None:
    plain = replace(plain, train=Gained(plain.train, torch.ones(len(plain.train), 3)))

    def make() -> Trainer:
        return tiny.trainer(plain, 30, exposure_rate=0.01)

    whole, first, second = make(), make(), make()
    reports = [r.loss for r in whole.run()]
    begun = [first.train_step().loss for _ in range(13)]
    tensors, header = first.state()
    checkpoint.write_tensors(tmp_path / "c.safetensors", "checkpoint", tensors, header)
    header, tensors = checkpoint.read_tensors(tmp_path / "c.safetensors", "checkpoint")
    second.load_state(tensors, header, "c.safetensors")
    assert begun + [r.loss for r in second.run()] == reports
    without = {k: v for k, v in tensors.items() if not k.startswith("exposure")}
    for trainer, damaged, message in (
        (tiny.trainer(plain, 30), tensors, r"it has exposure\.\w+, which these settings do not use"),
        (make(), {**tensors, "exposure.numbers": torch.zeros(1, 3)}, r"exposure\.numbers is .* expected finite"),
        (make(), without, r"it has no exposure\.numbers"),
    ):
        with pytest.raises(CheckpointError, match=message):
            trainer.load_state(damaged, header, "c")


def test_gains_are_for_photographs(plain: Dataset) -> None:
    with pytest.raises(
        ConfigError, match=r"train\.exposure_rate=0\.01: images of two have alpha; expected opaque photographs"
    ):
        tiny.trainer(plain, 30, exposure_rate=0.01)


def test_a_gain_moves_by_its_own_gradient_only() -> None:
    exposures = Exposures(3, 3, 0.1, torch.device("cpu"))
    image = torch.ones(4, 4, 3)
    loss = (exposures.apply(1, image) - 2.0).abs().mean()
    loss.backward()
    exposures.step({1: exposures.gradient(1)})
    assert torch.allclose(exposures.numbers[1] - exposures.numbers[0], torch.tensor(0.1), atol=1e-4)
    assert torch.equal(exposures.numbers[0], exposures.numbers[2]) and exposures.seen.tolist() == [0, 1, 0]
    before = exposures.numbers.clone()
    exposures.step({})
    assert torch.equal(exposures.numbers, before), "no view, no step"


@pytest.mark.parametrize("on_cpu", [True, False], ids=["by a tree", "by all distances, as on a GPU"])
def test_no_primitive_looks_larger_than_it_may(plain: Dataset, on_cpu: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "on_numba", lambda *tensors: on_cpu)
    limit = MaxScreenSize(plain.train, 0.25, every=5)
    eyes = torch.stack([plain.train.view(i).camera.position for i in range(len(plain.train))]).float()
    means = torch.cat([eyes[:1] + torch.tensor([0.4, 0.0, 0.0]), eyes[:1] * 50, eyes[:1]])
    log_scales = torch.tensor([[-1.0, -2.0, -3.0], [1.0, 0.5, 0.0], [0.0, 0.0, 0.0]])
    kept = log_scales.clone()
    assert limit.due(5) and not limit.due(4)
    limit.apply(means, kept, torch.tensor([False]))
    assert torch.equal(kept, log_scales), "a refused step changes nothing"
    limit.apply(means, kept)
    distance = torch.cdist(means, eyes).min(1).values
    assert kept[0].max().exp() == pytest.approx(0.25 * distance[0].item(), rel=1e-5)
    assert torch.allclose(kept[0] - kept[0].max(), log_scales[0] - log_scales[0].max()), "shapes stay"
    assert torch.equal(kept[1], log_scales[1]), "far away is large enough"
    assert bool(torch.isfinite(kept).all()), "even inside a camera"


def test_a_training_keeps_the_limit(plain: Dataset) -> None:
    trainer = tiny.trainer(plain, 40, angular_size=0.02)
    for _ in trainer.run():
        pass
    eyes = torch.stack([plain.train.view(i).camera.position for i in range(len(plain.train))]).float()
    distance = torch.cdist(trainer.model.params["means"].detach(), eyes).min(1).values
    size = trainer.model.params["log_scales"].detach().max(1).values.exp()
    assert float((size / distance).max()) <= 0.02 * math.exp(0.7), "a few steps may have passed since the last look"
