"""The film along a path, drawn as ``neuprim render --camera FILE`` draws it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from neuprim.runs.draw import render_run

__all__ = ["film", "free_name"]


def free_name(path: Path) -> Path:
    """The path, or ``NAME-2.SUFFIX``, ``NAME-3.SUFFIX`` …: the first where nothing is."""
    number, found = 1, path
    while found.exists():
        number += 1
        found = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return found


def film(
    run_dir: Path,
    cameras: Path,
    conditions: Mapping[str, str],
    format: str,
    fps: float,
    progress: Callable[[str, float], None],
) -> Path:
    """Draw the film of a file of cameras into the run's ``renders``, beside what is there.

    Args:
        conditions: name -> text, as for :func:`~neuprim.runs.draw.render_run`.
        format: webp, gif or mp4; png for a folder of images.

    Raises:
        NeuprimError: as :func:`~neuprim.runs.draw.render_run`.
    """
    suffix = "" if format == "png" else f".{format}"
    out = free_name(run_dir / "renders" / f"{cameras.stem}{suffix}")
    render_run(run_dir, str(cameras), None, format, out, 0, conditions, fps, progress=progress)
    return out
