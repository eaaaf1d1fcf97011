"""The files that the end of a run writes, of one model: its metrics, pictures and report."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from neuprim.core.errors import ConfigError

__all__ = ["discard_results", "refuse_results", "result_files"]

_PAGES = ("metrics.json", "report.html", "viewer.html")
_PICTURES = re.compile(r"test_\d{3,}_.*\.png|clip_.*\.webp|orbit\.webp|worst(_\d{3,}\.png|\.json)")


def result_files(run_dir: Path) -> list[Path]:
    """Those that are there; what other commands draw into ``renders/`` is none of them."""
    folder = run_dir / "renders"
    pictures = [path for path in sorted(folder.iterdir()) if _PICTURES.fullmatch(path.name)] if folder.is_dir() else []
    return [*(path for name in _PAGES if (path := run_dir / name).is_file()), *pictures]


def discard_results(run_dir: Path) -> None:
    """Remove them. Rule: a run that goes on does so before its model changes, so that a kill never leaves numbers of
    another model beside it."""
    for path in result_files(run_dir):
        path.unlink(missing_ok=True)


def refuse_results(run_dir: Path, targets: Iterable[Path]) -> None:
    """Raises ConfigError if a command would write over one of them."""
    own = {path.resolve() for path in result_files(run_dir)}
    for target in targets:
        if target.resolve() in own:
            raise ConfigError(
                f"{target}: is a picture of the run's report; --force replaces it, --out PATH writes elsewhere"
            )
