"""Where files lie that several processes and machines make and read: a folder that all of them see, or an object store
by its URL.

A store holds folders of files. A folder counts as there when its last file is: in a file system it is renamed to its
name as a whole, in an object store, where a put is atomic, the last file is put last. So a maker that is killed leaves
nothing that is taken for a whole folder, and of two makers of one folder either may win, as both make the same files.
"""

from __future__ import annotations

import errno
import os
import shutil
import tempfile
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from neuprim.core.errors import DataError
from neuprim.core.io.files import writing

__all__ = ["EVERY", "PATIENCE", "WAITING", "LocalStore", "Store", "Tell", "check_size"]

PATIENCE = 60.0
"""Seconds for a shared folder to come back."""

EVERY = 0.5
"""Seconds between two looks whether it has."""

WAITING = "waiting for"
"""How the line begins that says so."""

_AWAY = (errno.ENOENT, errno.ESTALE, errno.ENOTCONN, errno.EIO)

T = TypeVar("T")
Tell = Callable[[str], None]


class Store(ABC):
    """A place of folders with files.

    Attributes:
        address: folder or URL, for people.
        path: local folder of its files, or of copies of those that were fetched.
    """

    address: str
    path: Path

    @abstractmethod
    def at(self, *names: str) -> Store:
        """The place of that name in it."""

    @abstractmethod
    def begin(self) -> None:
        """Make the place ready to be written to. Raises OSError or DataError."""

    @abstractmethod
    def whole(self, last: str) -> set[str]:
        """Names of the folders in it that have the file ``last``."""

    @abstractmethod
    def has(self, name: str) -> bool:
        """Whether a file is there, by its name with folders, ``"frame_00001/points.npz"``."""

    @abstractmethod
    def fetch(self, name: str, most: int) -> Path:
        """A local file with the contents of that one, which may be missing.

        Args:
            most: bytes; a larger one is refused before it is read.

        Raises:
            DataError: it is larger, or the store cannot be read.
        """

    @abstractmethod
    def publish(self, name: str, write: Callable[[Path], None], last: str) -> None:
        """Have ``write`` fill an empty folder, and give it its name when it is done, unless a whole one is there by
        then.

        Raises:
            OSError, DataError: of ``write``, or the store cannot be written; nothing is there under that name then.
        """

    @abstractmethod
    def put(self, name: str, write: Callable[[Path], None]) -> None:
        """Have ``write`` write one file, which is then there whole, or not at all. Raises OSError or DataError."""

    def patiently(self, call: Callable[[], T], tell: Tell) -> T:
        """What a call returns; where the store is gone meanwhile, it is waited for and the call made again.

        Raises:
            DataError: it did not come back within :data:`PATIENCE` seconds, or as the call.
        """
        return call()


class LocalStore(Store):
    """A folder of a file system, of this machine or shared."""

    def __init__(self, path: Path) -> None:
        self.path, self.address = path, str(path)

    def at(self, *names: str) -> LocalStore:
        return LocalStore(self.path.joinpath(*names))

    def begin(self) -> None:
        self.path.mkdir(parents=True, exist_ok=True)

    def whole(self, last: str) -> set[str]:
        try:
            return {
                entry.name
                for entry in os.scandir(self.path)
                if entry.name[:1] != "." and os.path.isfile(os.path.join(entry.path, last))
            }
        except FileNotFoundError:
            return set()

    def has(self, name: str) -> bool:
        return (self.path / name).is_file()

    def fetch(self, name: str, most: int) -> Path:
        file = self.path / name
        try:
            size = file.stat().st_size
        except OSError:  # whoever reads it says so
            return file
        check_size(str(file), size, most)
        return file

    def publish(self, name: str, write: Callable[[Path], None], last: str) -> None:
        final = self.path / name
        draft = Path(
            tempfile.mkdtemp(prefix=f".{name}-", dir=self.path)
        )  # of a folder that must be there: else it would be a new one
        try:
            draft.chmod(0o755)  # mkdtemp's 0700 would hide a shared folder from its other users
            write(draft)
            if final.exists() and not (final / last).is_file():  # somebody deleted part of it
                shutil.rmtree(final)
            try:
                os.replace(draft, final)
            except OSError:
                if not (final / last).is_file():
                    raise
            for other in self.path.glob(
                f".{name}-*"
            ):  # of makers that were killed, or are slower: what they make is there
                shutil.rmtree(other, ignore_errors=True)
        finally:
            shutil.rmtree(draft, ignore_errors=True)

    def put(self, name: str, write: Callable[[Path], None]) -> None:
        with writing(self.path / name) as draft:
            write(draft)

    def patiently(self, call: Callable[[], T], tell: Tell) -> T:
        again = True
        while True:
            try:
                return call()
            except (OSError, DataError) as error:
                if not self._gone():
                    if not (again and self._fleeting(error)):
                        raise
                    again = False
                    continue
            self._wait(tell)

    def _gone(self) -> bool:
        """Whether it is not there, or does not answer. A mount that is lost has an empty folder in its place, so that
        this asks for what is in it."""
        try:
            return not self.path.is_dir()
        except OSError:
            return True

    def _fleeting(self, error: Exception) -> bool:
        """Whether an error may be of a moment in which it was not there: of a file in it that was not found."""
        cause = error if isinstance(error, OSError) else error.__cause__
        number = cause.errno if isinstance(cause, OSError) else None
        return number in (None, *_AWAY) and str(self.path) in str(error)

    def _wait(self, tell: Tell) -> None:
        late = time.monotonic() + PATIENCE
        tell(f"{WAITING} {self.path}, which is gone")
        while self._gone():
            if time.monotonic() > late:
                raise DataError(
                    f"{self.path}: gone for {PATIENCE:.0f} s while it was in use; expected the folder there again (what it holds is kept)"
                )
            time.sleep(EVERY)


def check_size(file: str, size: int, most: int) -> None:
    """Refuses a file that is larger than what belongs there can be."""
    if size > most:
        raise DataError(f"{file}: {size:,} bytes; expected at most {most:,}")
