"""``neuprim doctor``: what is installed, which devices there are, and which renderer backends work on this machine."""

from __future__ import annotations

import argparse
import os
import platform
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from packaging.requirements import Requirement

from neuprim.cli.command import Command, plain_console
from neuprim.version import __version__

if TYPE_CHECKING:
    from rich.console import Console

_DEVELOPERS = ("test", "docs", "dev")
"""Extras that only people who work on neuprim itself need."""

Rows = list[tuple[str, str]]


def print_report(console: Console | None = None) -> int:
    """Print what is installed and what works; return 0, or 1 if no backend works."""
    from rich.table import Table
    from rich.text import Text

    from neuprim.core.compute.kernels import cache_directory as kernel_cache
    from neuprim.core.io.files import cache_directory
    from neuprim.core.render import backends

    console = console or plain_console()
    reasons = {name: _probe(name) for name in backends.backend_names()}
    working = None in reasons.values()
    tables: dict[str, Rows] = {
        "machine": _describe_machine(),
        "packages": _list_packages(),
        "CUDA devices": _list_devices(),
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


def _describe_machine() -> Rows:
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
    text = f"{total / 2**30:.1f} GiB"
    try:
        limit = int(Path("/sys/fs/cgroup/memory.max").read_text(encoding="ascii"))
    except (OSError, ValueError):
        return text  # no control group, or "max"
    return f"{limit / 2**30:.1f} GiB (limit of this container; machine: {text})" if limit < total else text


def _list_packages() -> Rows:
    """Each package that neuprim's own metadata names, for itself or for an extra, with what is installed."""
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


def _list_devices() -> Rows:
    import torch

    from neuprim.core.render.backends import gpu_unavailable

    missing = gpu_unavailable()
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


def _probe(name: str) -> str | None:
    """None if a backend draws a picture here, else the reason it does not."""
    try:
        from neuprim.core.render import probe_backend

        return probe_backend(name)
    except Exception as error:  # a diagnosis must show a broken backend, not die of it
        return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _doctor(arguments: argparse.Namespace) -> int:
    return print_report()


COMMAND = Command("doctor", "show versions, devices and which renderer backends work here", _doctor)
