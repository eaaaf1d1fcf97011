"""``exports.json`` of a run directory: which formats of which packages it was exported to, newest last."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from neuprim.core.extensions import ExportJob, ExportReport
from neuprim.core.io.files import write_json
from neuprim.core.io.plain import load_json
from neuprim.plugins.registry import EXPORTERS
from neuprim.version import __version__

__all__ = ["FILE", "record_export"]

FILE = "exports.json"
_ENTRIES = 200
"""The newest that are kept."""
_FILES = 20
"""Names kept of one export's files, which may be a thousand frames."""
_LONGEST = 500
"""Characters of one text."""
_MAX_BYTES = 1 << 24
"""More is no file of ours."""


def record_export(word: str, job: ExportJob, report: ExportReport) -> ExportReport:
    """Adds an export to its run's list, and returns its report; with a note where the list could not be written.

    Args:
        word: what chose the exporter, ``NAME`` or ``PACKAGE:NAME``.
    """
    path = job.run.directory / FILE
    try:
        write_json(path, [*_read(path), _entry(word, job, report)][-_ENTRIES:])
    except OSError as error:
        return replace(
            report,
            notes=(*report.notes, f"{path}: not written ({error.strerror or error}); this export is not recorded"),
        )
    except ValueError as error:
        return replace(report, notes=(*report.notes, f"{path}: {error}; left as it is, this export is not recorded"))
    return report


def _entry(word: str, job: ExportJob, report: ExportReport) -> dict[str, Any]:
    info, files = EXPORTERS.find(word), [_place(Path(file), job.run.directory) for file in report.files]
    return {
        "files": files[:_FILES],
        **({"more_files": len(files) - _FILES} if len(files) > _FILES else {}),
        "format": info.name,
        "package": info.distribution,
        "version": info.version,
        "neuprim": __version__,
        "time": datetime.now(UTC).isoformat(timespec="seconds"),
        "options": _plain({**job.options, **job.conditions}),
        "lossless": bool(report.lossless),
    }


def _place(file: Path, directory: Path) -> str:
    """Relative to the run directory if it lies in there, so that a run that was moved still finds it; else absolute."""
    whole, inside = file.absolute(), directory.absolute()
    return str(whole.relative_to(inside) if whole.is_relative_to(inside) else whole)[:_LONGEST]


def _plain(options: Mapping[str, Any]) -> dict[str, Any]:
    """Options as strict JSON holds them."""
    plain: dict[str, Any] = {}
    for key, value in options.items():
        number = isinstance(value, bool | int) or (isinstance(value, float) and math.isfinite(value))
        plain[str(key)[:_LONGEST]] = value if value is None or number else str(value)[:_LONGEST]
    return plain


def _read(path: Path) -> list[Any]:
    """Earlier entries.

    Raises:
        ValueError: the file is not a list of exports.
        OSError: it cannot be read.
    """
    try:
        if path.stat().st_size > _MAX_BYTES:
            raise ValueError(f"larger than {_MAX_BYTES} bytes; expected a list of exports")
        text = path.read_bytes()
    except FileNotFoundError:
        return []
    try:
        entries = load_json(text)
    except (ValueError, RecursionError) as error:
        raise ValueError("not JSON; expected a list of exports") from error
    if not isinstance(entries, list) or not all(isinstance(entry, dict) for entry in entries):
        raise ValueError("expected a list of exports")
    return entries
