"""``neuprim tasks``: every plugin with the package it comes from, and whether it works."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from neuprim.cli.command import Command
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.plugins.registry import EXPORTERS, INSPECTORS, LOSSES, SCENES, TASKS, PluginGroup, PluginReport, list_tasks

if TYPE_CHECKING:
    from neuprim.core.extensions import LossExtension, SceneExtension
    from neuprim.core.task import TaskSpec

__all__ = ["COMMAND", "list_plugins"]

_OTHERS: tuple[tuple[str, PluginGroup[Any]], ...] = (
    ("losses (train.loss=NAME)", LOSSES),
    ("exporters (neuprim export --format NAME)", EXPORTERS),
    ("inspectors (neuprim inspect --show NAME)", INSPECTORS),
)


def list_plugins() -> list[str]:
    """The lines of ``neuprim tasks``; a broken plugin is one of them, with its error, and stops no other."""
    lines: list[str] = []
    added = SCENES.survey()
    for report in TASKS.survey():
        title, note = f"{report.info.name}  ({report.info.origin})", _note(report)
        try:
            if report.spec is None:
                raise ConfigError(report.error or "cannot be loaded")
            body = _task(report.spec, added)
            lines.append(f"{title}  {report.spec.summary}{note}")
        except NeuprimError as broken:
            body = [str(broken)]
            lines.append(f"{title}  BROKEN{note}")
        lines += [*(f"  {line}" for line in body), ""]
    tasks = {info.name for info in list_tasks()}
    homeless = [r for r in added if r.info.name.partition(".")[0] not in tasks]
    if homeless:
        lines += ["scenes of tasks that are not installed", *(f"  {_line(r, r.info.name)}" for r in homeless), ""]
    for heading, group in _OTHERS:
        reports = group.survey()
        if reports:
            width = max(len(r.info.name) for r in reports)
            lines.append(heading)
            for report in reports:
                lines.append(f"  {_line(report, f'{report.info.name:{width}}')}")
                if group is LOSSES and report.spec is not None:
                    lines += [f"    {line}" for line in _options(report.spec)]
            lines.append("")
    return lines


def _line(report: PluginReport[Any], name: str) -> str:
    if report.spec is None:
        return f"{name}  BROKEN  ({report.info.origin})  {report.error}{_note(report)}"
    return f"{name}  ({report.info.origin})  {getattr(report.spec, 'summary', '')}".rstrip() + _note(report)


def _note(report: PluginReport[Any]) -> str:
    """How to choose what its name alone does not."""
    return f"  [{report.note}]" if report.note else ""


def _task(spec: TaskSpec, added: list[PluginReport[SceneExtension]]) -> list[str]:
    from neuprim.config import check_groups, presets, task_choices
    from neuprim.config.task_files import LEVELS, read_levels

    check_groups(spec)
    default = task_choices(spec)
    rows = [(s.name, f"{s.summary}{' (default)' if s.name == default.scene else ''}") for s in spec.scenes]
    rows += [_scene(spec, report) for report in added if report.info.name.startswith(f"{spec.name}.")]
    width = max(len(name) for name, _ in rows)
    found = [("scenes", f"{name:{width}}  {text}") for name, text in rows]
    found.append(("presets", ", ".join(name + " (default)" * (name == default.preset) for name in presets(spec))))
    levels = read_levels(spec, presets(spec))
    if levels is not None:
        found.append(("effort", f"{LEVELS[0]} (fast) to {LEVELS[-1]} (good), of preset {levels[LEVELS[0]].preset}"))
    if spec.conditions:
        found.append(("conditions", ", ".join(f"{c.name} [{c.unit}]" for c in spec.conditions)))
    found += [("options", line) for line in _options(spec)]
    return [
        f"{title if i == 0 or title != found[i - 1][0] else '':10}  {text}" for i, (title, text) in enumerate(found)
    ]


def _options(spec: TaskSpec | LossExtension) -> list[str]:
    """What may stand under ``task.options``, with defaults."""
    return [f"task.options.{name}={option[0]}  {option[1]}" for name, option in spec.options.items()]


def _scene(spec: TaskSpec, report: PluginReport[SceneExtension]) -> tuple[str, str]:
    """(name, summary or error) of a scene that another package adds to a task."""
    name = report.info.name.removeprefix(f"{spec.name}.")
    problem, note = report.error, _note(report)
    if any(scene.name == name for scene in spec.scenes):
        note = f"  [hidden by the task's own; {SCENES.choice(report.info)} chooses it]"
    if report.spec is not None:
        from neuprim.config import check_scene

        try:
            check_scene(spec, name, report.spec.config_package)
            return name, f"({report.info.origin})  {report.spec.scene.summary}{note}"
        except ConfigError as error:
            problem = str(error)
    return name, f"BROKEN  ({report.info.origin})  {problem}{note}"


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    pass


def _tasks(arguments: argparse.Namespace) -> int:
    print(*list_plugins(), sep="\n")
    return 0


COMMAND = Command(
    "tasks", "list tasks, scenes, presets and other plugins, and the packages they come from", _add_arguments, _tasks
)
