"""The file ``.neuprim``: a JSON header, a table of sections, their bytes through zstd. Little-endian;
docs/data_formats.md has every byte.

For files of strangers: nothing is executed, every size is compared with the file's true one and with what the counts
allow before memory is taken, and a file stands for numbers of at most :data:`MOST_TIMES` its own size.
"""

from __future__ import annotations

import io
import json
import struct
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import zstandard
from torch import Tensor

from neuprim.core.compression.packing import packed_planes
from neuprim.core.compression.sections import (
    CODINGS,
    MOST_TEXT,
    POSITIONS,
    ROTATIONS,
    ROWS,
    ROWS_NAME,
    TEXT,
    Damaged,
    Section,
    content_size,
    unpack,
    unpack_rows,
)
from neuprim.core.errors import CheckpointError
from neuprim.core.io.files import atomic_path
from neuprim.core.io.plain import load_json

__all__ = [
    "CONFIG",
    "MAGIC",
    "MOST_TIMES",
    "VERSION",
    "is_compressed",
    "read_compressed",
    "read_head",
    "write_compressed",
]

MAGIC = b"\x89NEUPRIM"
VERSION = 1
CONFIG = "config.yaml"
"""Name of the one text: the configuration of the run."""

MOST_TIMES = 64
"""Bytes in float32 for each byte of the file, beyond the first MiB of them."""

_PLAIN, _ZSTD = 0, 1
_MOST_PLANES = 3  # of a column's codes
_START = struct.Struct("<IIQIII")  # version, sections, primitives, bytes of header and table, their check sum
_SIZES = struct.Struct("<QQI")
_MOST_HEADER, _MOST_TABLE = 2**22, 2**20  # bytes
_MOST_MASKS = 2**16 - 1
_MOST_SECTIONS, _MOST_DIMENSIONS, _MOST_COLUMNS, _MOST_PRIMITIVES = 4096, 4, 2**20, 2**31


@dataclass(frozen=True)
class _Entry:
    """A row of the table: a section without its bytes; those of its planes, how they are stored, the bytes of it all,
    and their check sum."""

    section: Section
    content: int
    packing: int
    stored: int
    checksum: int


@dataclass(frozen=True)
class _Head:
    header: dict[str, Any]
    count: int
    entries: list[_Entry]


# ---------------------------------------------------------------- writing


def write_compressed(path: Path, header: Mapping[str, Any], count: int, sections: Sequence[Section]) -> dict[str, int]:
    """Write a file whole or not at all; returns the bytes that each section takes in it.

    Args:
        header: JSON-able.
        count: primitives.
        sections: of which every one has its own name.

    Raises:
        CheckpointError: the file could not be written; names it and the reason.
    """
    text = json.dumps(header, allow_nan=False).encode()
    if len(text) > _MOST_HEADER:
        raise CheckpointError(f"{path}: the header has {len(text)} bytes; at most {_MOST_HEADER} can be stored")
    if any(s.coding == TEXT and sum(map(len, s.planes)) > MOST_TEXT for s in sections):
        raise CheckpointError(f"{path}: {CONFIG} has more than {MOST_TEXT} bytes, which is the most that can be stored")
    for s in sections:
        if len(s.name.encode()) > 255 or len(s.shape) > _MOST_DIMENSIONS or max(*s.shape, s.columns, 0) > _MOST_COLUMNS:
            limits = f"a name of 255 bytes, {_MOST_DIMENSIONS} dimensions and {_MOST_COLUMNS} numbers"
            raise CheckpointError(
                f"{path}: parameter {s.name!r} of shape {s.shape} cannot be stored; at most {limits} can be"
            )
    plain = [b"".join(s.planes) for s in sections]
    packed = [packed_planes(s.planes) for s in sections]
    numbers = count * sum(s.columns for s in sections if s.coding != TEXT)
    for i in sorted(range(len(sections)), key=lambda i: len(plain[i]) - len(packed[i])):
        if _allowed(numbers, sum(map(len, packed))):
            break
        packed[i] = plain[i]  # a model of next to nothing, such as all zeros, would look like a bomb
    packings = [_PLAIN if len(a) == len(b) else _ZSTD for a, b in zip(packed, plain, strict=True)]
    stored = [s.head + data for s, data in zip(sections, packed, strict=True)]
    rows = zip(sections, packings, plain, stored, strict=True)
    table = b"".join(_entry(section, packing, len(content), data) for section, packing, content, data in rows)
    start = _START.pack(VERSION, len(sections), count, len(text), len(table), 0)[:-4]
    try:
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            file.write(MAGIC + start + struct.pack("<I", zlib.crc32(start + text + table)) + text + table)
            file.writelines(stored)
    except OSError as error:
        raise CheckpointError(
            f"{path}: could not write the model: {error}; the previous one, if any, is untouched"
        ) from error
    return {s.name: len(data) for s, data in zip(sections, stored, strict=True)}


def _entry(section: Section, packing: int, content: int, data: bytes) -> bytes:
    name = section.name.encode()
    dimensions = struct.pack(f"<BBB{len(section.shape)}I", section.coding, packing, len(section.shape), *section.shape)
    return bytes([len(name)]) + name + dimensions + _SIZES.pack(content, len(data), zlib.crc32(data))


def _allowed(numbers: int, size: int) -> bool:
    return 4 * numbers <= 2**20 + MOST_TIMES * size


# ---------------------------------------------------------------- reading


def is_compressed(path: Path) -> bool:
    """Whether the file begins as such a file does, whatever its name is."""
    try:
        with open(path, "rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def read_head(path: Path) -> dict[str, Any]:
    """The header; no section is read.

    Raises:
        CheckpointError: missing, damaged, foreign, of another version, or of sizes that cannot be.
    """
    with _opened(path) as file:
        return _head(path, file).header


def read_compressed(path: Path) -> tuple[dict[str, Any], dict[str, Tensor], str | None]:
    """Header, float32 tensors by name and the run's configuration, where the file has it.

    Raises:
        CheckpointError: see :func:`read_head`; or a section is damaged.
    """
    with _opened(path) as file:
        head = _head(path, file)
        tensors: dict[str, Tensor] = {}
        masks: list[np.ndarray] = []
        config: str | None = None
        for entry in head.entries:
            section = entry.section
            try:
                data = file.read(entry.stored)
                if zlib.crc32(data) != entry.checksum:
                    raise Damaged(f"its check sum is {zlib.crc32(data):08x}; expected {entry.checksum:08x}")
                section = replace(section, head=data[: section.head_size])
                if section.coding != TEXT and entry.content != (wanted := content_size(section, head.count, masks)):
                    raise Damaged(f"its planes have {entry.content} bytes; expected {wanted}")
                content = _content(data[section.head_size :], entry)
                if section.coding == TEXT:
                    config = content.decode("utf-8")
                elif section.coding == ROWS:
                    masks = unpack_rows(section, content, head.count)
                else:
                    tensors[section.name] = unpack(section, content, head.count, masks)
            except (Damaged, UnicodeDecodeError) as error:
                raise CheckpointError(f"{path}: section {section.name!r} is damaged: {error}") from error
    return head.header, tensors, config


def _opened(path: Path) -> BinaryIO:
    try:
        return io.BytesIO(path.read_bytes())  # its true size, and nothing changes under the reader
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such model") from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from error


def _content(data: bytes, entry: _Entry) -> bytes:
    if entry.packing == _PLAIN:
        return data
    try:
        stated = zstandard.get_frame_parameters(data).content_size
        if stated != entry.content:
            raise Damaged(f"its zstd frame states {stated} bytes; expected {entry.content}")
        made = zstandard.ZstdDecompressor().decompress(data, max_output_size=entry.content, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise Damaged(f"zstd: {error}") from error
    if len(made) != entry.content:
        raise Damaged(f"zstd made {len(made)} bytes of it; expected {entry.content}")
    return made


def _head(path: Path, file: BinaryIO) -> _Head:
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    if (found := file.read(len(MAGIC))) != MAGIC:
        raise CheckpointError(f"{path}: starts with {found!r}; expected a compressed model ({MAGIC!r})")
    start = file.read(_START.size)
    if len(start) < _START.size:
        raise CheckpointError(f"{path}: ends after {size} bytes; expected {len(MAGIC) + _START.size} and more")
    version, sections, count, text_size, table_size, checksum = _START.unpack(start)
    if version != VERSION:
        raise CheckpointError(f"{path}: format version is {version}; this neuprim reads {VERSION}")
    for what, value, most in (
        ("sections", sections, _MOST_SECTIONS),
        ("primitives", count, _MOST_PRIMITIVES),
        ("bytes of header", text_size, min(_MOST_HEADER, size - file.tell())),
        ("bytes of table", table_size, min(_MOST_TABLE, size - file.tell() - text_size)),
    ):
        if value > most:
            raise CheckpointError(
                f"{path}: claims {value} {what}; expected at most {max(most, 0)} in a file of {size} bytes"
            )
    text, table = file.read(text_size), file.read(table_size)
    if zlib.crc32(start[:-4] + text + table) != checksum:
        raise CheckpointError(f"{path}: the check sum of header and table is not {checksum:08x}; the file is damaged")
    try:
        header = load_json(text)
    except (ValueError, RecursionError) as error:
        raise CheckpointError(f"{path}: the header is not valid JSON ({error})") from error
    if not isinstance(header, dict):
        raise CheckpointError(f"{path}: the header is a {type(header).__name__}; expected an object")
    try:
        entries = _entries(table, sections, count)
        _fit(entries, count, size, size - file.tell())
    except Damaged as error:
        raise CheckpointError(f"{path}: {error}") from error
    if header.get("primitives") != count:
        raise CheckpointError(f"{path}: the header says {header.get('primitives')!r} primitives; expected {count}")
    return _Head(header, count, entries)


def _entries(table: bytes, sections: int, count: int) -> list[_Entry]:
    file = io.BytesIO(table)
    made: list[_Entry] = []
    names: set[str] = set()
    for number in range(sections):
        try:
            name = file.read(file.read(1)[0]).decode("utf-8")
            coding, packing, dimensions = struct.unpack("<BBB", file.read(3))
            if dimensions > _MOST_DIMENSIONS:
                raise Damaged(f"section {name!r} has {dimensions} dimensions; expected at most {_MOST_DIMENSIONS}")
            shape = struct.unpack(f"<{dimensions}I", file.read(4 * dimensions))
            content, stored, checksum = _SIZES.unpack(file.read(_SIZES.size))
        except (struct.error, IndexError, UnicodeDecodeError) as error:
            raise Damaged(
                f"row {number} of the table of {sections} sections is cut short or damaged ({error})"
            ) from error
        if name in names:
            raise Damaged(f"section {name!r} is there twice")
        names.add(name)
        made.append(_Entry(_named(name, coding, shape), content, packing, stored, checksum))
        _check(made[-1], count)
    if file.read(1):
        raise Damaged(f"the table goes on after {sections} sections; expected its end")
    return made


def _named(name: str, coding: int, shape: tuple[int, ...]) -> Section:
    if coding not in CODINGS:
        raise Damaged(
            f"section {name!r} has coding {coding}; expected {', '.join(f'{k} ({v})' for k, v in CODINGS.items())}"
        )
    section, wanted = Section(name, coding, shape), {TEXT: (), POSITIONS: (3,), ROTATIONS: (4,)}.get(coding, shape)
    if shape != wanted:
        raise Damaged(f"section {name!r} of {CODINGS[coding]} has shape {shape}; expected {wanted}")
    if (coding == TEXT) != (name == CONFIG):
        raise Damaged(f"section {name!r} has coding {CODINGS[coding]}; the one text is {CONFIG!r}")
    if (coding == ROWS) != (name == ROWS_NAME) or (
        coding == ROWS and not (len(shape) == 1 and 0 < shape[0] <= _MOST_MASKS)
    ):
        raise Damaged(
            f"section {name!r} of {CODINGS[coding]} has shape {shape}; the one of rows is {ROWS_NAME!r}, of 1 to {_MOST_MASKS} masks"
        )
    if max(shape, default=0) > _MOST_COLUMNS or section.columns > _MOST_COLUMNS:
        raise Damaged(f"section {name!r} has shape {shape}; expected at most {_MOST_COLUMNS} numbers")
    return section


def _check(entry: _Entry, count: int) -> None:
    """That sizes are possible; that they fit is seen when the section's head is read."""
    section, head = entry.section, entry.section.head_size
    most = MOST_TEXT if section.coding == TEXT else _MOST_PLANES * count * section.columns
    if entry.content > most:
        raise Damaged(
            f"section {section.name!r} has planes of {entry.content} bytes; expected at most {most} of {count} primitives"
        )
    if entry.packing not in (_PLAIN, _ZSTD):
        raise Damaged(
            f"section {section.name!r} has packing {entry.packing}; expected {_PLAIN} (plain) or {_ZSTD} (zstd)"
        )
    least = head + (entry.content if entry.packing == _PLAIN else 0)
    if entry.stored < least or (entry.packing == _PLAIN and entry.stored != least):
        raise Damaged(
            f"section {section.name!r} is stored in {entry.stored} bytes; expected {least}"
            + " or more" * (entry.packing == _ZSTD)
        )


def _fit(entries: Sequence[_Entry], count: int, size: int, left: int) -> None:
    stored = sum(entry.stored for entry in entries)
    if stored != left:
        raise Damaged(f"the sections take {stored} bytes by the table; {left} follow it")
    numbers = count * sum(entry.section.columns for entry in entries if entry.section.coding != TEXT)
    if not _allowed(numbers, size):
        raise Damaged(
            f"stands for {count} primitives of {numbers // max(count, 1)} numbers; expected at most {MOST_TIMES} times its size"
        )
