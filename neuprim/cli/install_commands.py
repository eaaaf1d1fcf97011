"""``neuprim tasks``, ``new-task``, ``blender-addon`` and ``doctor``: plugins, add-on for Blender, installation."""

from __future__ import annotations

import argparse
import os
import platform
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

from packaging.requirements import Requirement

from neuprim.cli.command import Command
from neuprim.core.errors import NeuprimError
from neuprim.plugins.registry import (
    EXPORTERS,
    INSPECTORS,
    LOSSES,
    SCENES,
    TASKS,
    PluginGroup,
    PluginReport,
    qualified_plugin_name,
)
from neuprim.version import __version__

if TYPE_CHECKING:
    from neuprim.core.extensions import LossExtension, SceneExtension
    from neuprim.core.task import TaskSpec


# ---------------------------------------------------------------- tasks and new-task


_OTHER_PLUGINS: tuple[tuple[str, PluginGroup[Any]], ...] = (
    ("losses (train.loss=NAME)", LOSSES),
    ("exporters (neuprim export --format NAME)", EXPORTERS),
    ("inspectors (neuprim inspect --show NAME)", INSPECTORS),
)


def list_printed_plugins() -> list[str]:
    """Return the text lines that ``neuprim tasks`` prints: name, package and summary of every installed plugin.

    Names are written as users type them. A plugin that cannot be loaded is listed with the reason.
    """
    lines: list[str] = []
    scenes = SCENES.survey()
    for task in TASKS.survey():
        lines.append(_format_printed_plugin(TASKS, task))
        if task.spec is not None:
            try:
                lines += [f"  {line}" for line in _describe_task_choices(task.spec, scenes)]
            except NeuprimError as broken:
                lines.append(f"  BROKEN  {broken}")
        lines.append("")
    for heading, group in _OTHER_PLUGINS:
        lines.append(heading)
        for report in group.survey():
            lines.append(f"  {_format_printed_plugin(group, report)}")
            if group is LOSSES and report.spec is not None:
                lines += [f"    {line}" for line in _describe_options(report.spec)]
        lines.append("")
    return lines


def _format_printed_plugin(group: PluginGroup[Any], report: PluginReport[Any]) -> str:
    text = f"BROKEN  {report.error}" if report.spec is None else getattr(report.spec, "summary", "")
    return f"{group.shortest_name(report.info)}  ({report.info.origin})  {text}".rstrip()


def _describe_task_choices(spec: TaskSpec, scenes: list[PluginReport[SceneExtension]]) -> list[str]:
    from neuprim.config import check_config_groups, list_task_presets, read_task_config
    from neuprim.config.task_files import LEVELS, read_config_effort_levels

    check_config_groups(spec)
    default, presets = read_task_config(spec), list_task_presets(spec)
    levels = read_config_effort_levels(spec, presets)
    rows = [(s.name, f"{s.summary}{' (default)' if s.name == default.scene else ''}") for s in spec.scenes]
    for report in scenes:
        if report.info.name.startswith(f"{spec.name}."):
            name = SCENES.shortest_name(report.info)
            if any(scene.name == name for scene in spec.scenes):  # the bare name means the task's own
                name = qualified_plugin_name(report.info.distribution, name)
            text = f"BROKEN  {report.error}" if report.spec is None else report.spec.scene.summary
            rows.append((name, f"({report.info.origin})  {text}"))
    width = max(len(name) for name, _ in rows)
    found = {
        "scenes": [f"{name:{width}}  {text}" for name, text in rows],
        "presets": [", ".join(name + " (default)" * (name == default.preset) for name in presets)],
        "effort": [f"{LEVELS[0]} (fast) to {LEVELS[-1]} (good), of preset {levels[1].preset}"] if levels else [],
        "conditions": [", ".join(f"{c.name} [{c.unit}]" for c in spec.conditions)] if spec.conditions else [],
        "options": _describe_options(spec),
    }
    return [f"{title if i == 0 else '':10}  {text}" for title, texts in found.items() for i, text in enumerate(texts)]


def _describe_options(spec: TaskSpec | LossExtension) -> list[str]:
    return [f"task.options.{name}={option[0]}  {option[1]}" for name, option in spec.options.items()]


def _tasks_command(arguments: argparse.Namespace) -> int:
    print(*list_printed_plugins(), sep="\n")
    return 0


def _add_new_task_arguments(parser: argparse.ArgumentParser) -> None:
    name = "name of the task, typed after task=: lower-case letters, digits and _"
    parser.add_argument("name", metavar="NAME", help=name)
    out = "where to write, a new folder (default: neuprim-NAME)"
    parser.add_argument("--out", type=Path, metavar="DIR", help=out)


def _new_task_command(arguments: argparse.Namespace) -> int:
    from neuprim.plugins.new_task import write_plugin_package

    print(*write_plugin_package(arguments.name, arguments.out), sep="\n")
    return 0


def _add_blender_addon_arguments(parser: argparse.ArgumentParser) -> None:
    out = "where to write (default: neuprim-blender.zip)"
    parser.add_argument("--out", type=Path, metavar="FILE", default=Path("neuprim-blender.zip"), help=out)


def _blender_addon_command(arguments: argparse.Namespace) -> int:
    from neuprim.blender import write_blender_addon

    write_blender_addon(arguments.out)
    print(arguments.out)
    return 0


TASKS_COMMAND = Command(
    "tasks", "list tasks, scenes, presets and other plugins, and the packages they come from", _tasks_command
)
NEW_TASK_COMMAND = Command(
    "new-task",
    "create a small working package with a task of your own (guide: docs/plugins.md)",
    _new_task_command,
    _add_new_task_arguments,
)
BLENDER_ADDON_COMMAND = Command(
    "blender-addon",
    "write the add-on for Blender, which uses this installation (guide: docs/pipeline.md)",
    _blender_addon_command,
    _add_blender_addon_arguments,
)


# ---------------------------------------------------------------- doctor


_DEVELOPERS = ("test", "docs", "dev")
"""Extras (optional groups of dependencies) for work on neuprim itself, which ``doctor`` does not list."""

Rows = list[tuple[str, str]]


def print_doctor_report() -> int:
    """Print the machine, installed packages, GPUs and working renderer backends; return 0, or 1 if no backend works."""
    from neuprim.core.compute.kernels import cache_directory as kernel_cache
    from neuprim.core.io.files import cache_directory
    from neuprim.core.render import backends

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
        width = max(len(name) for name, _ in rows)
        print(title, *(f"  {name:{width}}  {value}" for name, value in rows), "", sep="\n")
    if not working:
        print("no renderer backend works on this machine")
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
    ]


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
    """Return the version of an installed package, or what to install if the package is missing or too old."""
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
    """Return why a backend cannot render a test image on this machine; None if it can."""
    from neuprim.core.render import probe_backend

    try:
        return probe_backend(name)
    except Exception as error:  # a diagnosis must show a broken backend, not die of it
        return f"{type(error).__name__}: {' '.join(str(error).split())}"


DOCTOR_COMMAND = Command(
    "doctor", "show versions, devices and which renderer backends work here", lambda args: print_doctor_report()
)
