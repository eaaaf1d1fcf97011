"""Name the package of a plugin whose code fails, in one line.

A :class:`~neuprim.core.errors.NeuprimError` passes unchanged, because its text is the whole message. Any other
exception of another package's code becomes a PluginError that says where it was raised; the traceback stays its
``__cause__``. An error in neuprim's own code keeps its type.
"""

from __future__ import annotations

import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from packaging.utils import canonicalize_name
from torch import Tensor

from neuprim.core.data.dataset_check import DatasetError
from neuprim.core.errors import DISK, DataError, NeuprimError
from neuprim.core.task import Loss, Supervision
from neuprim.plugins.registry import LOSSES, SCENES, TASKS, PluginError, PluginGroup, PluginInfo, split_plugin_name
from neuprim.plugins.returns import ReturnError, check_loss_returns


@dataclass(frozen=True)
class PluginSource:
    """A plugin as messages name it.

    Attributes:
        label: e.g. ``"task 'glow' of neuprim-glow 0.1"``.
        module: top-level module that its code is in; empty for a built-in plugin, whose errors keep their tracebacks.
    """

    label: str
    module: str

    @property
    def built_in(self) -> bool:
        """Whether neuprim itself registers it."""
        return not self.module


def find_plugin_source(group: PluginGroup[Any], word: str, entry: str | None = None) -> PluginSource:
    """Find the source of the plugin that ``NAME`` or ``PACKAGE:NAME`` chooses, from package metadata alone.

    Args:
        entry: name of the entry point, if it is not the plugin's.
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
    """Name the plugin in errors of a call of its ``function``, e.g. ``"build"``."""
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
    """Return the loss of a plugin with its results checked and its errors attributed."""
    if not callable(loss):
        raise PluginError(f"{source.label}: the loss is a {type(loss).__name__}; expected a function")

    def call(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        with attribute_errors(source, "loss"):
            value, parts = loss(rendered, truth, frame)
            check_loss_returns(value, parts, rendered)
        return value, parts

    return call


class RunPlugins:
    """The plugins that take part in a run: its task, its scene and its loss.

    Args:
        task, scene: names, or ``PACKAGE:NAME``.
        loss: the same for ``train.loss``; None for the task's own loss.
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
        """Name the plugin in errors of code that calls several of them, by their tracebacks."""
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
