"""A run's directory: the lock that keeps other processes out, and the files that the end of a run writes."""

from __future__ import annotations

import json
import os
import re
import socket
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from neuprim.core.errors import ConfigError
from neuprim.core.io.files import remove_leftovers
from neuprim.core.io.plain import load_json

LOCK_FILE = ".lock"
"""In the directory while it is locked; it names the process."""


@contextmanager
def lock_run_directory(directory: Path, what: str = "run") -> Iterator[None]:
    """Lock a directory, so that one process at a time works in it. It is made if it is missing, and removed again if it
    is left empty.

    The lock is an advisory lock of the system (``flock``; on Windows ``msvcrt``), which ends with its process. On
    shared folders it works between machines where their file system has such locks: NFS from version 4 on, CephFS,
    GPFS, Lustre mounted with ``flock``.

    Args:
        what: is in the directory, for the message.

    Raises:
        ConfigError: another process, or another thread, holds it.
        OSError: the directory cannot be made or written.
    """
    new = not directory.exists()
    directory.mkdir(parents=True, exist_ok=True)
    file = directory / LOCK_FILE
    lock = FileLock(file)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ConfigError(
            f"{directory}: {_describe_lock_holder(file)} is at work on this {what}; expected that to end first, or "
            f"another output_dir"
        ) from None
    owner = {"host": socket.gethostname(), "pid": os.getpid(), "since": time.strftime("%F %T")}
    try:
        with suppress(OSError):  # a note for others; on Windows a locked file cannot be written
            file.write_text(json.dumps(owner), encoding="utf-8")
        remove_leftovers(directory)
        yield
    finally:
        with suppress(OSError):
            # while it is locked: a process that opened it meanwhile sees that it is gone and makes a new one
            file.unlink()
        lock.release()
        with suppress(OSError):  # not empty
            if new:
                directory.rmdir()


def _describe_lock_holder(file: Path) -> str:
    try:
        data = load_json(file.read_text(encoding="utf-8"))
        return f"process {int(data['pid'])} on {data['host']} (since {data['since']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"


# ------------------------------------------------------------ results

_RESULT_FILES = ("metrics.json", "report.html", "viewer.html")
_RESULT_PICTURES = re.compile(r"test_\d{3,}_.*\.png|clip_.*\.webp|orbit\.webp|worst(_\d{3,}\.png|\.json)")


def result_files(run_dir: Path) -> list[Path]:
    """List the files that the end of a run wrote: metrics, pictures and report; not what other commands drew into
    ``renders/``."""
    pictures = (path for path in sorted((run_dir / "renders").glob("*")) if _RESULT_PICTURES.fullmatch(path.name))
    return [*(path for name in _RESULT_FILES if (path := run_dir / name).is_file()), *pictures]


def discard_results(run_dir: Path) -> None:
    """Remove the results. A run that resumes does so before its model changes, so that a kill never leaves numbers of
    another model."""
    for path in result_files(run_dir):
        path.unlink(missing_ok=True)


def refuse_run_results(run_dir: Path, targets: Iterable[Path]) -> None:
    """Raise ConfigError if a command would write over one of them."""
    own = {path.resolve() for path in result_files(run_dir)}
    for target in targets:
        if target.resolve() in own:
            raise ConfigError(
                f"{target}: is a picture of the run's report; --force replaces it, --out PATH writes elsewhere"
            )
