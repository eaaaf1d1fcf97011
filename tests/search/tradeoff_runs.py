"""A tiny run for the tests of operating points: two primitives' worth of scene, forty primitives, seconds."""

from __future__ import annotations

import shutil
from pathlib import Path

from tests.core import tiny
from tests.short_runs import fit, words

__all__ = ["copied", "tiny_run"]


def tiny_run(folder: Path) -> Path:
    """A finished run of the static task, without its pictures."""
    return fit(words(tiny.write_blender(folder / "two"), folder / "run", 60))


def copied(run_dir: Path, to: Path) -> Path:
    """The same run elsewhere, so that a test may write into it."""
    shutil.copytree(run_dir, to)
    return to
