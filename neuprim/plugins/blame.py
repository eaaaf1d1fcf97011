"""Crashes in a plugin's code, told in one line that names its package; the traceback goes to a file that the line names.

A :class:`~neuprim.core.errors.NeuprimError` passes as it is, and a crash in neuprim's own code keeps its traceback.
"""

from __future__ import annotations

import sys
import tempfile
import traceback
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from neuprim.core.data.check import DatasetFault
from neuprim.core.errors import DataError, NeuprimError
from neuprim.plugins.judging import TaskFault
from neuprim.plugins.mechanism import Group, PluginError, PluginInfo
from neuprim.plugins.names import normalised, split
from neuprim.plugins.registry import LOSSES, SCENES, TASKS
from neuprim.plugins.tracebacks import written

__all__ = ["Suspects", "blamed", "origin_of"]

_OURS = "neuprim"
StackFrame = tuple[str, str, int, str]
"""(module, file, line, function)"""


def origin_of(group: Group[Any], word: str, module: str = "") -> PluginInfo:
    """What package metadata says about the plugin that ``NAME`` or ``PACKAGE:NAME`` chooses; imports and warns of nothing.

    Of one that is not registered: that it comes from ``module``.
    """
    package, name = split(word)
    found = [info for info in group.listed() if info.name == name and package in (None, normalised(info.distribution))]
    nobody = PluginInfo(name, module.partition(".")[0] or "an unregistered package", "", module)
    return min(found, key=lambda info: not info.built_in, default=nobody)


class blamed:
    """Around a call of one function of a plugin, whose crash is then an error in one line; may be entered more than once.

    Args:
        origin: the plugin.
        what: e.g. ``"build of task 'glow'"``.
        folder: for the file with the traceback, usually ``RUN_DIR/logs``; a temporary file takes its place while the directory around
            it holds nothing, because a run refuses to write into one that does.

    Raises:
        PluginError: the function raised something other than a :class:`~neuprim.core.errors.NeuprimError`, or does not take the
            arguments that it gets. Functions of neuprim's own that a plugin lends (a loss, say) are not its fault.
    """

    def __init__(self, origin: PluginInfo, what: str, folder: Path | None = None) -> None:
        self.origin, self.what, self.folder = origin, what, folder

    def __enter__(self) -> blamed:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if not _a_crash(error) or self.origin.built_in:
            return
        called = _frames(trace)[1:]  # the first one is the caller's
        theirs = [frame for frame in called if _top(frame[0]) in Party(self.what, self.origin).modules]
        if called and _top(called[0][0]) == _OURS and not theirs:
            return
        raise PluginError(_line(self.what, self.origin, error, theirs, self.folder)) from error


@dataclass
class Party:
    """A plugin that has a part in a run, and the top-level modules that its code is in."""

    what: str
    origin: PluginInfo
    modules: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.modules |= {_top(self.origin.target)} - {""}


class Suspects:
    """The plugins of a run: its task, its scene and its loss.

    Args:
        task, scene: their names, or ``PACKAGE:NAME``.
        loss: the same of the loss, or None for the task's own.
    """

    def __init__(self, task: str, scene: str, loss: str | None = None) -> None:
        home = origin_of(TASKS, task)
        (_, task), (package, scene) = split(task), split(scene)
        added = [info for info in SCENES.listed() if info.name == f"{task}.{scene}" and package in (None, normalised(info.distribution))]
        self.task = Party(f"task {task!r}", home)
        self.scene = Party(f"scene {scene!r}", added[0] if added else home)
        self.loss = Party(f"the loss of task {task!r}", home) if loss is None else Party(f"loss {loss!r}", origin_of(LOSSES, loss))

    def know(self, dataset: object) -> None:
        """Code that the scene's loader put into its data set is the scene's, whichever module it is in."""
        views = (getattr(dataset, name, None) for name in ("train", "test", "extra"))
        start = getattr(getattr(dataset, "start", None), "__module__", None)
        modules = [*(type(part).__module__ for part in views), *([start] if isinstance(start, str) else [])]
        self.scene.modules |= {_top(module) for module in modules} - {_OURS, "builtins"}

    def watch(self, folder: Path | None = None) -> _Watch:
        """Around neuprim's own code that calls plugins here and there: whose code a crash is in is read off the traceback.

        A :class:`~neuprim.core.data.check.DatasetFault` becomes a DataError that names the scene's package, and a
        :class:`~neuprim.plugins.judging.TaskFault` a PluginError that names the task's.
        """
        return _Watch(self, folder)


class _Watch:
    def __init__(self, suspects: Suspects, folder: Path | None) -> None:
        self.suspects, self.folder = suspects, folder

    def __enter__(self) -> None:
        return None

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        scene = self.suspects.scene
        if isinstance(error, DatasetFault):
            raise DataError(f"{scene.what} of {scene.origin.origin}: {error}") from error
        if isinstance(error, TaskFault):
            task = self.suspects.task
            raise PluginError(f"{task.what} of {task.origin.origin}: {error}") from error
        if not _a_crash(error):
            return
        called = _frames(trace)[1:]
        for frame in reversed(called):
            for party in (self.suspects.task, scene, self.suspects.loss):  # of one package, the most general
                if not party.origin.built_in and _top(frame[0]) in party.modules:
                    theirs = [f for f in called if _top(f[0]) in party.modules]
                    raise PluginError(_line(party.what, party.origin, error, theirs, self.folder)) from error


# ---------------------------------------------------------------- reading and writing tracebacks


def _a_crash(error: BaseException | None) -> bool:
    return isinstance(error, (Exception, SystemExit)) and not isinstance(error, NeuprimError)


def _frames(trace: TracebackType | None) -> list[StackFrame]:
    """Outermost first."""
    found = []
    while trace is not None:
        code = trace.tb_frame.f_code
        found.append((str(trace.tb_frame.f_globals.get("__name__", "")), code.co_filename, trace.tb_lineno, code.co_name))
        trace = trace.tb_next
    return found


def _top(module: str) -> str:
    return module.partition(":")[0].partition(".")[0]


def _line(what: str, origin: PluginInfo, error: BaseException | None, theirs: list[StackFrame], folder: Path | None) -> str:
    text = " ".join(str(error).split())
    place = f" ({Path(theirs[-1][1]).name} line {theirs[-1][2]}, in {theirs[-1][3]})" if theirs else ""
    return f"{what} of {origin.origin}: {type(error).__name__}{': ' * bool(text)}{text}{place}; {_kept(what, origin, error, folder)}"


def _kept(what: str, origin: PluginInfo, error: BaseException | None, folder: Path | None) -> str:
    """Writes the traceback; says where."""
    python = ".".join(map(str, sys.version_info[:3]))
    content = f"{what} of {origin.origin} ({origin.target}), Python {python}\n\n{''.join(traceback.format_exception(error))}"
    begun = folder is not None and folder.parent.is_dir() and any(folder.parent.iterdir())
    path = written(
        content,
        f"{origin.distribution}-{what}",
        [*([folder.absolute()] if begun and folder is not None else []), Path(tempfile.gettempdir())],
    )
    return "its traceback could not be written anywhere" if path is None else f"traceback: {path}"
