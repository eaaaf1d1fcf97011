"""Crashes in a plugin's code, told in one line that names its package; the traceback goes to a file that the line
names.

A :class:`~neuprim.core.errors.NeuprimError` passes as it is, and a crash in neuprim's own code keeps its traceback.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from neuprim.core.data.dataset_check import DatasetError
from neuprim.core.errors import DISK, DataError, NeuprimError
from neuprim.plugins import crashes
from neuprim.plugins.judging import TaskFault
from neuprim.plugins.mechanism import Group, PluginError, PluginInfo
from neuprim.plugins.names import normalised, split
from neuprim.plugins.registry import LOSSES, SCENES, TASKS

__all__ = ["Suspects", "blamed", "origin_of", "reported"]

_OURS = "neuprim"
StackFrame = tuple[str, str, int, str]
"""(module, file, line, function)"""


def origin_of(group: Group[Any], word: str, module: str = "") -> PluginInfo:
    """What package metadata says about the plugin that ``NAME`` or ``PACKAGE:NAME`` chooses; imports and warns of
    nothing.

    Of one that is not registered: that it comes from ``module``.
    """
    package, name = split(word)
    found = [info for info in group.listed() if info.name == name and package in (None, normalised(info.distribution))]
    nobody = PluginInfo(name, module.partition(".")[0] or "an unregistered package", "", module)
    return min(found, key=lambda info: not info.built_in, default=nobody)


@dataclass
class Party:
    """A plugin that has a part in a run, and the top-level modules that its code is in."""

    what: str
    origin: PluginInfo
    modules: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.modules |= {_top(self.origin.target)} - {""}
        self.file = f"{self.origin.distribution}-{self.what}"  # what its tracebacks' names begin with

    @property
    def who(self) -> str:
        """For example ``"task 'glow' of neuprim-glow 0.1"``."""
        return f"{self.what} of {self.origin.origin}"

    def among(self, called: Sequence[StackFrame]) -> list[StackFrame]:
        """The frames that are in its code."""
        return [frame for frame in called if _top(frame[0]) in self.modules]


class _Guard:
    """Around calls of plugins, whose crashes are then told in a line; may be entered more than once."""

    folders: Sequence[Path] = ()
    line = "{who}: {error}{place}; traceback: {path}"
    lost: str | None = (
        "{who}: {error}{place}; its traceback could not be written anywhere"  # None: then the crash is not hidden
    )

    def accused(self, error: BaseException, called: Sequence[StackFrame]) -> Party | None:
        """The plugin whose fault it is, if it is one's; ``called`` is what the guarded lines called, outermost
        first."""
        raise NotImplementedError

    def __enter__(self) -> Any:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not isinstance(error, (Exception, SystemExit)) or isinstance(error, NeuprimError):
            return
        called = _frames(trace)[1:]  # the first one is the caller's
        party = self.accused(error, called)
        if party is None or party.origin.built_in:
            return
        path = crashes.written(error, f"{party.who} ({party.origin.target})", party.file, self.folders)
        line = self.line if path is not None else self.lost
        if line is not None:
            said = ": ".join(part for part in (type(error).__name__, " ".join(str(error).split())) if part)
            place = "".join(
                f" ({Path(file).name} line {number}, in {name})" for _, file, number, name in party.among(called)[-1:]
            )
            raise PluginError(line.format(who=party.who, error=said, place=place, path=path)) from error


class blamed(_Guard):
    """Around a call of one function of a plugin.

    Args:
        origin: the plugin.
        what: e.g. ``"build of task 'glow'"``.
        folder: for the file with the traceback, usually ``RUN_DIR/logs``.

    Raises:
        PluginError: the function raised something other than a :class:`~neuprim.core.errors.NeuprimError`, or does not
        take the
            arguments that it gets. Functions of neuprim's own that a plugin lends (a loss, say) are not its fault.
    """

    def __init__(self, origin: PluginInfo, what: str, folder: Path | None = None) -> None:
        self.party, self.folders = Party(what, origin), _absolute(folder)

    def accused(self, error: BaseException, called: Sequence[StackFrame]) -> Party | None:
        lent = called and _top(called[0][0]) == _OURS and not self.party.among(called)
        return None if lent else self.party


class reported(blamed):
    """Around the work of an exporter or inspector; raises as :class:`blamed`, but refusals of a disk pass.

    Args:
        folders: for the file with the traceback; where none of them nor the temporary files' takes it, the traceback is
        not hidden.
    """

    line, lost = "{who} crashed: {error}; traceback in {path}", None

    def __init__(self, group: Group[Any], name: str, folders: Sequence[Path]) -> None:
        origin = origin_of(group, name)
        super().__init__(origin, f"{group.kind} {origin.name!r}")
        self.folders, self.party.file = folders, f"{group.kind}-{origin.name}"

    def accused(self, error: BaseException, called: Sequence[StackFrame]) -> Party | None:
        return None if isinstance(error, OSError) and error.errno in DISK else super().accused(error, called)


class Suspects:
    """The plugins of a run: its task, its scene and its loss.

    Args:
        task, scene: their names, or ``PACKAGE:NAME``.
        loss: the same of the loss, or None for the task's own.
    """

    def __init__(self, task: str, scene: str, loss: str | None = None) -> None:
        home = origin_of(TASKS, task)
        (_, task), (package, scene) = split(task), split(scene)
        added = [
            info
            for info in SCENES.listed()
            if info.name == f"{task}.{scene}" and package in (None, normalised(info.distribution))
        ]
        self.task = Party(f"task {task!r}", home)
        self.scene = Party(f"scene {scene!r}", added[0] if added else home)
        self.loss = (
            Party(f"the loss of task {task!r}", home)
            if loss is None
            else Party(f"loss {loss!r}", origin_of(LOSSES, loss))
        )

    def know(self, dataset: object) -> None:
        """Code that the scene's loader put into its data set is the scene's, whichever module it is in."""
        views = (getattr(dataset, name, None) for name in ("train", "test", "extra"))
        start = getattr(getattr(dataset, "start", None), "__module__", None)
        modules = [*(type(part).__module__ for part in views), *([start] if isinstance(start, str) else [])]
        self.scene.modules |= {_top(module) for module in modules} - {_OURS, "builtins"}

    def watch(self, folder: Path | None = None) -> _Watch:
        """Around neuprim's own code that calls plugins here and there: whose code a crash is in is read off the
        traceback.

        A :class:`~neuprim.core.data.dataset_check.DatasetError` becomes a DataError that names the scene's package, and a
        :class:`~neuprim.plugins.judging.TaskFault` a PluginError that names the task's.
        """
        return _Watch(self, folder)


class _Watch(_Guard):
    def __init__(self, suspects: Suspects, folder: Path | None) -> None:
        self.suspects, self.folders = suspects, _absolute(folder)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if isinstance(error, DatasetError):
            raise DataError(f"{self.suspects.scene.who}: {error}") from error
        if isinstance(error, TaskFault):
            raise PluginError(f"{self.suspects.task.who}: {error}") from error
        super().__exit__(kind, error, trace)

    def accused(self, error: BaseException, called: Sequence[StackFrame]) -> Party | None:
        parties = (self.suspects.task, self.suspects.scene, self.suspects.loss)  # of one package, the most general
        return next(
            (p for frame in reversed(called) for p in parties if not p.origin.built_in and p.among([frame])), None
        )


def _absolute(folder: Path | None) -> list[Path]:
    return [] if folder is None else [folder.absolute()]


def _frames(trace: TracebackType | None) -> list[StackFrame]:
    """Outermost first."""
    found = []
    while trace is not None:
        code = trace.tb_frame.f_code
        found.append(
            (str(trace.tb_frame.f_globals.get("__name__", "")), code.co_filename, trace.tb_lineno, code.co_name)
        )
        trace = trace.tb_next
    return found


def _top(module: str) -> str:
    return module.partition(":")[0].partition(".")[0]
