"""Checks of training: data, loss, determinism, files, resuming."""

from __future__ import annotations

import math
import tempfile
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from neuprim.conformance.subject import ConformanceError, Subject
from neuprim.core import checkpoint
from neuprim.core.channels import channels_of
from neuprim.core.compression import LEVELS, canonicalize
from neuprim.core.data import Dataset
from neuprim.core.data import dataset_check as data_check
from neuprim.core.errors import CheckpointError
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import render
from neuprim.core.task import Supervision
from neuprim.core.train.trainer import Trainer
from neuprim.core.used_settings import loss_settings
from neuprim.plugins.judging import TaskFault, clips_of, diagnosed, facts_of, judged, mask_of, orbit_of

__all__ = [
    "check_dataset",
    "check_determinism",
    "check_display",
    "check_folded",
    "check_judging",
    "check_learning",
    "check_loss",
    "check_resume",
    "check_save_load",
]

_STEPS = 4  # before the kill, and again after it; the population changes twice in each half

_FOLDED = 1e-4  # of a colour: what rounding may change


def check_dataset(t: Subject) -> None:
    """The task's example holds what training asks of any data set: conditions in every view, pixels that fit the
    cameras, start points."""
    data = t.dataset
    for split, views in (("train", data.train), ("test", data.test)):
        t.require(len(views) > 0, f"example: {split} split", "no views", "some")
        for i in range(len(views)):
            view, pixels = views.view(i), views.pixels(i)
            where = f"example: view {view.name}"
            expected = (view.camera.height, view.camera.width, data.channels)
            t.require(tuple(pixels.rgb.shape) == expected, f"{where}: pixels", tuple(pixels.rgb.shape), str(expected))
            for spec in t.task.conditions:
                t.require(
                    spec.name in view.conditions,
                    f"{where}: condition {spec.name!r}",
                    "none",
                    "one, as the task declares it",
                )
                shape = tuple(view.conditions[spec.name].shape)
                t.require(shape == spec.shape, f"{where}: condition {spec.name!r}", f"shape {shape}", str(spec.shape))
    try:
        data_check.check_dataset(data, t.task.conditions)
        data_check.check_points(data.initial_points(8, torch.Generator().manual_seed(1)), 8, data)
    except data_check.DatasetError as error:
        t.require(False, "example", str(error), "what a run checks before it starts")
    a, b = (data.initial_points(8, torch.Generator().manual_seed(1)) for _ in range(2))
    t.require(1 <= len(a.means) <= 8, "example: initial_points(8)", f"{len(a.means)} points", "1 to 8")
    t.require(torch.equal(a.means, b.means), "example: initial_points", "other points for the same seed", "the same")


def check_display(t: Subject) -> None:
    """The names of the channels fit the data, and the display makes sRGB of each pixel by itself: of primitives, parts
    and whole images."""
    channels = channels_of(t.task, t.dataset)
    image = t.dataset.test.pixels(0).over(t.dataset.background)
    given = image.clone()
    shown = channels.display(image)
    t.require(torch.equal(image, given), "display", "its argument changed in place", "the image as it was")
    apart = torch.cat([channels.display(row[None]) for row in image])
    off = float((shown - apart).abs().max())
    t.require(
        off < 1e-4,
        "display of an image",
        f"{off:.3g} off its rows one by one",
        "the same, as single primitives have colours too",
    )


def check_judging(t: Subject) -> None:
    """What the task measures, films and keeps of its example is what a run can write down, and its orbit has every
    condition to draw."""
    task, data = t.task, t.dataset
    try:
        clips_of(task, data)
        facts_of(task, data)
        for i in range(len(data.test)):
            truth = data.test.pixels(i).over(data.background)
            mask_of(task, data, i)
            judged(task, data, i, 0.5 * truth, truth)
        diagnosed(task, data, t.model(torch.float32))
        around = orbit_of(task, data, 3)
    except TaskFault as error:  # it says what was found and what was expected
        raise ConformanceError(f"task {task.name!r}: {t.check}: {error}") from error
    for view in around:
        for spec in task.conditions:
            t.require(
                spec.name in view.conditions,
                f"orbit: view {view.name}: condition {spec.name!r}",
                "none",
                "one, or it cannot be drawn",
            )


def check_loss(t: Subject) -> None:
    """The loss is one finite number with a gradient, least where image and truth agree, and its parts are numbers for
    the log."""
    loss = t.task.loss(loss_settings(t.task, t.settings.train, t.options))
    frame = _supervision(t.dataset, 0)
    truth = t.dataset.train.pixels(0).over(t.dataset.background)
    off = (truth + 0.2 * torch.rand(truth.shape, generator=torch.Generator().manual_seed(2))).requires_grad_()
    value, parts = loss(off, truth, frame)
    t.require(value.dim() == 0, "loss", f"shape {tuple(value.shape)}", "one number")
    t.require(math.isfinite(value.item()), "loss", value.item(), "a finite number")
    t.require(value.requires_grad, "loss", "no gradient", "one with respect to the rendered image")
    value.backward()
    fine = off.grad is not None and bool(torch.isfinite(off.grad).all()) and float(off.grad.abs().max()) > 0
    t.require(fine, "gradient of the loss", "none, zero, NaN or infinity", "a finite one")
    for name, number in parts.items():
        t.require(
            isinstance(number, float) and math.isfinite(number), f"loss part {name!r}", repr(number), "a finite float"
        )
    mask = torch.zeros(truth.shape[:2], dtype=torch.bool)
    mask[: max(1, len(mask) // 2)] = True
    masked = torch.where(mask[..., None], off.detach(), truth).requires_grad_()
    part = loss(masked, truth, replace(frame, mask=mask))[0].item()
    t.require(math.isfinite(part), "loss of a frame with a mask", part, "a finite number")
    least = loss(truth.clone().requires_grad_(), truth, frame)[0].item()
    t.require(
        least < value.item(),
        "loss of the truth itself",
        f"{least:g}",
        f"less than {value.item():g}, that of a wrong image",
    )


def _supervision(dataset: Dataset, index: int) -> Supervision:
    pixels = dataset.train.pixels(index)
    return Supervision(dataset.train.view(index), pixels.mask, pixels.alpha)


def check_determinism(t: Subject) -> None:
    """Two runs of one seed are equal bit for bit, changes of the population included: results must be repeatable."""
    a, b = (t.trainer(_STEPS) for _ in range(2))
    for trainer in (a, b):
        for _ in trainer.run():
            pass
    _equal(t, "two runs of one seed", a, b)


def check_resume(t: Subject) -> None:
    """2N steps equal N steps, a checkpoint on disk, a kill and N more, bit for bit: fields keep no state that a
    checkpoint lacks."""
    whole, first, second = (t.trainer(2 * _STEPS) for _ in range(3))
    for _ in range(2 * _STEPS):
        whole.train_step()
    for _ in range(_STEPS):
        first.train_step()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "checkpoint.safetensors"
        tensors, header = first.state()
        checkpoint.write(path, "checkpoint", tensors, {"task": t.task.name, **header})
        header, tensors = checkpoint.read(path, "checkpoint")
        second.load_state(tensors, header, str(path))
    for _ in range(_STEPS):
        second.train_step()
    _equal(t, f"{2 * _STEPS} steps against {_STEPS} + resume + {_STEPS}", whole, second)


def _equal(t: Subject, where: str, a: Trainer, b: Trainer) -> None:
    ours, theirs = a.state()[0], b.state()[0]
    t.require(
        set(ours) == set(theirs), where, f"state {sorted(set(ours) ^ set(theirs))} in one of them", "the same tensors"
    )
    for name, value in ours.items():
        same = value.shape == theirs[name].shape and torch.equal(value, theirs[name])
        t.require(same, f"{where}: {name}", "different values", "equal bits")


def check_learning(t: Subject) -> None:
    """A few dozen steps at the preset's rates lower the loss on the training views: the task's parts fit together."""
    trainer = t.trainer(5 * len(t.dataset.train), "fixed")
    before = _mean_loss(trainer)
    for _ in trainer.run():
        pass
    after = _mean_loss(trainer)
    t.require(
        after < before,
        "mean loss over the training views after five rounds",
        f"{after:.5g}",
        f"less than {before:.5g} at the start",
    )


@torch.no_grad()
def _mean_loss(trainer: Trainer) -> float:
    views, background = trainer.dataset.train, trainer.dataset.background
    for field in (trainer.model.density, trainer.model.colour):
        field.set_progress(1.0)
    total = 0.0
    for i in range(len(views)):
        view = views.view(i)
        out = render(trainer.model, view.camera, view.conditions, trainer.renderer, background)
        total += trainer.loss(out.rgb, views.pixels(i).over(background), _supervision(trainer.dataset, i))[0].item()
    return total / len(views)


def check_save_load(t: Subject) -> None:
    """A model comes back from ``model.safetensors`` with the same bits and the same picture, and foreign files are
    refused."""
    model = t.model(torch.float32)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.safetensors"
        checkpoint.save_model(path, model, t.task.name, {})
        loaded, _ = checkpoint.load_model(path, t.task)
        for name, value in model.params.items():
            t.require(torch.equal(value, loaded.params[name]), f"{name} after loading", "other values", "equal bits")
        with torch.no_grad():
            for view in t.views()[:3]:
                a, b = (_frame(t, m, view.camera, view.conditions) for m in (model, loaded))
                t.require(
                    torch.equal(a, b),
                    f"view {view.name} after loading",
                    f"a change of {float((a - b).abs().max()):.3g}",
                    "equal bits",
                )
        _refuses_foreign(t, path)


def _frame(t: Subject, model, camera, conditions) -> Tensor:  # type: ignore[no-untyped-def]
    return render(model, camera, conditions, t.settings.renderer).rgb


def _refuses_foreign(t: Subject, path: Path) -> None:
    header, tensors = checkpoint.read(path, "model")
    for kind in ("density", "colour"):
        changed = {**header, kind: {**header[kind], "settings": {**header[kind]["settings"], "no_such_setting": 1}}}
        other = path.with_name("other.safetensors")
        checkpoint.write(other, "model", tensors, {k: v for k, v in changed.items() if k not in ("format", "kind")})
        try:
            checkpoint.load_model(other, t.task)
        except CheckpointError:
            continue
        where = f"{header[kind]['class']}(no_such_setting=1), as a model file has it"
        t.require(
            False, where, "it was loaded", "CheckpointError, because the class refuses settings that it does not have"
        )


def check_folded(t: Subject) -> None:
    """What ``folded`` makes of tensors is the same field, and stays as it is, so that what is compressed again is not
    lost bit by bit."""
    model = t.model(torch.float32)
    once = canonicalize(model)
    for name, value in canonicalize(once).params.items():
        t.require(
            torch.equal(value, once.params[name]),
            f"{name} after folding twice",
            "other values than after once",
            "equal bits",
        )
    with torch.no_grad():
        for view in t.views()[:3]:
            change = float(
                (_frame(t, once, view.camera, view.conditions) - _frame(t, model, view.camera, view.conditions))
                .abs()
                .max()
            )
            t.require(
                change < _FOLDED,
                f"view {view.name} after folding",
                f"a change of {change:.3g}",
                f"less than {_FOLDED:g}",
            )
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.neuprim"
        stored = [once.params]
        for _ in range(2):
            checkpoint.save_compressed(
                path, Primitives(model.density, model.colour, stored[-1]), t.task.name, {}, LEVELS[1]
            )
            stored.append(checkpoint.load_model(path, t.task)[0].params)
    for name, value in stored[2].items():
        t.require(
            torch.equal(value, stored[1][name]),
            f"{name} compressed twice",
            "other values than after once",
            "equal bits",
        )
