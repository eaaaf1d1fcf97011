"""What happens when a plugin crashes while it works: one line that names its package, and the traceback in a file."""

from __future__ import annotations

import tempfile
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from neuprim.core.errors import DISK, NeuprimError
from neuprim.plugins.blame import origin_of
from neuprim.plugins.registry import Group, PluginError
from neuprim.plugins.tracebacks import written
from neuprim.version import __version__

__all__ = ["is_ours", "reported"]


def is_ours(group: Group[Any], name: str) -> bool:
    """Whether a plugin is neuprim's own, so that a bug in it is a bug of neuprim."""
    return origin_of(group, name).built_in


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
        info = origin_of(group, name)
        if info.built_in or (isinstance(error, OSError) and error.errno in DISK):
            raise
        text = f"{group.kind} {info.name!r} of {info.origin}, neuprim {__version__}\n\n{''.join(traceback.format_exception(error))}"
        path = written(text, f"{group.kind}-{info.name}", [*folders, Path(tempfile.gettempdir())])
        if path is None:
            raise
        said = ": ".join(part for part in (type(error).__name__, " ".join(str(error).split())) if part)
        raise PluginError(f"{group.kind} {info.name!r} of {info.origin} crashed: {said}; traceback in {path}") from error
