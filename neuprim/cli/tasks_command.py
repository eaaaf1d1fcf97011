"""``neuprim tasks``: every plugin with the package it comes from, and whether it works; ``neuprim new-task``."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.cli.command import Command
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.plugins.registry import EXPORTERS, INSPECTORS, LOSSES, SCENES, TASKS, PluginGroup, PluginReport

if TYPE_CHECKING:
    from neuprim.core.extensions import LossExtension, SceneExtension
    from neuprim.core.task import TaskSpec

_OTHERS: tuple[tuple[str, PluginGroup[Any]], ...] = (
    ("losses (train.loss=NAME)", LOSSES),
    ("exporters (neuprim export --format NAME)", EXPORTERS),
    ("inspectors (neuprim inspect --show NAME)", INSPECTORS),
)


def list_plugins() -> list[str]:
    """Return the lines of ``neuprim tasks``; a broken plugin is one of them, with its error, and stops no other."""
    lines: list[str] = []
    scenes = SCENES.survey()
    for report in TASKS.survey():
        try:
            if report.spec is None:
                raise ConfigError(report.error or "cannot be loaded")
            summary, body = report.spec.summary, _describe_task(report.spec, scenes)
        except NeuprimError as broken:
            summary, body = "BROKEN", [str(broken)]
        title = f"{report.info.name}  ({report.info.origin})  {summary}{_note(report)}"
        lines += [title, *(f"  {line}" for line in body), ""]
    tasks = {info.name for info in TASKS.list_plugins()}
    homeless = [report for report in scenes if report.info.name.partition(".")[0] not in tasks]
    if homeless:
        described = (f"  {_describe(report, report.info.name)}" for report in homeless)
        lines += ["scenes of tasks that are not installed", *described, ""]
    for heading, group in _OTHERS:
        reports = group.survey()
        width = max((len(report.info.name) for report in reports), default=0)
        lines += [heading] if reports else []
        for report in reports:
            lines.append(f"  {_describe(report, f'{report.info.name:{width}}')}")
            if group is LOSSES and report.spec is not None:
                lines += [f"    {line}" for line in _describe_options(report.spec)]
        lines += [""] if reports else []
    return lines


def _describe(report: PluginReport[Any], name: str) -> str:
    if report.spec is None:
        return f"{name}  BROKEN  ({report.info.origin})  {report.error}{_note(report)}"
    return f"{name}  ({report.info.origin})  {getattr(report.spec, 'summary', '')}".rstrip() + _note(report)


def _note(report: PluginReport[Any]) -> str:
    """How to choose what its name alone does not."""
    return f"  [{report.note}]" if report.note else ""


def _describe_task(spec: TaskSpec, scenes: list[PluginReport[SceneExtension]]) -> list[str]:
    from neuprim.config import check_groups, presets, task_choices
    from neuprim.config.task_files import LEVELS, read_levels

    check_groups(spec)
    default, levels = task_choices(spec), read_levels(spec, presets(spec))
    rows = [(s.name, f"{s.summary}{' (default)' if s.name == default.scene else ''}") for s in spec.scenes]
    rows += [_describe_scene(spec, report) for report in scenes if report.info.name.startswith(f"{spec.name}.")]
    width = max(len(name) for name, _ in rows)
    found = {
        "scenes": [f"{name:{width}}  {text}" for name, text in rows],
        "presets": [", ".join(name + " (default)" * (name == default.preset) for name in presets(spec))],
        "effort": [f"{LEVELS[0]} (fast) to {LEVELS[-1]} (good), of preset {levels[1].preset}"] if levels else [],
        "conditions": [", ".join(f"{c.name} [{c.unit}]" for c in spec.conditions)] if spec.conditions else [],
        "options": _describe_options(spec),
    }
    return [f"{title if i == 0 else '':10}  {text}" for title, texts in found.items() for i, text in enumerate(texts)]


def _describe_options(spec: TaskSpec | LossExtension) -> list[str]:
    """What may stand under ``task.options``, with defaults."""
    return [f"task.options.{name}={option[0]}  {option[1]}" for name, option in spec.options.items()]


def _describe_scene(spec: TaskSpec, report: PluginReport[SceneExtension]) -> tuple[str, str]:
    """(name, summary or error) of a scene that another package adds to a task."""
    from neuprim.config import check_scene

    name = report.info.name.removeprefix(f"{spec.name}.")
    problem, note = report.error, _note(report)
    if any(scene.name == name for scene in spec.scenes):
        note = f"  [hidden by the task's own; {SCENES.choice(report.info)} chooses it]"
    if report.spec is not None:
        try:
            check_scene(spec, name, report.spec.config_package)
            return name, f"({report.info.origin})  {report.spec.scene.summary}{note}"
        except ConfigError as error:
            problem = str(error)
    return name, f"BROKEN  ({report.info.origin})  {problem}{note}"


def _tasks(arguments: argparse.Namespace) -> int:
    print(*list_plugins(), sep="\n")
    return 0


def _add_new_task_arguments(parser: argparse.ArgumentParser) -> None:
    name = "what users will type after task=: lower-case letters, digits and _"
    parser.add_argument("name", metavar="NAME", help=name)
    out = "a folder that does not exist yet (default: neuprim-NAME)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=out)


def _new_task(arguments: argparse.Namespace) -> int:
    from neuprim.plugins.new_task import write_task_package

    print(*write_task_package(arguments.name, arguments.out), sep="\n")
    return 0


COMMAND = Command("tasks", "list tasks, scenes, presets and other plugins, and the packages they come from", _tasks)
NEW_TASK_COMMAND = Command(
    "new-task",
    "write a small working package with a task of your own: see docs/plugins.md",
    _new_task,
    _add_new_task_arguments,
)
