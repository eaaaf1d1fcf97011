"""Where things are kept, and writes that either happen whole or not at all."""

from __future__ import annotations

import json
import os
import re
import shutil
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

from neuprim.core.errors import DataError
from neuprim.core.io.plain import load_json

if TYPE_CHECKING:
    import numpy as np

__all__ = [
    "atomic_path",
    "cache_directory",
    "publish_folder",
    "read_json",
    "remove_left",
    "write_json",
    "write_npy",
    "write_text",
    "writing",
]


def cache_directory() -> Path:
    """The user's cache folder for this project; ``NEUPRIM_CACHE_DIR`` overrides the platform's convention."""
    if os.environ.get("NEUPRIM_CACHE_DIR"):
        return Path(os.environ["NEUPRIM_CACHE_DIR"])
    if sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local"))
    elif sys.platform == "darwin":
        base = Path.home() / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache"))
    return base / "neuprim"


@contextmanager
def atomic_path(path: Path) -> Iterator[Path]:
    """A temporary file beside ``path`` that replaces it when the block ends well; the old file survives any failure.

    Raises:
        OSError: it cannot be written, as on a full disk; names ``path``.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary: Path | None = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.{os.getpid()}.", suffix=".tmp")
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with open(temporary, "r+b") as written:  # Windows flushes only what may be written
            os.fsync(written.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp makes private files
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is not None and (error.filename is None or str(error.filename).endswith(".tmp")):
            error.filename = str(path)  # of a failed write there is no name, and nobody knows the temporary one
        raise
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


def remove_left(folder: Path) -> None:
    """Remove the temporary files and drafts of writers that were killed, from a folder and those in it; for whoever
    holds its lock.

    A writer of this machine that is at work keeps its files, any for a day.
    """
    for place in (
        folder,
        *(path for path in folder.iterdir() if path.name[0] != "." and path.is_dir() and not path.is_symlink()),
    ):
        for path in place.iterdir():
            match = _TEMPORARY.fullmatch(path.name)
            with suppress(OSError):
                if match is None or (
                    _works(match["pid"] or match["draft"]) and time.time() - path.lstat().st_mtime < _DAY
                ):
                    continue
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink()


_TEMPORARY = re.compile(r"\..+?\.(?:(?P<pid>\d{1,10})\.)?\w{8}\.tmp|\.neuprim\.(?P<draft>\d{1,10})\.\w{8}")
_DAY = 86400.0


def _works(number: str | None) -> bool:
    """Whether another process of this machine has that number."""
    if (
        number is None or int(number) == os.getpid()
    ):  # in a container numbers come again: whoever asks holds the lock, and writes nothing yet
        return False
    if sys.platform == "win32":  # where this question would end it
        return True
    try:
        os.kill(int(number), 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


@contextmanager
def writing(path: Path) -> Iterator[Path]:
    """:func:`atomic_path` in a folder that exists, with the file's errors as DataError."""
    if not path.parent.is_dir():
        raise DataError(f"{path}: cannot be written (no such folder {path.parent})")
    try:
        with atomic_path(path) as temporary:
            yield temporary
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror or error})") from error


def publish_folder(final: Path, write: Callable[[Path], None], complete: Callable[[Path], bool]) -> None:
    """Have ``write`` fill a folder that gets the name ``final`` only when it is done, unless a complete one is there.

    An interrupted run leaves nothing behind. Of several processes at once the first one wins, so all must write the
    same files.

    Args:
        write: fills the empty folder that it is given.
        complete: whether nothing is missing from a folder; what lies at ``final`` and is not complete is deleted.

    Raises:
        OSError: the folder's place cannot be written.
    """
    if complete(final):
        return
    final.parent.mkdir(parents=True, exist_ok=True)
    draft = Path(tempfile.mkdtemp(prefix=f".{final.name}-", dir=final.parent))
    try:
        draft.chmod(0o755)  # mkdtemp's 0700 would hide a shared cache from its other users
        write(draft)
        if final.exists() and not complete(final):
            shutil.rmtree(final)  # somebody deleted part of it
        try:
            draft.rename(final)
        except OSError:
            if not complete(final):
                raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def read_json(path: Path, what: str, instead: str) -> Any:
    """What a JSON file of ours holds; None where there is no file.

    Args:
        what, instead: for the message: what the file turned out not to be, and what the user can do.

    Raises:
        DataError: it cannot be read, or is no JSON.
    """
    try:
        data = load_json(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path}: not {what} ({error}); {instead}") from error
    if data is None:
        raise DataError(f"{path}: not {what} (it holds null); {instead}")
    return data


def write_json(path: Path, value: Any) -> None:
    """Write strict JSON (no NaN) atomically."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def write_npy(path: Path, values: np.ndarray) -> None:
    """Write an array as ``numpy.load(path, allow_pickle=False)`` reads it, atomically."""
    import numpy as np

    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.save(file, values, allow_pickle=False)
