"""Recorded training steps, run here on Warp's CPU blocks without a graph: the bits of steps that are not recorded."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.config import compose
from neuprim.core.compute import device
from neuprim.core.data import View
from neuprim.core.errors import NonFiniteError
from neuprim.core.io.vdb import write_vdb
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.render import RenderSettings
from neuprim.core.render.cuda.binning import FrameCapacity
from neuprim.core.train import recorded_steps
from neuprim.core.train.initial_model import initial_model_to_train
from neuprim.core.train.losses import photometric
from neuprim.core.train.recorded_steps import StepRecorder
from neuprim.core.train.settings import ModelSettings, PopulationSettings, TrainSettings
from neuprim.core.train.step_results import StepReport
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import prepare_training
from neuprim.tasks.static import SphericalHarmonics
from tests.core import tiny
from tests.core.render.cuda.waits import counted
from tests.tasks.dynamic.sequences import blob

pytestmark = pytest.mark.filterwarnings("ignore:renderer.backend=cuda is slow on the cpu")
STEPS = 24


@pytest.fixture(autouse=True)
def kernels_of_a_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    """Losses, colours and Adam by the Warp kernels, in steps that are not recorded too."""
    monkeypatch.setattr(device, "on_numba", lambda *tensors: False)
    monkeypatch.setattr(device, "on_warp", lambda *tensors: True)


def trainer(recorded: bool, near: float = 0.05, **settings: Any) -> Trainer:
    data = tiny.two_primitives(random_background=True)
    population = PopulationSettings(every=9, start=0.0, stop=1.0, fraction=0.2)
    train = TrainSettings(iterations=STEPS, population=population, **settings)
    density = CosineDensity(4, edge=2)  # chords that the near plane cuts are integrated in float64
    model = initial_model_to_train(density, SphericalHarmonics(1, 3, 0.25), data, ModelSettings(primitives=12), 0)
    renderer = RenderSettings(backend="cuda", device="cpu", near=near)
    made = Trainer(model, data, photometric({"ssim_weight": 0.2}), train, renderer, 0)
    assert made.recorder is None, "without a GPU"
    made.recorder = StepRecorder(made) if recorded else None
    return made


def state(made: Trainer) -> dict[str, Tensor]:
    return {name: value.clone() for name, value in made.state()[0].items()}


def reports(made: Trainer) -> list[StepReport]:
    return [replace(report, seconds=0.0) for report in list(made.run())]


def assert_same(one: Trainer, other: Trainer) -> None:
    mine, theirs = state(one), state(other)
    assert mine.keys() == theirs.keys()
    assert not [name for name, value in mine.items() if not torch.equal(value, theirs[name])]


@pytest.mark.parametrize("near", [0.05, 2.0], ids=["in front", "cut by the near plane, in float64"])
def test_recorded_steps_are_the_steps_bit_for_bit(near: float) -> None:
    """With interventions of the population and a band of harmonics that becomes active."""
    plain, fast = (trainer(recorded, near, anisotropy_weight=0.1, anisotropy_from=11) for recorded in (False, True))
    expected, found = reports(plain), reports(fast)
    assert fast.recorder is not None and fast.recorder.replayed >= STEPS // 2
    assert expected == found and any(report.change for report in found)
    assert_same(plain, fast)
    capacity = fast.recorder.capacity
    assert capacity is not None and (capacity.float64_pairs > 256) == (near > 1)


def test_a_recorded_step_never_waits(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing between two interventions of the population makes a Python number, or a shape, of a tensor."""
    made = trainer(True)
    assert made.recorder is not None
    waits: list[str] = []
    take = made.recorder._take_step

    def counting(*inputs: Any) -> Any:
        with counted(monkeypatch) as found:
            result = take(*inputs)
        waits.extend(found)
        return result

    monkeypatch.setattr(made.recorder, "_take_step", counting)
    replayed = [made.train_step() for _ in range(9)]
    assert made.recorder.replayed >= 6 and waits == [] and replayed[-1].psnr > 0


@pytest.mark.parametrize("views", [2, 3])
def test_a_step_may_have_several_views(views: int) -> None:
    plain, fast = (trainer(recorded, views_per_step=views) for recorded in (False, True))
    expected, found = reports(plain), reports(fast)
    assert fast.recorder is not None and fast.recorder.replayed >= STEPS // 2
    assert expected == found and found[-1].view.endswith(f"and {views - 1} more")
    assert_same(plain, fast)


@pytest.mark.parametrize("lights", [1, 3])
def test_steps_of_volumes_are_recorded_between_looks_at_voxels(lights: int, tmp_path: Path) -> None:
    """With windows in time, extinction limited to that of the files, and a time of each view."""
    folder = tmp_path / "ball"
    folder.mkdir()
    for number in range(1, 4):
        write_vdb(folder / f"ball_{number}.vdb", blob(6.0 + 3 * number))
    words = "task=dynamic scene=vdb scene.look=smoke_fire scene.size=24 scene.cameras=4 scene.samples=1".split()
    words += [f"scene.vdb='{folder}'", "model.primitives=80", "train.voxels_every=4", "train.iterations=20"]
    words += ["renderer.backend=cuda", "renderer.device=cpu", "train.population.every=9", "train.population.start=0.0"]
    words += [f"scene.lights={lights}"]
    plain = prepare_training(compose([*words, f"output_dir={tmp_path / 'run'}"]))
    fast = prepare_training(plain.config, dataset=plain.dataset).trainer
    fast.recorder = StepRecorder(fast)
    expected, found = reports(plain.trainer), reports(fast)
    assert fast.dataset.largest is not None and (lights > 1 or fast.recorder.replayed >= 8)
    assert found == expected and any("voxel_sigma" in report.parts for report in found)
    assert any("voxel_scattered" in report.parts for report in found) == (lights > 1)
    assert_same(plain.trainer, fast)


@pytest.mark.parametrize("idle", [0, 128])
def test_recordings_in_use_stay_when_there_are_more_kinds_of_images(monkeypatch: pytest.MonkeyPatch, idle: int) -> None:
    """Steps of the other kinds are taken without a recording, instead of one that replaces another in every step."""
    monkeypatch.setattr(recorded_steps, "_MOST_PROGRAMS", 1)
    monkeypatch.setattr(recorded_steps, "_IDLE_STEPS", idle)
    plain, fast = trainer(False), trainer(True)
    assert fast.recorder is not None
    for views in (plain.dataset.train, fast.dataset.train):

        def view(index: int, of: Any = views.view) -> View:
            found = of(index)
            return replace(found, camera=replace(found.camera, fx=found.camera.fx * (1 + 0.1 * (index % 2))))

        monkeypatch.setattr(views, "view", view)
    calls: list[str] = []
    for name in ("reset", "_make_program"):
        function = getattr(fast.recorder, name)

        def call(*inputs: Any, name: str = name, function: Any = function) -> Any:
            calls.append(name)
            return function(*inputs)

        monkeypatch.setattr(fast.recorder, name, call)
    assert reports(plain) == reports(fast)
    assert_same(plain, fast)
    made = calls.count("_make_program")
    assert made > 0 and (made <= calls.count("reset")) == (idle > 0) and fast.recorder.replayed > 0


@pytest.mark.parametrize("small", range(4), ids=["pairs", "in_float64", "slots", "float64_pairs"])
def test_a_step_that_does_not_fit_is_taken_again(small: int) -> None:
    """With larger arrays; the steps after it, which changed nothing, are taken again too."""
    plain, fast = trainer(False, 2.0), trainer(True, 2.0)
    assert fast.recorder is not None
    expected, found = reports(plain), []
    for _ in range(STEPS):
        found.append(fast.train_step())
        if fast.step == 4:
            fast.settle()
            held = fast.recorder.capacity
            assert held is not None
            sizes = [held.pairs, held.in_float64, held.slots, held.float64_pairs]
            sizes[small] = 1
            fast.recorder.capacity = FrameCapacity(*sizes, held.refused)
    assert fast.recorder.repeated > 0 and [replace(report, seconds=0.0) for report in found] == expected
    assert_same(plain, fast)


@pytest.mark.parametrize("name", ["means", "log_scales", "w2"])
def test_numbers_that_are_not_finite_are_refused_with_their_step(name: str) -> None:
    made = trainer(True)
    for _ in range(6):
        made.train_step()
    assert made.recorder is not None and made.recorder.replayed > 0
    before = state(made)
    made.model.params[name].detach()[3] = torch.nan
    with pytest.raises(NonFiniteError, match=f"{name} of primitive 3 is not finite"):
        for _ in range(3):
            made.train_step()
        made.settle()
    after = {key: value for key, value in state(made).items() if key.startswith("params")}
    after[f"params.{name}"][3] = before[f"params.{name}"][3]
    assert all(torch.equal(value, before[key]) for key, value in after.items()), "nothing else changed"


def test_a_loss_or_field_of_others_is_not_recorded() -> None:
    from neuprim.core.train.recorded_steps import recording_fault

    made = trainer(False)
    made.device = torch.device("cuda")
    assert recording_fault(made) == "the renderer is not the cuda backend" or recording_fault(made) is None
    made.current_model.density.stage = None
    assert recording_fault(made) is not None


def test_a_report_waits_when_it_is_read() -> None:
    made = trainer(True)
    found = [made.train_step() for _ in range(6)]
    assert "loss" not in vars(found[-1]) and found[-1].psnr > 0 and "loss" in vars(found[-2])
    with pytest.raises(AttributeError):
        found[-1].unknown  # noqa: B018
