"""Training that is badly treated: it never leaves the finite, or it stops by name with the checkpoint before it
intact."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from neuprim.core import checkpoint
from neuprim.core.cameras import Camera
from neuprim.core.data import Dataset, Pixels, PointCloud, ViewSet
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.render import RenderSettings
from neuprim.core.train.initial_model import initial_model_to_train
from neuprim.core.train.losses import photometric
from neuprim.core.train.settings import ModelSettings, PopulationSettings, TrainSettings
from neuprim.core.train.trainer import StepReport, Trainer
from neuprim.tasks.static import SphericalHarmonics
from tests.core import tiny
from tests.short_runs import fit, words

SIZE = 64
ABUSES = ("rates times ten", "one view", "one primitive", "black images", "a camera inside")


def abused_data(abuse: str) -> Dataset:
    """The two known primitives at 64 x 64, with something wrong."""

    def start(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
        return tiny.near_the_truth(views, 1 if abuse == "one primitive" else count, generator)

    dataset = tiny.two_primitives(start=start)
    train, test = dataset.train, dataset.test
    assert isinstance(train, tiny.Views) and isinstance(test, tiny.Views)
    for views in (train, test):
        views.images = [_pixels(p, abuse) for p in views.images]
        views.cameras = [c.resized(SIZE, SIZE) for c in views.cameras]
    if abuse == "one view":
        train.cameras, train.images = train.cameras[:1], train.images[:1]
    if abuse == "a camera inside":
        train.cameras[:3] = [_inside(c) for c in train.cameras[:3]]
    return dataset


def _pixels(pixels: Pixels, abuse: str) -> Pixels:
    def larger(image: torch.Tensor) -> torch.Tensor:
        channels = image[None, None] if image.dim() == 2 else image.permute(2, 0, 1)[None]
        out = torch.nn.functional.interpolate(channels, (SIZE, SIZE), mode="bilinear")[0].clamp(0, 1)
        return out[0] if image.dim() == 2 else out.permute(1, 2, 0).contiguous()

    assert pixels.alpha is not None
    if abuse == "black images":
        return Pixels(torch.zeros(SIZE, SIZE, 3), torch.ones(SIZE, SIZE))
    return Pixels(larger(pixels.rgb), larger(pixels.alpha))


def _inside(camera: Camera) -> Camera:
    """The camera moved to the middle of the red ellipsoid, looking the same way."""
    view = camera.viewmat.clone()
    view[:3, 3] = -view[:3, :3] @ tiny.truth().geometry.means[0].double()
    return replace(camera, viewmat=view)


def abused(abuse: str, steps: int, primitives: int = 500) -> Trainer:
    dataset = abused_data(abuse)
    population = PopulationSettings(strategy="relocate", every=50, start=0.0, stop=1.0)
    rates: dict[str, float] = {}
    density, colour = CosineDensity(8), SphericalHarmonics(3, 3, 0.1)
    model = initial_model_to_train(density, colour, dataset, ModelSettings(primitives=primitives), 0)
    if abuse == "rates times ten":
        rates = {s.name: 10 * s.lr for s in model.specs}
    settings = TrainSettings(iterations=steps, rates=rates, population=population)
    return Trainer(model, dataset, photometric({"ssim_weight": settings.ssim_weight}), settings, RenderSettings(), 0)


def endure(abuse: str, steps: int) -> None:
    trainer = abused(abuse, steps)
    assert trainer.model.count == (1 if abuse == "one primitive" else 500)
    for report in trainer.run():
        assert math.isfinite(report.loss), f"loss at step {report.step}"
        assert not math.isnan(report.psnr)
    trainer.model.check_finite()
    assert trainer.step == steps
    for moments in (trainer.optimizer.m, trainer.optimizer.v):
        assert all(bool(torch.isfinite(m).all()) for m in moments.values())


@pytest.mark.parametrize("abuse", ABUSES)
def test_short_abuse(abuse: str) -> None:
    endure(abuse, 150)


def test_a_run_forced_out_of_the_finite_keeps_the_checkpoint_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene = tiny.write_blender(tmp_path / "two")

    class Forced(Trainer):
        def train_step(self) -> StepReport:
            if self.step == 6:
                inner = self.dataset.train.pixels
                self.dataset.train.pixels = lambda i: replace(inner(i), rgb=inner(i).rgb * float("inf"))  # type: ignore[method-assign]
            return super().train_step()

    monkeypatch.setattr("neuprim.runs.fit.Trainer", Forced)
    out = tmp_path / "run"
    with pytest.raises(NonFiniteError, match=r"loss is (nan|inf) at step 6 on view r_\d"):
        fit(words(scene, out, 10, "train.checkpoint_every_seconds=0"))
    header, saved = checkpoint.read_tensors(out / "checkpoint.safetensors", "checkpoint")
    assert header["step"] == 6
    assert all(bool(torch.isfinite(v).all()) for v in saved.values() if v.is_floating_point())
    monkeypatch.undo()
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)
    fit([*words(scene, out, 10), "resume=true"])
    header, _ = checkpoint.read_tensors(out / "checkpoint.safetensors", "checkpoint")
    assert header["step"] == 10
