"""One process at a time in a run's directory.

An advisory lock of the system on a file in it (``flock``; on Windows ``msvcrt``), by the package filelock. The system
lets go of it when the process ends, however it ends, so that nothing is left to be cleared up after a kill. On shared
folders it holds between machines where their file system has such locks: NFS from version 4 on, CephFS, GPFS, Lustre
mounted with ``flock``.
"""

from __future__ import annotations

import json
import os
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from filelock import FileLock, Timeout

from neuprim.core.errors import ConfigError
from neuprim.core.io.files import remove_leftovers
from neuprim.core.io.plain import load_json

__all__ = ["FILE", "held"]

FILE = ".lock"
"""In the directory, while it is held; it says by whom."""


@contextmanager
def held(directory: Path, what: str = "run") -> Iterator[None]:
    """Inside, nobody else can hold the directory; it is made where it is missing, and gone again if nothing was put
    into it.

    Args:
        what: that the directory is of, for the message.

    Raises:
        ConfigError: another process, or another thread, holds it.
        OSError: the directory cannot be made or written.
    """
    new = not directory.exists()
    directory.mkdir(parents=True, exist_ok=True)
    file = directory / FILE
    lock = FileLock(file)
    try:
        lock.acquire(timeout=0)
    except Timeout:
        raise ConfigError(
            f"{directory}: {_holder(file)} is at work on this {what}; expected that to end first, or another output_dir"
        ) from None
    try:
        with suppress(OSError):  # a note to others; on Windows a locked file takes none
            file.write_text(
                json.dumps({"host": socket.gethostname(), "pid": os.getpid(), "since": time.strftime("%F %T")}),
                encoding="utf-8",
            )
        remove_leftovers(directory)
        yield
    finally:
        with suppress(OSError):
            file.unlink()  # while it is held; who opened it meanwhile sees that it is gone, and makes it anew
        lock.release()
        with suppress(OSError):  # it is not empty
            if new:
                directory.rmdir()


def _holder(file: Path) -> str:
    try:
        data = load_json(file.read_text(encoding="utf-8"))
        return f"process {int(data['pid'])} on {data['host']} (since {data['since']})"
    except (OSError, ValueError, KeyError, TypeError):
        return "another process"
