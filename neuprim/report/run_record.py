"""Read a run directory for report pages: metrics, curve and pictures of a run, finished or not."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuprim.core.errors import DataError
from neuprim.core.io.json_reader import finite_json_number, load_json
from neuprim.core.metrics import metric_from_json


@dataclass(frozen=True)
class ViewFiles:
    """The picture files of one held-out view: its index in the split, its name in file names, and the files' paths."""

    index: int
    stem: str
    render: Path
    truth: Path
    error: Path


@dataclass(frozen=True)
class ReportedRun:
    """The content of a run directory that report pages show.

    Attributes:
        metrics: content of ``metrics.json``; empty if the run has not finished.
        log: complete lines of ``metrics.jsonl``.
        views, clips: the pictures of held-out views and the video clips that are in ``renders/``.
    """

    run_dir: Path
    metrics: Mapping[str, Any]
    log: list[Mapping[str, Any]]
    views: list[ViewFiles]
    clips: list[Path]

    @property
    def shown(self) -> str:
        """Text that says which channels the pictures show; empty if the channels are red, green and blue, or grey."""
        return str(self.metrics.get("shown") or "")

    @property
    def view_numbers(self) -> list[Mapping[str, Any]]:
        """Metrics of each held-out view, from ``per_view`` in ``metrics.json``."""
        entries = self.metrics.get("per_view")
        return [e for e in entries if isinstance(e, Mapping)] if isinstance(entries, list) else []

    def numbers_of(self, view: ViewFiles) -> Mapping[str, Any]:
        """Return the metrics of a view; empty if ``metrics.json`` does not contain the view."""
        entries = self.view_numbers
        return entries[view.index] if view.index < len(entries) else {}

    def series(self, x: str, y: str) -> tuple[list[float], list[float]]:
        """Return two lists: the values of the keys ``x`` and ``y`` in all log lines where both values are finite."""
        pairs = [(finite_json_number(line.get(x)), finite_json_number(line.get(y))) for line in self.log]
        known = [(a, b) for a, b in pairs if a is not None and b is not None]
        return [a for a, _ in known], [b for _, b in known]


def median_and_worst(views: Sequence[Mapping[str, Any]]) -> tuple[int, ...]:
    """Return the indices of the view with the median PSNR (the lower of two) and of the view with the lowest PSNR.

    If one view has both properties, its index is returned once.

    Args:
        views: entries of ``per_view`` in ``metrics.json``; entries without a PSNR are left out.
    """
    known = [(value, i) for i, entry in enumerate(views) if (value := metric_from_json(entry, "psnr")) is not None]
    order = [i for _, i in sorted(known)]
    return tuple(dict.fromkeys([order[(len(order) - 1) // 2], order[0]])) if order else ()


def read_reported_run(run_dir: Path) -> ReportedRun:
    """Read a run directory. The fields of missing files stay empty.

    Raises:
        DataError: ``metrics.json`` is damaged, or a file cannot be read.
    """
    file = run_dir / "metrics.json"
    try:
        metrics = load_json(file.read_text(encoding="utf-8"), infinite=True) if file.is_file() else {}
        file = run_dir / "metrics.jsonl"
        text = file.read_text(encoding="utf-8", errors="replace") if file.is_file() else ""
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{file}: cannot be read ({' '.join(str(error).split())})") from error
    if not isinstance(metrics, Mapping):
        raise DataError(f"{run_dir / 'metrics.json'}: expected a mapping, found {type(metrics).__name__}")
    renders = run_dir / "renders"
    lines = [line for raw in text.splitlines() if (line := _parse_reported_line(raw)) is not None]
    return ReportedRun(run_dir, metrics, lines, _find_reported_views(renders), sorted(renders.glob("clip_*.webp")))


def _parse_reported_line(text: str) -> Mapping[str, Any] | None:
    try:
        line = load_json(text, infinite=True)
    except (ValueError, RecursionError):
        return None
    return line if isinstance(line, Mapping) else None


def _find_reported_views(folder: Path) -> list[ViewFiles]:
    """Return the picture files of the held-out views in ``folder``, in order of the views.

    Views without an error map are left out: a view's error map is written last, so the view is not complete.
    """
    views = []
    for error in folder.glob("test_*_error.png"):
        name = error.stem.removesuffix("_error")
        match, render = re.fullmatch(r"test_(\d{1,9})_(.*)", name), folder / f"{name}.png"
        if match and render.is_file():
            views.append(ViewFiles(int(match[1]), match[2], render, folder / f"{name}_truth.png", error))
    return sorted(views, key=lambda view: view.index)
