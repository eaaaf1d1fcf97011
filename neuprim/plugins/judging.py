"""What a task makes of data and results - masks, numbers, films, facts, orbits - checked where it enters neuprim."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

from torch import Tensor

from neuprim.core.data import Clip, Dataset, View
from neuprim.core.data.dataset_check import DatasetError, check_mask
from neuprim.core.errors import NeuprimError
from neuprim.core.layers import LayerFrame, LayerSpec
from neuprim.core.model.primitives import Primitives
from neuprim.core.task import TaskSpec

__all__ = ["TaskFault", "clips_of", "diagnosed", "facts_of", "judged", "layer_of", "mask_of", "orbit_of"]

Kind = TypeVar("Kind")

_OURS = ("name", "psnr", "ssim", "ssim_3dgs", "lpips", "lpips_3dgs", "seconds")  # of a view, in metrics.json


class TaskFault(NeuprimError):
    """A task broke a promise of :class:`~neuprim.core.task.TaskSpec`; whoever knows the task's package adds its
    name."""


def mask_of(task: TaskSpec, dataset: Dataset, index: int) -> Tensor | None:
    """The part of a test view whose error counts on its own, (H, W) bool; None where the task names none.

    Raises:
        TaskFault: it is something else.
    """
    found = task.mask(dataset, index)
    if found is not None:
        try:
            check_mask("test", dataset.test.view(index), found)
        except DatasetError as error:
            raise TaskFault(str(error)) from None
    return found


def judged(task: TaskSpec, dataset: Dataset, index: int, rendered: Tensor, truth: Tensor) -> dict[str, float]:
    """The task's own numbers of a test view, by name; infinite ones are.

    Raises:
        TaskFault: it gave something else, or took a name that every view's numbers have.
    """
    found = task.judge(dataset, index, rendered, truth)
    where = f"judge of test view {dataset.test.view(index).name}"
    for name, value in _mapping(found, where).items():
        if not isinstance(value, (int, float)) or math.isnan(value) or value == -math.inf:
            raise TaskFault(f"{where}: {name} is {value!r}; expected a number")
        if name in _OURS:
            raise TaskFault(f"{where}: {name} is a name that all views' numbers have; expected another")
    return dict(found)


def diagnosed(task: TaskSpec, dataset: Dataset, model: Primitives) -> dict[str, Any]:
    """The task's own numbers of a model.

    Raises:
        TaskFault: they cannot be written as JSON.
    """
    return _json(task.diagnose(dataset, model), "diagnose")


def facts_of(task: TaskSpec, dataset: Dataset) -> dict[str, Any]:
    """What a model's header keeps of its data: the scene's "up" and "center", and what the task adds.

    Raises:
        TaskFault: what it adds cannot be written as JSON.
    """
    own = {"up": [float(x) for x in dataset.up], "center": [float(x) for x in dataset.center]}
    return {**own, **_json(task.facts(dataset), "facts")}


def clips_of(task: TaskSpec, dataset: Dataset) -> list[Clip]:
    """The films that the task makes.

    Raises:
        TaskFault: one is no :class:`~neuprim.core.data.dataset.Clip`, or has a view that is not there.
    """
    found = _listed(task.clips(dataset), "clips", Clip)
    for clip in found:
        count = len(dataset.test if clip.source is None else clip.source)
        beyond = [i for i in clip.views if not isinstance(i, int) or not 0 <= i < count]
        if beyond or len(clip.views) == 0:
            what = f"view {beyond[0]!r}" if beyond else "no views"
            raise TaskFault(f"clips: {clip.name!r} has {what}; expected indices below {count}")
    return found


def orbit_of(task: TaskSpec, dataset: Dataset, frames: int) -> list[View]:
    """Views circling the scene, with the task's conditions.

    Raises:
        TaskFault: one is no :class:`~neuprim.core.data.dataset.View`, or there are none.
    """
    found = _listed(task.orbit(dataset, frames), "orbit", View)
    if not found:
        raise TaskFault("orbit: found no views; expected some")
    return found


def layer_of(spec: LayerSpec, frame: LayerFrame, channels: int) -> Tensor | None:
    """(H, W, C) values of a layer, those of light with the image's ``channels``; None where the model has no such
    layer.

    Raises:
        TaskFault: it is something else, or not finite.
    """
    found = spec.draw(frame)
    if found is None:
        return None
    count = len(spec.channels) or channels
    expected = (frame.camera.height, frame.camera.width, count)
    if isinstance(found, Tensor) and tuple(found.shape) == expected[:2] and count == 1:
        found = found[..., None]
    if not isinstance(found, Tensor) or tuple(found.shape) != expected or not found.is_floating_point():
        what = (
            f"{found.dtype} of shape {tuple(found.shape)}" if isinstance(found, Tensor) else f"a {type(found).__name__}"
        )
        raise TaskFault(f"layers: {spec.name} is {what}; expected floats of shape {expected}")
    if not bool(found.isfinite().all()):
        raise TaskFault(
            f"layers: {spec.name} has {int((~found.isfinite()).sum())} NaN or infinite values; expected finite numbers"
        )
    return found.detach()


def _listed(found: Any, where: str, kind: type[Kind]) -> list[Kind]:
    if not isinstance(found, Sequence):
        raise TaskFault(
            f"{where}: found a {type(found).__name__}; expected a list of neuprim.core.data.{kind.__name__}"
        )
    for entry in found:
        if not isinstance(entry, kind):
            raise TaskFault(
                f"{where}: found a {type(entry).__name__} in the list; expected a neuprim.core.data.{kind.__name__}"
            )
    return list(found)


def _mapping(found: Any, where: str) -> Mapping[str, Any]:
    if not isinstance(found, Mapping) or not all(isinstance(name, str) for name in found):
        raise TaskFault(f"{where}: found a {type(found).__name__}; expected a dictionary with texts as keys")
    return found


def _json(found: Any, where: str) -> dict[str, Any]:
    for name, value in _mapping(found, where).items():
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError) as error:
            raise TaskFault(
                f"{where}: {name} cannot be written as JSON ({error}); expected finite numbers, texts, lists and dictionaries"
            ) from None
    return dict(found)
