"""Reading bytes of an untrusted file: every length is checked against what is left before anything is allocated."""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from neuprim.core.errors import BackendUnavailable, DataError

__all__ = ["BLOSC", "MASK", "ZIP", "Cursor", "blosc_module", "compression_label", "opened", "unpacker"]

ZIP, MASK, BLOSC = 1, 2, 4
"""The bits of a grid's compression word."""

_BLOSC_HEADER = struct.Struct("<4xI4xI")
"""Of a Blosc chunk's 16 bytes: how many bytes it unpacks to, and how many it has."""


class Cursor:
    """A position in a file's bytes that cannot leave them.

    Attributes:
        path: the file, for messages.
        data: all bytes of the file.
        at, end: the next byte, and the first one that must not be read.
    """

    __slots__ = ("at", "data", "end", "path")

    def __init__(self, path: Path, data: bytes | mmap.mmap, at: int = 0, end: int | None = None) -> None:
        self.path, self.data, self.at = path, data, at
        self.end = len(data) if end is None else end

    def fail(self, text: str) -> DataError:
        """The error to raise for something wrong at or before this place."""
        return DataError(f"{self.path}: {text}")

    def need(self, count: int, what: str) -> None:
        """Raises DataError unless ``count`` more bytes are there."""
        if not 0 <= count <= self.end - self.at:
            raise self.fail(
                f"{what} at byte {self.at} needs {count} bytes, but {self.end - self.at} are left there; truncated or damaged OpenVDB file"
            )

    def take(self, count: int, what: str) -> bytes:
        self.need(count, what)
        self.at += count
        return self.data[self.at - count : self.at]

    def skip(self, count: int, what: str) -> None:
        self.need(count, what)
        self.at += count

    def unpack(self, layout: str, what: str) -> tuple[Any, ...]:
        """Little-endian values without padding, as in :mod:`struct`."""
        return struct.unpack("<" + layout, self.take(struct.calcsize("<" + layout), what))

    def text(self, what: str) -> str:
        """A length (uint32) and so many bytes of UTF-8; bytes that are not become U+FFFD."""
        (length,) = self.unpack("I", f"length of {what}")
        return self.take(length, what).decode("utf-8", errors="replace")


@contextmanager
def opened(path: Path) -> Iterator[Cursor]:
    """A cursor at the start of a file, which is mapped rather than read.

    Raises:
        DataError: missing, empty, not a file, or not readable.
    """
    if not path.exists():
        raise DataError(f"{path}: file not found; expected an OpenVDB file")
    if not path.is_file():
        raise DataError(f"{path}: not a file; expected an OpenVDB file")
    try:
        with open(path, "rb") as file:
            if not file.read(1):
                raise DataError(f"{path}: file is empty; expected an OpenVDB file")
            data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error}); expected an OpenVDB file") from None
    with data:
        yield Cursor(path, data)


def compression_label(flags: int) -> str:
    """The words OpenVDB itself uses, for example ``blosc + active values``."""
    codec = "blosc" if flags & BLOSC else "zip" if flags & ZIP else ""
    return " + ".join(word for word in (codec, "active values" if flags & MASK else "") if word) or "none"


def blosc_module() -> Any:
    """The package ``blosc``, set to one thread.

    OpenVDB packs leaves in blocks of 256 bytes; with more threads every leaf of 2 KB would start and join them all.

    Raises:
        BackendUnavailable: it is not installed.
    """
    try:
        import blosc
    except ImportError as error:
        raise BackendUnavailable(
            f"Blosc-compressed OpenVDB files need the package blosc ({error}): pip install blosc"
        ) from None
    blosc.set_nthreads(1)
    return blosc


def unpacker(flags: int) -> Callable[[bytes, int], bytes]:
    """The function (chunk, size) -> bytes that undoes a grid's compression; it never makes more than ``size`` bytes.

    It raises ValueError, with a text that says what is wrong, for damaged chunks and for any other size.
    """
    if not flags & BLOSC:
        return _unzip
    blosc = blosc_module()
    decompress, sizes = blosc.decompress, _BLOSC_HEADER.unpack_from

    def unblosc(chunk: bytes, size: int) -> bytes:
        if len(chunk) < 16:
            raise ValueError(f"a Blosc chunk of {len(chunk)} bytes; expected at least 16")
        claimed, length = sizes(chunk)
        if claimed != size or length != len(chunk):  # also what keeps the library from allocating gigabytes
            raise ValueError(f"a Blosc chunk of {length} bytes for {claimed}; expected {len(chunk)} bytes for {size}")
        if not size:
            return b""
        try:
            values: bytes = decompress(chunk)
        except MemoryError:
            raise
        except Exception as error:  # the extension has an error class of its own
            raise ValueError(f"a damaged Blosc chunk ({error})") from None
        if len(values) != size:
            raise ValueError(f"a Blosc chunk of {len(values)} bytes; expected {size}")
        return values

    return unblosc


def _unzip(chunk: bytes, size: int) -> bytes:
    try:
        values = zlib.decompressobj().decompress(chunk, size + 1)
    except zlib.error as error:
        raise ValueError(f"a damaged zip chunk ({error})") from None
    if len(values) != size:
        raise ValueError(
            f"a zip chunk of {'more than ' * (len(values) > size)}{min(len(values), size)} bytes; expected {size}"
        )
    return values
