"""``neuprim doctor``: what is installed, which devices there are, and which renderer backends work on this machine."""

from __future__ import annotations

import argparse
import os
import platform
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from packaging.requirements import Requirement

from neuprim.cli.command import Command
from neuprim.version import __version__

if TYPE_CHECKING:
    from rich.console import Console

__all__ = ["COMMAND", "print_report"]

NOT_FOR_USERS = ("test", "docs", "dev")
"""Extras that only people who work on neuprim itself need."""

Rows = list[tuple[str, str]]


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    pass


def print_report(console: Console | None = None) -> int:
    """Print what is installed and what works; return 0, or 1 if no backend works."""
    from rich.table import Table
    from rich.text import Text

    from neuprim.cli.console import plain_console

    console = console or plain_console()
    backends, working = _backends()
    for title, rows in (
        ("machine", _machine()),
        ("packages", _packages()),
        ("CUDA devices", _cuda()),
        ("renderer backends", backends),
        ("caches", _caches()),
    ):
        table = Table(title=title, title_justify="left", show_header=False)
        table.add_column(no_wrap=True)
        table.add_column(overflow="fold")
        for name, value in rows:
            table.add_row(Text(name), Text(value))  # "neuprim[video]" is no markup
        console.print(table)
    if not working:
        console.print("no renderer backend works on this machine")
    return 0 if working else 1


def _machine() -> Rows:
    from neuprim.core.compute.threads import cpu_name

    return [
        ("neuprim", __version__),
        ("python", f"{platform.python_version()} ({platform.python_implementation()})"),
        ("platform", platform.platform()),
        ("cpu", cpu_name()),
        ("cores", _cores()),
        ("simd", _simd()),
        ("memory", _memory()),
    ]


def _cores() -> str:
    total = os.cpu_count() or 1
    usable = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else total
    return str(total) if usable == total else f"{usable} of {total} usable by this process"


def _simd() -> str:
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    found = [
        name
        for name in ("sse4.2", "neon", "avx", "avx2", "fma", "avx512f", "avx512vl", "avx512dq")
        if features.get(name)
    ]
    return ", ".join(found) or "none known"


def _memory() -> str:
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


def _packages() -> Rows:
    """Each package that neuprim's own metadata names, for itself or for an extra, with what is installed."""
    needed: dict[str, list[tuple[Requirement, str]]] = {}  # several extras may name one package
    for text in metadata.requires("neuprim") or []:
        requirement = Requirement(text)
        extra = _extra_of(requirement)
        if extra in NOT_FOR_USERS or not (
            requirement.marker is None or requirement.marker.evaluate({"extra": extra or ""})
        ):
            continue
        wanted = f"'neuprim[{extra}]'" if extra else f"'{requirement.name}{requirement.specifier}'"
        needed.setdefault(requirement.name, []).append((requirement, wanted))
    rows: Rows = [(name, _state(name, choices)) for name, choices in needed.items()]
    if "triton" not in needed:
        rows.append(("triton", _version_or("triton", "not installed: comes with torch's CUDA builds")))
    return rows


def _state(name: str, needed: list[tuple[Requirement, str]]) -> str:
    """The version of an installed package, and what to install where it is missing or does not suit all that need
    it."""
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return f"not installed: pip install {' or '.join(wanted for _, wanted in needed)}"
    for requirement, wanted in needed:
        if not requirement.specifier.contains(version, prereleases=True):
            return f"{version}, but neuprim needs {requirement.specifier}: pip install {wanted}"
    return version


def _extra_of(requirement: Requirement) -> str | None:
    """The extra a requirement belongs to, or None for a plain dependency."""
    if requirement.marker is None:
        return None
    names: Iterable[str] = metadata.metadata("neuprim").get_all("Provides-Extra") or []
    text = str(requirement.marker)
    return next((name for name in names if f'extra == "{name}"' in text), None)


def _version_or(name: str, otherwise: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return otherwise


def _cuda() -> Rows:
    import torch

    from neuprim.core.render.backends import gpu_unavailable

    missing = gpu_unavailable()
    used = ("used by runs", "yes" if missing is None else f"no: {missing}")
    if torch.version.cuda is None:
        return [("none", f"torch {torch.__version__} is a CPU build"), used]
    if not torch.cuda.is_available():
        return [
            ("none", f"torch {torch.__version__} has CUDA {torch.version.cuda}, but no device or driver is usable"),
            used,
        ]
    rows: Rows = [used]
    for i in range(torch.cuda.device_count()):
        p = torch.cuda.get_device_properties(i)
        rows.append(
            (f"cuda:{i}", f"{p.name}, {p.total_memory / 2**30:.1f} GiB, compute capability {p.major}.{p.minor}")
        )
    return rows


def _backends() -> tuple[Rows, bool]:
    """A row per backend, and whether any of them works."""
    from neuprim.core.render import backends

    rows: Rows = []
    working = False
    for name in backends.backend_names():
        reason = _probe(name)
        working = working or reason is None
        rows.append((name, "works" if reason is None else f"does not work: {reason}"))
    return rows, working


def _probe(name: str) -> str | None:
    """None if a backend draws a picture here, else the reason it does not."""
    try:
        from neuprim.core.render import probe_backend

        return probe_backend(name)
    except Exception as error:  # a diagnosis must show a broken backend, not die of it
        return f"{type(error).__name__}: {' '.join(str(error).split())}"


def _caches() -> Rows:
    from neuprim.core.compute.kernels import cache_directory as kernels
    from neuprim.core.io.files import cache_directory as everything

    return [
        ("kernels", f"{kernels()} (set by NUMBA_CACHE_DIR)"),
        ("generated scenes", f"{everything() / 'scenes'} (set by NEUPRIM_CACHE_DIR)"),
    ]


COMMAND = Command(
    "doctor",
    "show versions, devices and which renderer backends work here",
    _add_arguments,
    lambda arguments: print_report(),
)
