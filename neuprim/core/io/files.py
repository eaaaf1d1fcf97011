"""Write files and folders atomically (complete or not at all), and find the cache folder."""

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
from typing import TYPE_CHECKING, Any, TypeVar

from neuprim.core.errors import ConfigError, DataError, NeuprimError
from neuprim.core.io.json_reader import load_json

if TYPE_CHECKING:
    import numpy as np

__all__ = ["atomic_path", "cache_directory", "write_json", "write_text"]

T = TypeVar("T")


def cache_directory() -> Path:
    """Return neuprim's cache folder: ``NEUPRIM_CACHE_DIR`` if set, else by the convention of the platform."""
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
    """Yield the path of a temporary file, which replaces ``path`` when the block succeeds."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary: Path | None = None
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.{os.getpid()}.", suffix=".tmp")
        os.close(handle)
        temporary = Path(name)
        yield temporary
        with open(temporary, "r+b") as written:  # Windows flushes only files opened for writing
            os.fsync(written.fileno())
        umask = os.umask(0)
        os.umask(umask)
        temporary.chmod(0o666 & ~umask)  # mkstemp makes private files
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is not None and (error.filename is None or str(error.filename).endswith(".tmp")):
            error.filename = str(path)  # a failed write names no file, or the temporary one
        raise
    finally:
        if temporary is not None:
            temporary.unlink(missing_ok=True)


@contextmanager
def checked_atomic_path(path: Path) -> Iterator[Path]:
    """Yield a temporary file as :func:`atomic_path` does; raise DataError if the folder is missing or writing fails."""
    if not path.parent.is_dir():
        raise DataError(f"{path}: cannot be written (no such folder {path.parent})")
    try:
        with atomic_path(path) as temporary:
            yield temporary
    except OSError as error:
        raise DataError(f"{path}: cannot be written ({error.strerror or error})") from error


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="\n")


def read_json(path: Path, what: str, instead: str) -> Any:
    """Return the content of a JSON file that neuprim wrote; None if the file does not exist.

    Raises DataError if the content is not JSON, or is null. ``what`` (what the file should be) and ``instead`` (what
    the user can do) are parts of the message.
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


def read_json_record(path: Path, what: str, instead: str, version: int, parse: Callable[[Any], T]) -> T | None:
    """Return ``parse(content)`` of a JSON file that neuprim wrote; None if the file does not exist.

    Raises DataError if the field ``format`` is not ``version``, or ``parse`` fails. ``what`` and ``instead`` are as in
    :func:`read_json`.
    """
    data = read_json(path, what, instead)
    if data is None:
        return None
    try:
        if data["format"] != version:
            raise DataError(f"{path}: format is {data['format']!r}, but this neuprim reads {version}; {instead}")
        return parse(data)
    except (KeyError, TypeError, AttributeError, ValueError, OverflowError, ConfigError) as error:
        raise DataError(f"{path}: not {what} ({type(error).__name__}: {error}); {instead}") from error


def write_json(path: Path, value: Any) -> None:
    """Write a value as strict JSON (no NaN) atomically."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def write_npy(path: Path, values: np.ndarray) -> None:
    """Write an array atomically as an .npy file, which ``numpy.load(path, allow_pickle=False)`` reads."""
    import numpy as np

    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        np.save(file, values, allow_pickle=False)


# ---------------------------------------------------------------- files of killed writers

_TEMPORARY = re.compile(r"\..+?\.(?:(?P<pid>\d{1,10})\.)?\w{8}\.tmp|\.neuprim\.(?P<staging>\d{1,10})\.\w{8}")
_DAY = 86400.0


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files and folders that killed processes left in a folder and its direct subfolders.

    The caller must have locked the folder. Files of a process that still runs on this machine stay if they are younger
    than a day.
    """
    subfolders = (p for p in folder.iterdir() if p.name[0] != "." and p.is_dir() and not p.is_symlink())
    for place in (folder, *subfolders):
        for path in place.iterdir():
            match = _TEMPORARY.fullmatch(path.name)
            with suppress(OSError):
                if match is None:
                    continue
                if (
                    _is_file_writer_running(match["pid"] or match["staging"])
                    and time.time() - path.lstat().st_mtime < _DAY
                ):
                    continue
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    path.unlink()


def _is_file_writer_running(number: str | None) -> bool:
    """Return whether another process on this machine has the process ID ``number``; on Windows, always assume so."""
    # Containers reuse numbers. A file with this process's own number is old: the lock's holder has not written yet.
    if number is None or int(number) == os.getpid():
        return False
    if sys.platform == "win32":  # os.kill(pid, 0) would end the process there
        return True
    try:
        os.kill(int(number), 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


# ---------------------------------------------------------------- folders


def publish_folder(final: Path, write: Callable[[Path], None], complete: Callable[[Path], bool]) -> None:
    """Let ``write`` fill a temporary folder, then rename this folder to ``final``; do nothing if ``complete(final)``.

    An incomplete folder at ``final`` is deleted. If several processes publish the same folder, only the files of the
    first process remain. All processes must therefore write the same files.
    """
    if complete(final):
        return
    final.parent.mkdir(parents=True, exist_ok=True)
    fill_folder(final, write, complete)


def fill_folder(final: Path, write: Callable[[Path], None], complete: Callable[[Path], bool]) -> None:
    """Fill and rename a folder as :func:`publish_folder` does, but call ``write`` even if ``final`` is complete.

    ``complete(final)`` is checked only after ``write``. The parent folder of ``final`` must exist.
    """
    draft = Path(tempfile.mkdtemp(prefix=f".{final.name}-", dir=final.parent))
    try:
        draft.chmod(0o755)  # mkdtemp's 0700 would hide a shared folder from its other users
        write(draft)
        if final.exists() and not complete(final):
            shutil.rmtree(final)  # somebody deleted part of it
        try:
            os.replace(draft, final)
        except OSError:
            if not complete(final):
                raise
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def refuse_existing(final: Path, overwrite: bool) -> None:
    """Raise ConfigError if ``final`` is a file or a non-empty folder, unless ``overwrite`` is True."""
    if overwrite or not os.path.lexists(final):
        return
    if not final.is_dir():
        raise ConfigError(f"{final}: already exists; pass --force to replace it, or --out PATH to write elsewhere")
    if any(final.iterdir()):
        remedy = "pass --force to replace files of the same name, or --out PATH to write elsewhere"
        raise ConfigError(f"{final}: exists and is not empty; {remedy}")


class StagedOutput:
    """A temporary folder for an output: write to ``out``, then :meth:`publish` moves the output to ``final``."""

    def __init__(self, folder: Path, final: Path, overwrite: bool) -> None:
        self._folder, self._final, self._overwrite = folder, final, overwrite
        self.out = folder / (final.name if final.name not in ("", "..") else "out")

    def final_path(self, path: Path) -> Path | None:
        """Return the final path of a file in the temporary folder; None for a file outside of it."""
        try:
            parts = path.resolve().relative_to(self._folder.resolve()).parts
        except ValueError:
            return None
        if not parts:
            return None
        return self._final.joinpath(*parts[1:]) if parts[0] == self.out.name else self._final.parent.joinpath(*parts)

    def final_text(self, text: str) -> str:
        """Return a text with all temporary paths replaced by final paths."""
        return text.replace(str(self.out), str(self._final)).replace(str(self._folder), str(self._final.parent))

    def publish(self) -> None:
        """Move all files to their final paths.

        Unless ``overwrite``, raise ConfigError before the first move if a final path exists.
        """
        moves: list[tuple[Path, Path]] = []
        for entry in sorted(self._folder.iterdir()):
            target = self.final_path(entry)
            assert target is not None
            merge = entry.is_dir() and target.is_dir()
            sources = [p for p in sorted(entry.rglob("*")) if not p.is_dir()] if merge else [entry]
            moves += [(source, target / source.relative_to(entry)) for source in sources]
        for source, target in moves:
            refuse_existing(target, self._overwrite)
            if os.path.lexists(target) and source.is_dir() != target.is_dir():
                actual, wanted = ("folder", "file") if target.is_dir() else ("file", "folder")
                raise ConfigError(f"{target}: is a {actual}; expected a {wanted}, or a path that does not exist")
        for source, target in moves:
            target.parent.mkdir(parents=True, exist_ok=True)
            os.replace(source, target)


@contextmanager
def staged_output(final: Path, overwrite: bool) -> Iterator[StagedOutput]:
    """Yield a :class:`StagedOutput` whose temporary folder is deleted after the block.

    The block must call :meth:`StagedOutput.publish`. In the messages of errors raised in the block, paths of temporary
    files are replaced by the final paths.
    """
    existing = final if final.is_dir() else next(p for p in (*final.parents, Path(".")) if p.exists())
    try:
        folder = Path(tempfile.mkdtemp(prefix=f".neuprim.{os.getpid()}.", dir=existing))
    except OSError as error:
        error.filename = str(final)  # the user does not know the temporary name
        raise
    output = StagedOutput(folder, final, overwrite)
    try:
        yield output
    except NeuprimError as error:
        error.args = tuple(output.final_text(part) if isinstance(part, str) else part for part in error.args)
        raise
    except OSError as error:
        if isinstance(error.filename, str | Path):
            error.filename = output.final_text(str(error.filename))
        raise
    finally:
        shutil.rmtree(folder, ignore_errors=True)
