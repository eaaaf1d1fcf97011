"""Call functions of plugins: check the returned values, and name the plugin's package in one-line error messages.

A :class:`~neuprim.core.errors.NeuprimError` passes unchanged, because its text is written for users. Any other
exception from a plugin's code becomes a PluginError that says where the exception was raised. The ``__cause__`` of the
PluginError is the original exception. An error in neuprim's own code keeps its type.
"""

from __future__ import annotations

import json
import math
import traceback
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from packaging.utils import canonicalize_name
from torch import Tensor

from neuprim.core.data import Clip, Dataset, View
from neuprim.core.data.dataset_check import DatasetError, check_mask
from neuprim.core.errors import DISK, DataError, NeuprimError
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.layer_frame import LayerFrame, LayerSpec
from neuprim.core.task import Loss, Supervision, TaskSpec
from neuprim.plugins.registry import LOSSES, SCENES, TASKS, PluginError, PluginGroup, PluginInfo, split_plugin_name

Kind = TypeVar("Kind")

_VIEW_METRICS = ("name", "psnr", "ssim", "ssim_3dgs", "lpips", "lpips_3dgs", "seconds")
"""Names that neuprim itself uses for the entries of a view in ``metrics.json``; a task's metrics need other names."""
_TUNABLE = ("model.", "task.options.")


# ---------------------------------------------------------------- errors


class ReturnError(NeuprimError):
    """A plugin's function returned an invalid value. :func:`attribute_errors` adds the plugin's name to the message."""


@dataclass(frozen=True)
class PluginSource:
    """Name and module of a plugin, for error messages.

    Attributes:
        label: kind, name and package of the plugin, e.g. ``"task 'glow' of neuprim-glow 0.1"``.
        module: top-level module of the plugin's code; empty for a built-in plugin. Errors of built-in plugins keep
            their tracebacks.
    """

    label: str
    module: str

    @property
    def built_in(self) -> bool:
        """Whether the plugin is one of neuprim's own."""
        return not self.module


def find_plugin_source(group: PluginGroup[Any], word: str, entry: str | None = None) -> PluginSource:
    """Return label and module of a plugin for error messages, from package metadata, without importing the plugin.

    Args:
        group: kind of the plugin, e.g. tasks.
        word: ``NAME`` or ``PACKAGE:NAME`` of the plugin.
        entry: name of the entry point, if it differs from the plugin's name.
    """
    package, name = split_plugin_name(word)
    info = _find_plugin_info(group, package, entry or name)
    if info is None:
        return PluginSource(f"{group.kind} {name!r} of an unregistered package", "?")
    module = "" if info.built_in else info.target.partition(":")[0].partition(".")[0]
    return PluginSource(f"{group.kind} {name!r} of {info.origin}", module)


def _find_plugin_info(group: PluginGroup[Any], package: str | None, entry: str) -> PluginInfo | None:
    named = [info for info in group.list_plugins() if info.name == entry]
    found = [info for info in named if package in (None, canonicalize_name(info.distribution))]
    return min(found, key=lambda info: not info.built_in, default=None)


@contextmanager
def attribute_errors(source: PluginSource, function: str = "") -> Iterator[None]:
    """Return a context manager for a call of a plugin's ``function``, e.g. ``"build"``.

    The context manager turns a :class:`ReturnError` into a PluginError that names the plugin ``source``. It does the
    same with an exception that is not a NeuprimError, unless the plugin is built in or the disk failed. All other
    exceptions pass unchanged.
    """
    where = f"{function} of {source.label}" if function else source.label
    try:
        yield
    except ReturnError as error:
        raise PluginError(f"{where}: {error}") from error
    except NeuprimError:
        raise
    except (Exception, SystemExit) as error:
        if source.built_in or (isinstance(error, OSError) and error.errno in DISK):
            raise
        raise PluginError(f"{where}: {_describe_plugin_error(error, source)}") from error


def _describe_plugin_error(error: BaseException, source: PluginSource) -> str:
    text = ": ".join(part for part in (type(error).__name__, " ".join(str(error).split())) if part)
    places = [
        f" ({Path(frame.f_code.co_filename).name} line {line}, in {frame.f_code.co_name})"
        for frame, line in traceback.walk_tb(error.__traceback__)
        if _is_plugin_code(frame.f_globals, source)
    ]
    return text + (places[-1] if places else "")


def _is_plugin_code(variables: dict[str, Any], source: PluginSource) -> bool:
    return bool(source.module) and str(variables.get("__name__", "")).partition(".")[0] == source.module


def guard_loss(loss: Loss, source: PluginSource) -> Loss:
    """Return a loss function that calls ``loss``, checks its results, and names the plugin ``source`` in its errors."""
    if not callable(loss):
        raise PluginError(f"{source.label}: the loss is a {type(loss).__name__}; expected a function")

    def call(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, Mapping[str, float | Tensor]]:
        with attribute_errors(source, "loss"):
            value, parts = loss(rendered, truth, frame)
            check_loss_returns(value, parts, rendered)
        return value, parts

    call.recordable = getattr(loss, "recordable", False)  # type: ignore[attr-defined]

    return call


class RunPlugins:
    """Names and packages of the plugins of a run (task, scene and loss), for error messages.

    Args:
        task, scene: ``NAME`` or ``PACKAGE:NAME`` of the run's task and of its scene.
        loss: ``NAME`` or ``PACKAGE:NAME`` of ``train.loss``; None for the task's own loss.
    """

    def __init__(self, task: str, scene: str, loss: str | None = None) -> None:
        self.task = find_plugin_source(TASKS, task)
        package, name = split_plugin_name(scene)
        entry = f"{split_plugin_name(task)[1]}.{name}"
        if _find_plugin_info(SCENES, package, entry) is not None:
            self.scene = find_plugin_source(SCENES, scene, entry)
        else:  # one of the task's own
            self.scene = PluginSource(f"scene {name!r} of {self.task.label.rpartition(' of ')[2]}", self.task.module)
        self.loss = self.task if loss is None else find_plugin_source(LOSSES, loss)

    @contextmanager
    def attribute_errors(self) -> Iterator[None]:
        """Return a context manager for code that calls several plugins of the run.

        An exception from a plugin's code becomes an error that names the plugin. A :class:`ReturnError` or a
        DatasetError gets the plugin's name, too. Any other NeuprimError passes unchanged.
        """
        try:
            yield
        except DatasetError as error:
            raise DataError(f"{self.scene.label}: {error}") from error
        except ReturnError as error:
            raise PluginError(f"{self.task.label}: {error}") from error
        except NeuprimError:
            raise
        except (Exception, SystemExit) as error:
            frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
            for frame in reversed(frames):
                for source in (self.task, self.scene, self.loss):
                    if _is_plugin_code(frame.f_globals, source):
                        raise PluginError(f"{source.label}: {_describe_plugin_error(error, source)}") from error
            raise


# ---------------------------------------------------------------- what functions return


def check_returns(ok: bool, function: str, found: object, expected: str) -> None:
    """Raise ReturnError unless ``ok``. The message names the function, the value found and the value expected."""
    if not ok:
        raise ReturnError(f"{function}: found {found}; expected {expected}")


def check_fields(density: object, colour: object, dataset: Dataset) -> None:
    """Check that a task's ``build`` returned two fields, and that the colour field has the data set's channels."""
    for name, field, kind in (("density", density, DensityField), ("colour", colour, ColourField)):
        expected = f"a neuprim.core.model.fields.{kind.__name__}"
        check_returns(isinstance(field, kind), f"build: {name}", _describe_returned_type(field), expected)
    channels = getattr(colour, "channels", None)
    expected = f"{dataset.channels}, as data set {dataset.name!r} has"
    check_returns(channels == dataset.channels, "build: channels of the colour", channels, expected)


def check_loss_returns(value: Any, parts: Any, rendered: Tensor) -> None:
    """Raise ReturnError if a loss (:data:`~neuprim.core.task.Loss`) returned invalid results for an image.

    ``value`` must be a scalar tensor that depends on ``rendered``, the image; ``parts`` must map names to numbers.
    """
    number = isinstance(value, Tensor) and not value.dim()
    check_returns(number, "value", _describe_returned_type(value), "one number as a tensor")
    gradient = value.requires_grad or not rendered.requires_grad
    check_returns(gradient, "value", "no gradient", "one that depends on the rendered image")
    check_returns(isinstance(parts, dict), "parts", _describe_returned_type(parts), "a dictionary of names to numbers")
    for name, part in parts.items():
        number = isinstance(part, int | float) or (isinstance(part, Tensor) and not part.dim())
        check_returns(number, f"part {name!r}", _describe_returned_type(part), "a number")


def call_task_mask(task: TaskSpec, dataset: Dataset, index: int) -> Tensor | None:
    """Return the task's (H, W) bool mask of test view ``index``, for metrics of masked pixels; None for no mask."""
    mask = task.mask(dataset, index)
    if mask is not None:
        try:
            check_mask("test", dataset.test.view(index), mask)
        except DatasetError as error:
            raise ReturnError(str(error)) from None
    return mask


def call_task_metrics(
    task: TaskSpec, dataset: Dataset, index: int, rendered: Tensor, truth: Tensor
) -> dict[str, float]:
    """Return the metrics that a task adds for test view ``index``: name -> value, finite or +inf.

    ``rendered`` and ``truth`` are the (H, W, C) images of the model and of the data set.
    """
    function = f"metrics of test view {dataset.test.view(index).name}"
    metrics = _check_returned_keys(task.metrics(dataset, index, rendered, truth), function)
    for name, value in metrics.items():
        number = isinstance(value, int | float) and not math.isnan(value) and value != -math.inf
        check_returns(number, f"{function}: {name}", repr(value), "a number")
        check_returns(name not in _VIEW_METRICS, function, f"the name {name}, which every view has", "another name")
    return dict(metrics)


def call_task_diagnose(task: TaskSpec, dataset: Dataset, model: Primitives) -> dict[str, Any]:
    """Return the diagnostics that a task computes for a model, for ``metrics.json``: name -> JSON-ready value."""
    return _check_returned_json(task.diagnose(dataset, model), "diagnose")


def call_task_facts(task: TaskSpec, dataset: Dataset) -> dict[str, Any]:
    """Return facts about the data for the header of a model file: "up", "center", and any facts that the task adds."""
    own = {"up": [float(x) for x in dataset.up], "center": [float(x) for x in dataset.center]}
    return {**own, **_check_returned_json(task.facts(dataset), "facts")}


def call_task_clips(task: TaskSpec, dataset: Dataset) -> list[Clip]:
    """Return the films that the task defines; check that their views exist.

    A film is a sequence of views of the data set.
    """
    clips = _check_returned_list(task.clips(dataset), "clips", Clip)
    for clip in clips:
        count = len(dataset.test if clip.source is None else clip.source)
        wrong = [i for i in clip.views if not isinstance(i, int) or not 0 <= i < count]
        ok = not wrong and len(clip.views) > 0
        check_returns(ok, f"clips: {clip.name!r}", f"view {wrong[0]!r}" if wrong else "no views", f"some below {count}")
    return clips


def call_task_orbit(task: TaskSpec, dataset: Dataset, frames: int) -> list[View]:
    """Return ``frames`` views that circle the scene, with values for the task's conditions."""
    views = _check_returned_list(task.orbit(dataset, frames), "orbit", View)
    check_returns(len(views) > 0, "orbit", "no views", "some")
    return views


def call_task_tunable_settings(task: TaskSpec, settings: Mapping[str, Any]) -> dict[str, tuple[Any, ...]]:
    """Return the settings of the task that trade quality for speed or size: dotted key -> values worth training with.

    ``settings`` are the model settings of the run, as the task's ``build`` gets them.
    """
    found = task.tunable_settings(settings)
    expected = "a dictionary of setting names to values"
    check_returns(isinstance(found, Mapping), "tunable_settings", _describe_returned_type(found), expected)
    for name, values in found.items():
        known = isinstance(name, str) and name.startswith(_TUNABLE)
        expected = f"the name of a setting that begins with {' or '.join(_TUNABLE)}"
        check_returns(known, "tunable_settings", repr(name), expected)
        plain = isinstance(values, Sequence) and not isinstance(values, str)
        plain = plain and all(isinstance(value, bool | int | float | str) for value in values)
        check_returns(plain, f"tunable_settings: {name}", repr(values), "a list of numbers, texts, true or false")
    return {name: tuple(values) for name, values in found.items()}


def draw_task_layer(spec: LayerSpec, frame: LayerFrame, channels: int) -> Tensor | None:
    """Compute one layer (an image such as depth, for .exr files) of a frame; check its shape and values.

    Returns:
        Finite (H, W, C) values without gradient; None if the model lacks the layer. C is the number of channels that
        the layer names. A layer of light names none; C is then ``channels``, the number of the image's channels.
    """
    values = spec.draw(frame)
    if values is None:
        return None
    count = len(spec.channels) or channels
    shape = (frame.camera.height, frame.camera.width, count)
    if isinstance(values, Tensor) and tuple(values.shape) == shape[:2] and count == 1:
        values = values[..., None]
    ok = isinstance(values, Tensor) and tuple(values.shape) == shape and values.is_floating_point()
    check_returns(ok, f"layers: {spec.name}", _describe_returned_type(values), f"floats of shape {shape}")
    bad = int((~values.isfinite()).sum())
    check_returns(not bad, f"layers: {spec.name}", f"{bad} NaN or infinite values", "finite numbers")
    return values.detach()


def _describe_returned_type(value: object) -> str:
    return f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else f"a {type(value).__name__}"


def _check_returned_list(found: Any, function: str, kind: type[Kind]) -> list[Kind]:
    expected = f"a list of neuprim.core.data.{kind.__name__}"
    check_returns(isinstance(found, Sequence), function, _describe_returned_type(found), expected)
    for entry in found:
        check_returns(isinstance(entry, kind), function, f"{_describe_returned_type(entry)} in the list", expected)
    return list(found)


def _check_returned_keys(found: Any, function: str) -> Mapping[str, Any]:
    ok = isinstance(found, Mapping) and all(isinstance(name, str) for name in found)
    check_returns(ok, function, _describe_returned_type(found), "a dictionary with texts as keys")
    return found  # type: ignore[no-any-return]


def _check_returned_json(found: Any, function: str) -> dict[str, Any]:
    for name, value in _check_returned_keys(found, function).items():
        try:
            json.dumps(value, allow_nan=False)
        except (TypeError, ValueError) as error:
            expected = "finite numbers, texts, lists and dictionaries"
            raise ReturnError(f"{function}: {name} cannot be written as JSON ({error}); expected {expected}") from None
    return dict(found)
