"""What happens when a plugin crashes while it works: one line that names its package, and the traceback in a file."""

from __future__ import annotations

import re
import tempfile
import time
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from neuprim import __version__
from neuprim.core.errors import DISK, NeuprimError
from neuprim.plugins.registry import Group, PluginError, PluginInfo

__all__ = ["is_ours", "origin", "reported"]

_OURS = "neuprim"


def origin(group: Group[Any], name: str) -> PluginInfo:
    """The package that ``name`` comes from, typed as NAME or PACKAGE:NAME; neuprim's own where it is among several."""
    package, _, plain = name.rpartition(":")
    found = [info for info in group.listed() if info.name == plain and package in ("", info.distribution)]
    return min(found, key=lambda info: info.distribution != _OURS, default=PluginInfo(plain, "an unknown package", "", ""))


def is_ours(group: Group[Any], name: str) -> bool:
    """Whether a plugin is neuprim's own, so that a bug in it is a bug of neuprim."""
    return origin(group, name).distribution == _OURS


@contextmanager
def reported(group: Group[Any], name: str, folders: Sequence[Path]) -> Iterator[None]:
    """Around a call of a plugin's own code: whatever it raises by mistake becomes a PluginError.

    Errors of neuprim and refusals of a disk pass through, and so does everything from a plugin that is neuprim's own: its bugs keep
    their traceback.

    Args:
        folders: where the traceback is written: to the first of these that can be; if none can, to the system's folder for such files.
            Where that cannot be written to either, the traceback is not hidden.

    Raises:
        PluginError: names the plugin, its package with the version, the error, and the file.
    """
    try:
        yield
    except NeuprimError:
        raise
    except (Exception, SystemExit) as error:
        info = origin(group, name)
        if info.distribution == _OURS or (isinstance(error, OSError) and error.errno in DISK):
            raise
        text = f"{group.kind} {info.name!r} of {info.origin}, neuprim {__version__}\n\n{''.join(traceback.format_exception(error))}"
        path = _written(text, f"{group.kind}-{info.name}", [*folders, Path(tempfile.gettempdir())])
        if path is None:
            raise
        said = ": ".join(part for part in (type(error).__name__, " ".join(str(error).split())) if part)
        raise PluginError(f"{group.kind} {info.name!r} of {info.origin} crashed: {said}; traceback in {path}") from error


def _written(text: str, name: str, folders: Sequence[Path]) -> Path | None:
    """Where the text was written; None if nowhere."""
    stem = f"{re.sub(r'[^A-Za-z0-9_-]+', '_', name)}-{time.strftime('%Y%m%d-%H%M%S')}"
    for folder in folders:
        for number in range(1, 100):  # several in one second
            path = folder / (f"{stem}.txt" if number == 1 else f"{stem}-{number}.txt")
            try:
                folder.mkdir(parents=True, exist_ok=True)
                with open(path, "x", encoding="utf-8", newline="\n") as file:
                    file.write(text)
                return path
            except FileExistsError:
                if not folder.is_dir():
                    break
            except OSError:
                break
    return None
