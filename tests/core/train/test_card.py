"""Training on a card: every tensor of a step is there, it computes what the processor computes, and files know nothing
of it."""

from __future__ import annotations

import json
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.config import RunConfig, compose
from neuprim.core.compute import device
from neuprim.core.data import Dataset, Pixels
from neuprim.core.errors import DataError
from neuprim.core.io.vdb import write_vdb
from neuprim.core.train.trainer import Trainer
from neuprim.runs.fit import Fitted, prepare_training
from neuprim.runs.measure import evaluate_run
from neuprim.runs.run import run
from tests.core import tiny
from tests.pretend_card import CARD, pretended
from tests.short_runs import words
from tests.tasks.dynamic.sequences import blob

LIT = "task=relight scene=lit_solids scene.size=24 scene.train_views=6 scene.test_views=2 scene.supersampling=1".split()
SMALL = ["model.primitives=80", "model.neurons=2", "train.max_seconds=null"]
NETWORK = ["model.colour.form=additive", "model.colour.hidden=3", "train.loss=l1", "train.rates.c_dc=5e-3"]
TASKS = {
    "lights": [*LIT, *SMALL],
    "network": [*LIT, *SMALL, *NETWORK],
    "shadows per pixel": [*LIT, *SMALL, *NETWORK, "model.colour.visibility=pixel"],
}


def configured(task: str, tmp_path: Path, *more: str) -> list[str]:
    # a GPU strides less, as its launches take as long as many primitives
    population = ["train.population.every=3", "train.population.start=0.0", "train.stride=2"]
    if task == "static":
        scene = tiny.write_blender(tmp_path / "two")
        return words(scene, tmp_path / "run", 8, *population, "train.rates.quats=0", *more)
    own = TASKS.get(task, [])
    if task == "time":
        folder = tmp_path / "ball"
        folder.mkdir(exist_ok=True)
        for number in range(1, 4):
            write_vdb(folder / f"ball_{number}.vdb", blob(6.0 + 3 * number))
        files = "task=dynamic scene=vdb scene.look=smoke_fire scene.size=24 scene.cameras=4 scene.samples=1"
        own = [*files.split(), f"scene.vdb='{folder}'"]
    return [*own, *SMALL, f"output_dir={tmp_path / 'run'}", "train.iterations=8", *population, *more]


def trained(words: list[str], dataset: Dataset | None, steps: int) -> tuple[Fitted, list[Any]]:
    fitted = prepare_training(compose(words), dataset=dataset)
    return fitted, [fitted.trainer.train_step() for _ in range(steps)]


@pytest.mark.parametrize("task", ["static", "lights", "network", "shadows per pixel", "time"])
def test_a_card_trains_what_the_processor_trains(task: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps with interventions in the population, and looks at voxels. Bit for bit what the twins compute on the
    processor, and but for rounding what its own kernels do: training multiplies that, as Adam's first steps are as long
    where a gradient is nothing but rounding.
    """
    config = configured(task, tmp_path, *(["train.voxels_every=2"] if task == "time" else []))
    own, told = trained(config, None, 8)
    with monkeypatch.context() as patch:
        patch.setattr(device, "on_numba", lambda *tensors: False)
        twin, twins = trained(config, own.dataset, 8)
    with pretended(monkeypatch) as card:
        other, heard = trained(config, own.dataset, 8)
        assert other.trainer.device == CARD and all(v.device == CARD for v in other.model.params.values())
        tensors, header = other.trainer.state()
        waits = card.waits.total()
    mine, theirs = own.trainer.state()[0], twin.trainer.state()[0]
    assert all(type(value) is Tensor and value.is_cpu for value in tensors.values()) and waits > 0
    assert {**header, "elapsed": 0} == {
        **own.trainer.state()[1],
        "elapsed": 0,
    } and tensors.keys() == mine.keys() == theirs.keys()
    assert not [name for name, value in tensors.items() if not torch.equal(value, theirs[name])]
    assert [replace(r, seconds=0) for r in heard] == [replace(r, seconds=0) for r in twins] and any(
        r.change for r in heard
    )
    for a, b in zip(told, heard, strict=True):
        assert (a.view, a.primitives, a.change, a.parts.keys()) == (b.view, b.primitives, b.change, b.parts.keys())
        assert b.loss == pytest.approx(a.loss, rel=2e-2) and b.psnr == pytest.approx(a.psnr, abs=0.2)
    assert heard[0].loss == pytest.approx(told[0].loss, rel=1e-5)
    assert all(torch.equal(tensors[name], mine[name]) for name in ("generator", "order", "adam.age"))


@pytest.mark.parametrize("strategy", ["relocate", "gradient"])
def test_what_begins_on_one_goes_on_on_the_other(strategy: str, monkeypatch: pytest.MonkeyPatch) -> None:
    data = tiny.two_primitives(random_background=True)

    def fresh() -> Trainer:
        population = {
            "strategy": strategy,
            "fraction": 0.2,
            "grow_threshold": 1e-4,
            "prune_threshold": 1e-9,
            "clone_scale": 0.05,
        }
        return tiny.trainer(data, 40, population=population)

    whole = fresh()
    reports = [whole.train_step() for _ in range(14)]
    first = fresh()
    for _ in range(6):
        first.train_step()
    with pretended(monkeypatch):
        second = fresh()
        second.load_state(*first.state(), "there")
        assert second.optimizer.age.device == CARD and all(v.device == CARD for v in second.optimizer.m.values())
        for _ in range(4):
            second.train_step()
        state = second.state()
        third = fresh()
        third.load_state(*state, "there again")
        assert all(torch.equal(v, state[0][k]) for k, v in third.state()[0].items())
    last = fresh()
    last.load_state(*state, "back")
    rest = [last.train_step() for _ in range(4)]
    assert (
        last.step == 14
        and torch.equal(last.order, whole.order)
        and torch.equal(last.generator.get_state(), whole.generator.get_state())
    )
    assert [r.view for r in rest] == [r.view for r in reports[10:]]
    assert rest[-1].loss == pytest.approx(reports[-1].loss, rel=0.02)


def test_a_run_on_a_card_is_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Metrics, pictures and report; measured again on either device; resumed on the other."""
    monkeypatch.setattr("neuprim.runs.evaluate._ORBIT_FRAMES", 2)
    config = configured("static", tmp_path)
    with pretended(monkeypatch):
        folder = run(compose(config))
        again = evaluate_run(folder)
    metrics = json.loads((folder / "metrics.json").read_text())
    assert (
        (metrics["backend"], metrics["device"]) == (again["backend"], again["device"]) == ("card", "a pretended card")
    )
    assert (
        metrics["psnr"] == again["psnr"]
        and (folder / "report.html").exists()
        and (folder / "renders" / "orbit.webp").exists()
    )
    here = evaluate_run(folder)
    assert here["backend"] == "cpu" and here["psnr"] == pytest.approx(metrics["psnr"], abs=1e-3)
    run(compose([*[w for w in config if "iterations" not in w], "train.iterations=12", "resume=true"]))
    resumed = json.loads((folder / "metrics.json").read_text())
    assert (
        resumed["iterations"] == 12
        and resumed["backend"] == "cpu"
        and RunConfig.from_yaml(folder).renderer.device == "auto"
    )


# ---------------------------------------------------------------- waits, and views made ready ahead


@pytest.mark.parametrize(("task", "waits", "gradients"), [("static", 2, 8), ("lights", 5, 11), ("time", 10, 8)])
def test_a_step_waits_for_the_card_as_seldom_as_it_did(
    task: str, waits: int, gradients: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the trainer, without those of the renderer. The pretended one adds some: what is watched and the image's
    gradient on the way to the processor, gradients of tensors and two sums on the way back.
    """
    more = ("train.voxels_every=1",) if task == "time" else ()
    plain_loss = () if task == "lights" else ("train.ssim_weight=0",)  # a card computes SSIM by its own kernels
    config = configured(task, tmp_path, "train.population.strategy=fixed", *more, *plain_loss)
    data = prepare_training(compose(config)).dataset
    with pretended(monkeypatch) as card:
        fitted, _ = trained(config, data, 1)
        card.waits.clear()
        fitted.trainer.train_step()
        own = card.waits - Counter({"copy to the host": 2, "copy to the card": gradients + 2})
        assert own.total() == waits and not own["copy to the card"], own


@pytest.mark.parametrize("room", [0, 2, 6])
def test_views_are_read_one_ahead_and_kept_while_there_is_room(room: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the order of the steps, and none that no step looks at: where an epoch ends the next is not drawn yet."""
    data = tiny.two_primitives()
    read: list[int] = []
    pixels, size = data.train.pixels, 4 * tiny.SIZE**2 * 4

    def reading(index: int) -> Pixels:
        read.append(index)
        return pixels(index)

    monkeypatch.setattr(data.train, "pixels", reading)
    with pretended(monkeypatch, memory=4 * room * size):
        trainer = tiny.trainer(data, 12)
        seen = [trainer.train_step().view for _ in range(12)]
    assert [f"v{i}" for i in read] == seen[:6] + [name for name in seen[6:] if name not in seen[:room]]
    assert [r.view for r in tiny.trainer(tiny.two_primitives(), 12).run()] == seen


def test_what_goes_wrong_with_a_view_is_said_at_its_step(monkeypatch: pytest.MonkeyPatch) -> None:
    data = tiny.two_primitives()
    pixels = data.train.pixels

    def broken(index: int) -> Pixels:
        if index == 3:
            raise DataError("v3: damaged")
        return pixels(index)

    monkeypatch.setattr(data.train, "pixels", broken)
    with pretended(monkeypatch):
        trainer = tiny.trainer(data, 12)
        at = trainer_order(trainer).index(3)
        for _ in range(at):
            trainer.train_step()
        with pytest.raises(DataError, match="v3: damaged"):
            trainer.train_step()


def trainer_order(trainer: Trainer) -> list[int]:
    """The views of the first epoch."""
    generator = torch.Generator()
    generator.set_state(trainer.generator.get_state())
    found: list[int] = torch.randperm(len(trainer.dataset.train), generator=generator).tolist()
    return found


# ---------------------------------------------------------------- the pretence itself


def test_the_pretended_card_refuses_what_a_card_refuses(monkeypatch: pytest.MonkeyPatch) -> None:
    with pretended(monkeypatch) as card:
        there, here = torch.ones(3, device=CARD), torch.ones(3)
        with pytest.raises(RuntimeError, match="same device"):
            there + here
        with pytest.raises(RuntimeError, match="same device"):
            torch.cat([there, here])
        with pytest.raises(RuntimeError):
            there.numpy()
        assert (there * torch.tensor(2.0)).cpu().tolist() == [2.0, 2.0, 2.0]
        there[torch.tensor([0, 2])] = 5.0
        assert there.tolist() == [5.0, 1.0, 5.0] and float(there.sum()) == 11.0 and card.waits.total() == 3
