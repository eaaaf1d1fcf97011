"""What a run directory holds, read without assuming that the run ended.

Expected files, each of which may be missing: ``config.yaml`` (resolved settings), ``metrics.json`` (final numbers),
``metrics.jsonl`` (one JSON object per logged step) and ``renders/`` (held-out views as ``test_<index>_<name>.png`` with
``_truth`` and ``_error`` beside them, ``worst.json`` and its pictures, ``clip_<name>.webp`` with ground truth and
render side by side, and ``orbit.webp``).
"""

from __future__ import annotations

import math
import re
from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from neuprim.core.errors import DataError
from neuprim.core.io.plain import load_json, parse_yaml_file
from neuprim.report.regions import RegionFile, read_regions


@dataclass(frozen=True)
class ViewFiles:
    """The pictures of one held-out view: its place in the split, its name as file names spell it, and their paths."""

    index: int
    stem: str
    render: Path
    truth: Path | None
    error: Path | None


@dataclass(frozen=True)
class ReportedRun:
    """A run directory's content.

    Attributes:
        config_text, config: ``config.yaml`` as written and as parsed; None and empty without the file.
        metrics: ``metrics.json``, None while the run has not finished.
        log: ``metrics.jsonl`` in order of steps. Where a resumed run logged a step again, the later line counts.
        unreadable_lines: lines of the log that are not JSON objects with a step, as a kill in mid-write leaves them.
    """

    run_dir: Path
    config_text: str | None
    config: Mapping[str, Any]
    metrics: Mapping[str, Any] | None
    log: list[Mapping[str, Any]]
    unreadable_lines: int
    views: list[ViewFiles]
    orbit: Path | None
    clips: list[Path]
    regions: list[RegionFile]

    def field(self, key: str) -> Any:
        """Return a value of ``metrics.json``, None where the file or the key is missing."""
        return None if self.metrics is None else self.metrics.get(key)

    @property
    def shown(self) -> str:
        """What pictures show of the channels, in words; empty where they are red, green and blue, or grey."""
        return str(self.field("shown") or "")

    def name_of(self, key: str) -> str | None:
        """Return the task's or scene's name: from the metrics, else from the configuration."""
        value = self.field(key)
        if value is None:
            value = self.config.get(key)
        if isinstance(value, Mapping):
            value = value.get("name")
        return None if value is None else str(value)

    def last(self, key: str) -> tuple[float, float] | None:
        """Return (step, value) of the newest log line that has a finite number under ``key``."""
        steps, values = self.series("step", key)
        return (steps[-1], values[-1]) if steps else None

    def series(self, x: str, y: str) -> tuple[list[float], list[float]]:
        """Return the values of two keys over the log lines that have finite numbers for both."""
        pairs = [(as_reported_number(line.get(x)), as_reported_number(line.get(y))) for line in self.log]
        known = [(a, b) for a, b in pairs if a is not None and b is not None and math.isfinite(a) and math.isfinite(b)]
        return [a for a, _ in known], [b for _, b in known]

    def view_numbers(self, view: ViewFiles) -> Mapping[str, Any]:
        """Return the entry of ``per_view`` of a view's pictures; empty where the names do not agree."""
        entries = read_reported_view_numbers(self)
        entry = entries[view.index] if view.index < len(entries) else {}
        return (
            entry if _plain_reported_view_name(str(entry.get("name"))) == _plain_reported_view_name(view.stem) else {}
        )


def read_reported_view_numbers(run: ReportedRun) -> list[Mapping[str, Any]]:
    """Return the per-view entries of ``metrics.json``; empty where there are none."""
    entries = run.field("per_view")
    return [e for e in entries if isinstance(e, Mapping)] if isinstance(entries, list) else []


def as_reported_number(value: object) -> float | None:
    """Return ``value`` as a float if it is a number and not NaN, else None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or math.isnan(value):
        return None
    return float(value)


def read_reported_run(run_dir: Path) -> ReportedRun:
    """Read a run directory.

    Raises:
        DataError: no such directory, nothing of a run in it, or a damaged ``config.yaml`` or ``metrics.json``.
    """
    if not run_dir.is_dir():
        raise DataError(f"{run_dir}: not a directory")
    files = [run_dir / name for name in ("config.yaml", "metrics.json", "metrics.jsonl")]
    if not any(f.is_file() for f in files):
        raise DataError(f"{run_dir}: not a run directory, it has none of config.yaml, metrics.json and metrics.jsonl")
    config_text = _read_reported_text(files[0])
    config = _read_reported_mapping(files[0], "YAML", lambda text: parse_yaml_file(text) or {})
    metrics = _read_reported_mapping(files[1], "JSON", lambda text: load_json(text, infinite=True))
    log, unreadable = _parse_reported_log(_read_reported_text(files[2]) or "")
    renders = run_dir / "renders"
    orbit, clips = renders / "orbit.webp", sorted(renders.glob("clip_*.webp"))
    return ReportedRun(
        run_dir,
        config_text,
        config or {},
        metrics,
        log,
        unreadable,
        _find_reported_views(renders),
        orbit if orbit.is_file() else None,
        clips,
        read_regions(renders),
    )


def _read_reported_text(path: Path) -> str | None:
    if not path.is_file():
        return None
    try:
        return path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise DataError(f"{path}: not UTF-8 text ({error})") from error


def _read_reported_mapping(path: Path, kind: str, parse: Callable[[str], Any]) -> Mapping[str, Any] | None:
    text = _read_reported_text(path)
    if text is None:
        return None
    try:
        data = parse(text)
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: not valid {kind} ({' '.join(str(error).split())})") from error
    if not isinstance(data, Mapping):
        raise DataError(f"{path}: expected a mapping, found {type(data).__name__}")
    return data


def _parse_reported_log(text: str) -> tuple[list[Mapping[str, Any]], int]:
    """Return readable lines in order of steps, and the number of the others."""
    lines: list[Mapping[str, Any]] = []
    unreadable = 0
    for raw in filter(str.strip, text.splitlines()):
        try:
            line = load_json(raw, infinite=True)
        except (ValueError, RecursionError):
            line = None
        step = as_reported_number(line.get("step")) if isinstance(line, Mapping) else None
        if step is None:
            unreadable += 1
            continue
        # A run resumed from a checkpoint logs the steps after it anew: what it had logged beyond that point is void.
        while lines and lines[-1]["step"] >= step:
            lines.pop()
        lines.append(line)
    return lines, unreadable


def _find_reported_views(folder: Path) -> list[ViewFiles]:
    groups: dict[str, set[str]] = defaultdict(set)
    for path in folder.glob("test_*.png"):
        match = re.match(r"test_(\d+)(_|$)", path.stem)
        if match:
            groups[match[1]].add(path.stem)
    views = []
    for index in sorted(groups, key=lambda digits: (int(digits), digits)):
        # The shortest name of an index is the render, so that a view called "x_truth" is not taken for another's truth.
        stem = min(groups[index], key=len)
        truth, error = (
            folder / f"{stem}_{kind}.png" if f"{stem}_{kind}" in groups[index] else None for kind in ("truth", "error")
        )
        views.append(ViewFiles(int(index), stem[len(f"test_{index}_") :], folder / f"{stem}.png", truth, error))
    return views


def _plain_reported_view_name(name: str) -> str:
    return re.sub(r"\W+|_+", "_", name).strip("_").lower()
