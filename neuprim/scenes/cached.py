"""Generated files in the cache: there completely, or made anew."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path

from neuprim.core.errors import DataError
from neuprim.core.io.files import publish_folder

__all__ = ["cached_folder"]


def cached_folder(final: Path, files: Iterable[str], write: Callable[[Path], None], what: str) -> Path:
    """Have ``write`` fill the folder ``final`` unless all files are there; returns it.

    The folder appears under its name only when complete, so an interrupted run leaves nothing that could be taken for a
    data set.

    Args:
        files: every file that belongs there, relative to the folder.
        write: fills the empty folder that it is given; with equal files, whoever calls it.
        what: for messages, e.g. ``"scene solids: cannot write the generated images"``.

    Raises:
        DataError: the cache directory cannot be written.
    """
    names = tuple(files)
    try:
        publish_folder(final, write, lambda folder: all((folder / name).is_file() for name in names))
    except OSError as error:
        raise DataError(f"{what} to {final}: {error}") from error
    return final
