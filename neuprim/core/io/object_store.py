"""Stores by their address: a folder as it is, object stores and whatever else has a URL by fsspec."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from neuprim.core.errors import BackendUnavailable, ConfigError, DataError, NeuprimError, cut
from neuprim.core.io.files import atomic_path
from neuprim.core.io.store import LocalStore, Store, check_size

__all__ = ["ObjectStore", "is_url", "store_at"]

_BUCKETS = ("s3", "s3a", "gs", "gcs", "az", "abfs", "abfss", "adl", "oss")
_LOCAL = ("file://", "local://")
PROTOCOLS = ("file", "local", "memory", *_BUCKETS)
"""Those that an address may have. Rule: what fsspec knows beyond these runs commands, opens archives or goes through
other stores."""


def is_url(address: str) -> bool:
    """Whether it is more than a path: ``s3://BUCKET/FOLDER``, ``memory://NAME``, ``file:///FOLDER``."""
    return "://" in address or "::" in address


def store_at(address: str, copies: Path) -> Store:
    """The store at a folder's path or a URL.

    Args:
        copies: local folder for copies of what is fetched from another place.

    Raises:
        ConfigError: none of :data:`PROTOCOLS`, or several in a chain.
        BackendUnavailable: its package is not installed.
    """
    protocol = address.partition("://")[0]
    if is_url(address) and ("::" in address or protocol not in PROTOCOLS):
        found = "a chain of protocols" if "::" in address else f"protocol {cut(protocol)!r}"
        raise ConfigError(
            f"{cut(address)}: {found}; expected a folder, or a URL of {', '.join(PROTOCOLS)}, as s3://BUCKET/FOLDER"
        )
    for start in _LOCAL:
        if address.startswith(start):
            return LocalStore(Path(address.removeprefix(start)).absolute())
    if not is_url(address):
        return LocalStore(Path(address).expanduser().absolute())
    import fsspec

    try:
        system, root = fsspec.core.url_to_fs(address)
    except ImportError as error:
        extra = ": pip install 'neuprim[s3]'" if protocol in ("s3", "s3a") else ""
        raise BackendUnavailable(
            f"{address}: {protocol}:// needs a package that is not installed ({_line(error)}){extra}"
        ) from None
    except ValueError as error:
        raise ConfigError(
            f"{address}: {_line(error)}; expected a folder or a URL that fsspec knows, as s3://BUCKET/FOLDER"
        ) from None
    except Exception as error:
        raise DataError(f"{address}: cannot be reached ({_line(error)})") from error
    own = hashlib.sha256(address.rstrip("/").encode()).hexdigest()[:16]
    return ObjectStore(address.rstrip("/"), system, root.rstrip("/"), copies / own)


class ObjectStore(Store):
    """A place that fsspec reaches, with local copies of what was fetched. What lies there under a name never changes,
    so copies stay good.

    Args:
        system: of fsspec. root: the place in it. path: folder for copies.
    """

    def __init__(self, address: str, system: Any, root: str, path: Path) -> None:
        self.address, self.path, self._system, self._root = address, path, system, root

    def at(self, *names: str) -> ObjectStore:
        more = "/".join(names)
        return ObjectStore(f"{self.address}/{more}", self._system, f"{self._root}/{more}", self.path.joinpath(*names))

    def begin(self) -> None:
        if (
            self.address.partition("://")[0] in _BUCKETS
        ):  # they have no folders, and a bucket is not made for a typing error
            return
        with self._said("written"):
            self._system.makedirs(self._root, exist_ok=True)

    def whole(self, last: str) -> set[str]:
        with self._said("read"):
            self._system.invalidate_cache()
            found = self._system.glob(f"{self._root}/*/{last}")
        return {str(name).rstrip("/").split("/")[-2] for name in found}

    def has(self, name: str) -> bool:
        with self._said("read"):
            self._system.invalidate_cache()
            return bool(self._system.exists(f"{self._root}/{name}"))

    def fetch(self, name: str, most: int) -> Path:
        copy = self.path / name
        if copy.is_file():
            return copy
        place = f"{self._root}/{name}"
        with self._said("read"):
            if not self._system.exists(place):
                return copy  # whoever reads it says so
            check_size(f"{self.address}/{name}", int(self._system.size(place)), most)
            with atomic_path(copy) as draft:
                self._system.get_file(place, str(draft))
        return copy

    def publish(self, name: str, write: Callable[[Path], None], last: str) -> None:
        with tempfile.TemporaryDirectory(prefix="neuprim-") as folder:
            write(Path(folder))
            files = sorted(file.name for file in Path(folder).iterdir() if file.name != last)
            with self._said("written"):
                for file in (*files, last):
                    self._system.put_file(str(Path(folder) / file), f"{self._root}/{name}/{file}")

    def put(self, name: str, write: Callable[[Path], None]) -> None:
        with tempfile.TemporaryDirectory(prefix="neuprim-") as folder:
            write(Path(folder) / "file")
            with self._said("written"):
                self._system.put_file(str(Path(folder) / "file"), f"{self._root}/{name}")

    @contextmanager
    def _said(self, what: str) -> Iterator[None]:
        """Errors of any client's own kinds as ours."""
        try:
            yield
        except NeuprimError:
            raise
        except Exception as error:
            raise DataError(f"{self.address}: cannot be {what} ({_line(error)})") from error


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
