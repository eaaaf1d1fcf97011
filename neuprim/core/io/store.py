"""Storage that several processes and machines share: a local or mounted folder, or an object store with a URL.

A subfolder counts as complete when it has the file that is written last. An interrupted write therefore never looks
complete. Two processes may write the same subfolder, because both processes write the same files.
"""

from __future__ import annotations

import errno
import hashlib
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

from neuprim.core.errors import BackendUnavailable, ConfigError, DataError, NeuprimError, cut_error_text
from neuprim.core.io.files import atomic_path, checked_atomic_path, fill_folder

MAX_WAIT = 60.0  # seconds to wait for a shared folder that disappeared
POLL_INTERVAL = 0.5  # seconds between two checks whether it is back
WAIT_MESSAGE = "waiting for"  # start of the line that says so
_DISAPPEARED = (errno.ENOENT, errno.ESTALE, errno.ENOTCONN, errno.EIO)
_BUCKETS = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "adl", "oss")
PROTOCOLS = ("file", "local", "memory", *_BUCKETS)  # fsspec's others run commands, open archives or chain stores

T = TypeVar("T")


def open_store(address: str, copies: Path) -> Store:
    """Open the store at ``address``, a path or a URL. Files of an object store are copied to the folder ``copies``.

    Raises ConfigError, BackendUnavailable (the package for this protocol is missing) or DataError.
    """
    protocol, is_url, path = address.partition("://")
    if "::" in address or (is_url and protocol not in PROTOCOLS):
        what = "chained protocols (::)" if "::" in address else f"unsupported protocol {cut_error_text(protocol)!r}"
        expected = f"a folder, or a URL of {', '.join(PROTOCOLS)}, such as s3://BUCKET/FOLDER"
        raise ConfigError(f"{cut_error_text(address)}: {what}; expected {expected}")
    if not is_url:
        return Store.local(Path(address).expanduser().absolute())
    if protocol in ("file", "local"):
        return Store.local(Path(path).absolute())
    import fsspec

    try:
        system, root = fsspec.core.url_to_fs(address)
    except ImportError as error:
        extra = ": pip install 'neuprim[s3]'" if protocol in ("s3", "s3a") else ""
        what = f"{protocol}:// needs a package that is not installed ({_store_error_line(error)}){extra}"
        raise BackendUnavailable(f"{address}: {what}") from None
    except ValueError as error:
        expected = "a folder or a URL that fsspec knows, such as s3://BUCKET/FOLDER"
        raise ConfigError(f"{address}: {_store_error_line(error)}; expected {expected}") from None
    except Exception as error:
        raise DataError(f"{address}: cannot be reached ({_store_error_line(error)})") from error
    digest = hashlib.sha256(address.rstrip("/").encode()).hexdigest()[:16]
    return Store(address.rstrip("/"), copies / digest, system, root.rstrip("/"))


class Store:
    """A shared folder ``path``, or the folder ``root`` of an object store, whose files are copied to ``path``.

    ``system`` is the fsspec client of the object store; None for a shared folder. Stored files are never changed.
    """

    def __init__(self, address: str, path: Path, system: Any = None, root: str = "") -> None:
        self.address, self.path, self._system, self._root = address, path, system, root

    @classmethod
    def local(cls, path: Path) -> Store:
        """Return the store in a folder of a local or mounted file system."""
        return cls(str(path), path)

    @property
    def is_local(self) -> bool:
        return self._system is None

    def at(self, *names: str) -> Store:
        """Return the store in the subfolder ``names`` of this store."""
        path, below = self.path.joinpath(*names), "/".join(names)
        if self.is_local:
            return Store.local(path)
        return Store(f"{self.address}/{below}", path, self._system, f"{self._root}/{below}")

    def prepare(self) -> None:
        """Create the folder of the store if it does not exist. Raises OSError or DataError."""
        if self.is_local:
            self.path.mkdir(parents=True, exist_ok=True)
        elif self.address.partition("://")[0] not in _BUCKETS:  # buckets have no folders; a typo must not create one
            with self._client_errors("written"):
                self._system.makedirs(self._root, exist_ok=True)

    def complete_folders(self, last: str) -> set[str]:
        """Return the names of the complete subfolders, which contain the file ``last``; this file is written last."""
        if not self.is_local:
            with self._client_errors("read"):
                self._system.invalidate_cache()
                files = self._system.glob(f"{self._root}/*/{last}")
            return {str(name).rstrip("/").split("/")[-2] for name in files}
        try:
            entries = list(os.scandir(self.path))
        except FileNotFoundError:
            return set()
        return {e.name for e in entries if e.name[:1] != "." and os.path.isfile(os.path.join(e.path, last))}

    def has_file(self, name: str) -> bool:
        """Return whether the store has the file ``name``, such as ``"frame_00001/points.npz"``."""
        if self.is_local:
            return (self.path / name).is_file()
        with self._client_errors("read"):
            self._system.invalidate_cache()
            return bool(self._system.exists(f"{self._root}/{name}"))

    def fetch_file(self, name: str, max_bytes: int) -> Path:
        """Return a local path of the file ``name``. If the store has no such file, nothing exists at the path.

        Files of an object store are copied first. Raises DataError if the store cannot be read, or if the file has more
        than ``max_bytes``.
        """
        file = self.path / name
        if self.is_local:
            try:
                size = file.stat().st_size
            except OSError:  # the caller, who reads the file, reports it
                return file
            _check_file_size(str(file), size, max_bytes)
            return file
        if file.is_file():
            return file
        remote = f"{self._root}/{name}"
        with self._client_errors("read"):
            if self._system.exists(remote):
                _check_file_size(f"{self.address}/{name}", int(self._system.size(remote)), max_bytes)
                with atomic_path(file) as draft:
                    self._system.get_file(remote, str(draft))
        return file

    def write_folder(self, name: str, write: Callable[[Path], None], last: str) -> None:
        """Let ``write`` fill a temporary folder, and store it as the subfolder ``name``.

        A subfolder on disk that already contains ``last`` is kept. An object store gets the file ``last`` after all
        other files.
        """
        if self.is_local:  # the store's folder must exist: creating a lost mount would hide it
            if (self.path / name / last).is_file():
                return  # a faster process stored it, and removed the draft of this one
            fill_folder(self.path / name, write, lambda folder: (folder / last).is_file())
            for draft in self.path.glob(f".{name}-*"):  # of killed or slower processes
                shutil.rmtree(draft, ignore_errors=True)
            return
        with tempfile.TemporaryDirectory(prefix="neuprim-") as folder:
            write(Path(folder))
            files = sorted(file.name for file in Path(folder).iterdir() if file.name != last)
            with self._client_errors("written"):
                for file in (*files, last):
                    self._system.put_file(str(Path(folder) / file), f"{self._root}/{name}/{file}")

    def write_file(self, name: str, write: Callable[[Path], None]) -> None:
        """Let ``write`` write one file, and store it atomically as ``name``. Raises OSError or DataError."""
        if self.is_local:
            with checked_atomic_path(self.path / name) as draft:
                write(draft)
            return
        with tempfile.TemporaryDirectory(prefix="neuprim-") as folder:
            write(Path(folder) / "file")
            with self._client_errors("written"):
                self._system.put_file(str(Path(folder) / "file"), f"{self._root}/{name}")

    def retry(self, call: Callable[[], T], notify: Callable[[str], None]) -> T:
        """Return what ``call`` returns. If a local store disappears during the call, wait for the store and call again.

        ``notify`` is called with a line of text before waiting. Raises DataError if the store is unavailable for
        :data:`MAX_WAIT` seconds. Other errors are raised again.
        """
        second_try = True
        while True:
            try:
                return call()
            except (OSError, DataError) as error:
                if not self.is_local:
                    raise
                if not self._is_gone():
                    if not (second_try and self._may_be_transient(error)):
                        raise
                    second_try = False
                    continue
            self._wait(notify)

    def _is_gone(self) -> bool:
        """Return whether the store's folder is missing (as in a lost mount) or does not answer."""
        try:
            return not self.path.is_dir()
        except OSError:
            return True

    def _may_be_transient(self, error: Exception) -> bool:
        """Return whether ``error`` may come from a short loss of the store's folder, such as "file not found"."""
        cause = error if isinstance(error, OSError) else error.__cause__
        number = cause.errno if isinstance(cause, OSError) else None
        return number in (None, *_DISAPPEARED) and str(self.path) in str(error)

    def _wait(self, notify: Callable[[str], None]) -> None:
        deadline = time.monotonic() + MAX_WAIT
        notify(f"{WAIT_MESSAGE} {self.path}, which is gone")
        while self._is_gone():
            if time.monotonic() > deadline:
                found = f"the folder disappeared and was missing for {MAX_WAIT:.0f} s"
                raise DataError(
                    f"{self.path}: {found}; make it available again, and repeat the command (finished files are kept)"
                )
            time.sleep(POLL_INTERVAL)

    @contextmanager
    def _client_errors(self, action: str) -> Iterator[None]:
        """Convert errors of the object store's client in the block to the DataError "cannot be ``action``"."""
        try:
            yield
        except NeuprimError:
            raise
        except Exception as error:
            raise DataError(f"{self.address}: cannot be {action} ({_store_error_line(error)})") from error


def _check_file_size(file: str, size: int, max_bytes: int) -> None:
    if size > max_bytes:
        raise DataError(f"{file}: the file has {size:,} bytes; expected at most {max_bytes:,}")


def _store_error_line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
