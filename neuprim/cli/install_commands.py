"""``neuprim tasks``, ``new-task`` and ``doctor``: what is installed, and whether it works."""

from __future__ import annotations

import argparse
import os
import platform
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from packaging.requirements import Requirement

from neuprim.cli.command import Command, plain_console
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.plugins.registry import EXPORTERS, INSPECTORS, LOSSES, SCENES, TASKS, PluginGroup, PluginReport
from neuprim.version import __version__

if TYPE_CHECKING:
    from rich.console import Console

    from neuprim.core.extensions import LossExtension, SceneExtension
    from neuprim.core.task import TaskSpec


# ---------------------------------------------------------------- tasks and new-task


_OTHER_PLUGINS: tuple[tuple[str, PluginGroup[Any]], ...] = (
    ("losses (train.loss=NAME)", LOSSES),
    ("exporters (neuprim export --format NAME)", EXPORTERS),
    ("inspectors (neuprim inspect --show NAME)", INSPECTORS),
)


def list_printed_plugins() -> list[str]:
    """Return the lines of ``neuprim tasks``; a broken plugin is one of them, with its error, and stops no other."""
    lines: list[str] = []
    scenes = SCENES.survey()
    for report in TASKS.survey():
        try:
            if report.spec is None:
                raise ConfigError(report.error or "cannot be loaded")
            summary, body = report.spec.summary, _describe_task_choices(report.spec, scenes)
        except NeuprimError as broken:
            summary, body = "BROKEN", [str(broken)]
        title = f"{report.info.name}  ({report.info.origin})  {summary}{_format_printed_plugin_note(report)}"
        lines += [title, *(f"  {line}" for line in body), ""]
    tasks = {info.name for info in TASKS.list_plugins()}
    homeless = [report for report in scenes if report.info.name.partition(".")[0] not in tasks]
    if homeless:
        described = (f"  {_format_printed_plugin(report, report.info.name)}" for report in homeless)
        lines += ["scenes of tasks that are not installed", *described, ""]
    for heading, group in _OTHER_PLUGINS:
        reports = group.survey()
        width = max((len(report.info.name) for report in reports), default=0)
        lines += [heading] if reports else []
        for report in reports:
            lines.append(f"  {_format_printed_plugin(report, f'{report.info.name:{width}}')}")
            if group is LOSSES and report.spec is not None:
                lines += [f"    {line}" for line in _describe_options(report.spec)]
        lines += [""] if reports else []
    return lines


def _format_printed_plugin(report: PluginReport[Any], name: str) -> str:
    if report.spec is None:
        return f"{name}  BROKEN  ({report.info.origin})  {report.error}{_format_printed_plugin_note(report)}"
    return (
        f"{name}  ({report.info.origin})  {getattr(report.spec, 'summary', '')}".rstrip()
        + _format_printed_plugin_note(report)
    )


def _format_printed_plugin_note(report: PluginReport[Any]) -> str:
    return f"  [{report.note}]" if report.note else ""


def _describe_task_choices(spec: TaskSpec, scenes: list[PluginReport[SceneExtension]]) -> list[str]:
    from neuprim.config import check_config_groups, list_task_presets, read_task_config
    from neuprim.config.task_files import LEVELS, read_config_effort_levels

    check_config_groups(spec)
    default, levels = read_task_config(spec), read_config_effort_levels(spec, list_task_presets(spec))
    rows = [(s.name, f"{s.summary}{' (default)' if s.name == default.scene else ''}") for s in spec.scenes]
    rows += [_describe_scene(spec, report) for report in scenes if report.info.name.startswith(f"{spec.name}.")]
    width = max(len(name) for name, _ in rows)
    found = {
        "scenes": [f"{name:{width}}  {text}" for name, text in rows],
        "presets": [", ".join(name + " (default)" * (name == default.preset) for name in list_task_presets(spec))],
        "effort": [f"{LEVELS[0]} (fast) to {LEVELS[-1]} (good), of preset {levels[1].preset}"] if levels else [],
        "conditions": [", ".join(f"{c.name} [{c.unit}]" for c in spec.conditions)] if spec.conditions else [],
        "options": _describe_options(spec),
    }
    return [f"{title if i == 0 else '':10}  {text}" for title, texts in found.items() for i, text in enumerate(texts)]


def _describe_options(spec: TaskSpec | LossExtension) -> list[str]:
    return [f"task.options.{name}={option[0]}  {option[1]}" for name, option in spec.options.items()]


def _describe_scene(spec: TaskSpec, report: PluginReport[SceneExtension]) -> tuple[str, str]:
    """(name, summary or error) of a scene that another package adds to a task."""
    from neuprim.config import check_scene_config

    name = report.info.name.removeprefix(f"{spec.name}.")
    problem, note = report.error, _format_printed_plugin_note(report)
    if any(scene.name == name for scene in spec.scenes):
        note = f"  [hidden by the task's own; {SCENES.choice(report.info)} chooses it]"
    if report.spec is not None:
        try:
            check_scene_config(spec, name, report.spec.config_package)
            return name, f"({report.info.origin})  {report.spec.scene.summary}{note}"
        except ConfigError as error:
            problem = str(error)
    return name, f"BROKEN  ({report.info.origin})  {problem}{note}"


def _tasks_command(arguments: argparse.Namespace) -> int:
    print(*list_printed_plugins(), sep="\n")
    return 0


def _add_new_task_arguments(parser: argparse.ArgumentParser) -> None:
    name = "what users will type after task=: lower-case letters, digits and _"
    parser.add_argument("name", metavar="NAME", help=name)
    out = "a folder that does not exist yet (default: neuprim-NAME)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=out)


def _new_task_command(arguments: argparse.Namespace) -> int:
    from neuprim.plugins.new_task import write_plugin_package

    print(*write_plugin_package(arguments.name, arguments.out), sep="\n")
    return 0


TASKS_COMMAND = Command(
    "tasks", "list tasks, scenes, presets and other plugins, and the packages they come from", _tasks_command
)
NEW_TASK_COMMAND = Command(
    "new-task",
    "write a small working package with a task of your own: see docs/plugins.md",
    _new_task_command,
    _add_new_task_arguments,
)


# ---------------------------------------------------------------- doctor


_DEVELOPERS = ("test", "docs", "dev")
"""Extras for work on neuprim itself."""

Rows = list[tuple[str, str]]


def print_doctor_report(console: Console | None = None) -> int:
    """Print what is installed and what works; return 0, or 1 if no backend works."""
    from rich.table import Table
    from rich.text import Text

    from neuprim.core.compute.kernels import cache_directory as kernel_cache
    from neuprim.core.io.files import cache_directory
    from neuprim.core.render import backends

    console = console or plain_console()
    reasons = {name: _probe_doctor_backend(name) for name in backends.backend_names()}
    working = None in reasons.values()
    tables: dict[str, Rows] = {
        "machine": _describe_doctor_machine(),
        "packages": _list_doctor_packages(),
        "CUDA devices": _list_doctor_devices(),
        "renderer backends": [(n, "works" if r is None else f"does not work: {r}") for n, r in reasons.items()],
        "caches": [
            ("kernels", f"{kernel_cache()} (set by NUMBA_CACHE_DIR)"),
            ("generated scenes", f"{cache_directory() / 'scenes'} (set by NEUPRIM_CACHE_DIR)"),
        ],
    }
    for title, rows in tables.items():
        table = Table(title=title, title_justify="left", show_header=False)
        table.add_column(no_wrap=True)
        table.add_column(overflow="fold")
        for name, value in rows:
            table.add_row(Text(name), Text(value))  # "neuprim[video]" is no markup
        console.print(table)
    if not working:
        console.print("no renderer backend works on this machine")
    return 0 if working else 1


def _describe_doctor_machine() -> Rows:
    from llvmlite import binding

    from neuprim.core.compute.threads import cpu_name

    total = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else total
    features = binding.get_host_cpu_features()
    simd = [name for name in ("sse4.2", "neon", "avx", "avx2", "fma", "avx512f") if features.get(name)]
    return [
        ("neuprim", __version__),
        ("python", f"{platform.python_version()} ({platform.python_implementation()})"),
        ("platform", platform.platform()),
        ("cpu", cpu_name()),
        ("cores", str(total) if usable == total else f"{usable} of {total} usable by this process"),
        ("simd", ", ".join(simd) or "none known"),
        ("memory", _describe_memory()),
    ]


def _describe_memory() -> str:
    try:
        total = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (ValueError, OSError, AttributeError):
        return "unknown"
    return f"{total / 2**30:.1f} GiB"


def _list_doctor_packages() -> Rows:
    extras = ["", *(metadata.metadata("neuprim").get_all("Provides-Extra") or [])]
    needed: dict[str, list[tuple[Requirement, str]]] = {}  # several extras may name one package
    for text in metadata.requires("neuprim") or []:
        requirement = Requirement(text)
        marker = requirement.marker
        extra = next((name for name in extras if marker is None or marker.evaluate({"extra": name})), None)
        if extra is not None and extra not in _DEVELOPERS:
            wanted = f"'neuprim[{extra}]'" if extra else f"'{requirement.name}{requirement.specifier}'"
            needed.setdefault(requirement.name, []).append((requirement, wanted))
    return [(name, _describe_package(name, requirements)) for name, requirements in needed.items()]


def _describe_package(name: str, needed: list[tuple[Requirement, str]]) -> str:
    """Return the version of a package, and what to install where it is missing or too old."""
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return f"not installed: pip install {' or '.join(wanted for _, wanted in needed)}"
    for requirement, wanted in needed:
        if not requirement.specifier.contains(version, prereleases=True):
            return f"{version}, but neuprim needs {requirement.specifier}: pip install {wanted}"
    return version


def _list_doctor_devices() -> Rows:
    import torch

    from neuprim.core.render.backends import gpu_backends_unavailable

    missing = gpu_backends_unavailable()
    rows = [("used by runs", "yes" if missing is None else f"no: {missing}")]
    if torch.version.cuda is None:
        return [("none", f"torch {torch.__version__} is a CPU build"), *rows]
    if not torch.cuda.is_available():
        text = f"torch {torch.__version__} has CUDA {torch.version.cuda}, but no device or driver is usable"
        return [("none", text), *rows]
    for i in range(torch.cuda.device_count()):
        p = torch.cuda.get_device_properties(i)
        text = f"{p.name}, {p.total_memory / 2**30:.1f} GiB, compute capability {p.major}.{p.minor}"
        rows.append((f"cuda:{i}", text))
    return rows


def _probe_doctor_backend(name: str) -> str | None:
    """None if a backend draws a picture here, else the reason it does not."""
    from neuprim.core.render import probe_backend

    try:
        return probe_backend(name)
    except Exception as error:  # a diagnosis must show a broken backend, not die of it
        return f"{type(error).__name__}: {' '.join(str(error).split())}"


DOCTOR_COMMAND = Command(
    "doctor", "show versions, devices and which renderer backends work here", lambda args: print_doctor_report()
)
