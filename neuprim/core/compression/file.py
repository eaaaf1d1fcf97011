"""Read and write ``.neuprim`` files: a JSON header, a table of sections, and the sections, compressed by zstd.

A section holds one parameter, the bit masks or the configuration. docs/data_formats.md describes every byte; numbers
are little-endian. Files may come from an attacker. So every size is checked against the file size before memory is
allocated, and :data:`MAX_EXPANSION` limits decompression.
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

from neuprim.core.compression.sections import (
    CODINGS,
    MASKS,
    MASKS_NAME,
    MAX_TEXT,
    POSITIONS,
    ROTATIONS,
    TEXT,
    CompressedSection,
    CorruptSection,
    compress_code_planes,
    section_content_size,
    unpack_codec_masks,
    unpack_section,
)
from neuprim.core.errors import CheckpointError
from neuprim.core.io.files import atomic_path
from neuprim.core.io.json_reader import load_json

MAGIC = b"\x89NEUPRIM"
VERSION = 1
CONFIG = "config.yaml"  # name of the one text section: the configuration of the run

MAX_EXPANSION = 64  # largest number of float32 bytes for each byte of the file, beyond the first MiB

_PLAIN, _ZSTD = 0, 1
_MAX_PLANES = 3  # most byte planes of a column's codes
_START = struct.Struct("<IIQIII")  # version, sections, primitives, bytes of header and table, their check sum
_SIZES = struct.Struct("<QQI")
_MAX_HEADER, _MAX_TABLE = 2**22, 2**20  # bytes
_MAX_MASKS = 2**16 - 1
_MAX_SECTIONS, _MAX_DIMENSIONS, _MAX_COLUMNS, _MAX_PRIMITIVES = 4096, 4, 2**20, 2**31


@dataclass(frozen=True)
class _TableEntry:
    """Row of a file's table, which describes one section; sizes are in bytes.

    ``section`` has no content yet. ``content`` is the size of the section's byte planes after decompression.
    ``packing`` is 0 (plain) or 1 (zstd). ``stored`` is the size of the section in the file, and ``checksum`` the CRC-32
    of the stored bytes.
    """

    section: CompressedSection
    content: int
    packing: int
    stored: int
    checksum: int


@dataclass(frozen=True)
class _FileHead:
    header: dict[str, Any]
    count: int
    entries: list[_TableEntry]


# ---------------------------------------------------------------- writing


def write_compressed(
    path: Path, header: Mapping[str, Any], count: int, sections: Sequence[CompressedSection]
) -> dict[str, int]:
    """Write a ``.neuprim`` file atomically; return section name -> number of bytes in the file.

    Section names must be unique. Raises CheckpointError if the file cannot be written.
    """
    text = json.dumps(header, allow_nan=False).encode()
    if len(text) > _MAX_HEADER:
        raise CheckpointError(f"{path}: the header has {len(text)} bytes; at most {_MAX_HEADER} can be stored")
    if any(s.coding == TEXT and sum(map(len, s.planes)) > MAX_TEXT for s in sections):
        raise CheckpointError(f"{path}: {CONFIG} is too long to be stored; expected at most {MAX_TEXT} bytes")
    for s in sections:
        if len(s.name.encode()) > 255 or len(s.shape) > _MAX_DIMENSIONS or max(*s.shape, s.columns, 0) > _MAX_COLUMNS:
            limits = f"255 bytes of name, {_MAX_DIMENSIONS} dimensions and {_MAX_COLUMNS} numbers"
            raise CheckpointError(
                f"{path}: parameter {s.name!r} of shape {s.shape} cannot be stored; expected at most {limits}"
            )
    plain = [b"".join(s.planes) for s in sections]
    packed = [compress_code_planes(s.planes) for s in sections]
    numbers = count * sum(s.columns for s in sections if s.coding != TEXT)
    for i in sorted(range(len(sections)), key=lambda i: len(plain[i]) - len(packed[i])):
        if _decompression_allowed(numbers, sum(map(len, packed))):
            break
        packed[i] = plain[i]  # a model of zeros would exceed MAX_EXPANSION
    packings = [_PLAIN if len(a) == len(b) else _ZSTD for a, b in zip(packed, plain, strict=True)]
    stored = [s.head + data for s, data in zip(sections, packed, strict=True)]
    rows = zip(sections, packings, plain, stored, strict=True)
    table = b"".join(_pack_entry(section, packing, len(content), data) for section, packing, content, data in rows)
    start = _START.pack(VERSION, len(sections), count, len(text), len(table), 0)[:-4]
    try:
        with atomic_path(path) as temporary, open(temporary, "wb") as file:
            file.write(MAGIC + start + struct.pack("<I", zlib.crc32(start + text + table)) + text + table)
            file.writelines(stored)
    except OSError as error:
        raise CheckpointError(
            f"{path}: could not write the model: {error}; a file that was there before is unchanged"
        ) from error
    return {s.name: len(data) for s, data in zip(sections, stored, strict=True)}


def _pack_entry(section: CompressedSection, packing: int, content: int, data: bytes) -> bytes:
    name = section.name.encode()
    dimensions = struct.pack(f"<BBB{len(section.shape)}I", section.coding, packing, len(section.shape), *section.shape)
    return bytes([len(name)]) + name + dimensions + _SIZES.pack(content, len(data), zlib.crc32(data))


def _decompression_allowed(numbers: int, size: int) -> bool:
    return 4 * numbers <= 2**20 + MAX_EXPANSION * size


# ---------------------------------------------------------------- reading


def is_compressed(path: Path) -> bool:
    """Return whether the file starts with the :data:`MAGIC` of ``.neuprim`` files; the file's name does not matter."""
    try:
        with open(path, "rb") as file:
            return file.read(len(MAGIC)) == MAGIC
    except OSError:
        return False


def read_model_header(path: Path) -> dict[str, Any]:
    """Return the JSON header of a ``.neuprim`` file without reading a section; raises CheckpointError."""
    with _open_compressed_file(path) as file:
        return _read_compressed_head(path, file).header


def read_compressed(path: Path) -> tuple[dict[str, Any], dict[str, Tensor], str | None]:
    """Return header, tensors by name (float32) and configuration (None if absent); raise CheckpointError."""
    with _open_compressed_file(path) as file:
        head = _read_compressed_head(path, file)
        tensors: dict[str, Tensor] = {}
        masks: list[np.ndarray] = []
        config: str | None = None
        for entry in head.entries:
            section = entry.section
            try:
                data = file.read(entry.stored)
                if zlib.crc32(data) != entry.checksum:
                    raise CorruptSection(f"its check sum is {zlib.crc32(data):08x}; expected {entry.checksum:08x}")
                section = replace(section, head=data[: section.head_size])
                if section.coding != TEXT and entry.content != (
                    wanted := section_content_size(section, head.count, masks)
                ):
                    raise CorruptSection(f"its planes have {entry.content} bytes; expected {wanted}")
                content = _unpack_content(data[section.head_size :], entry)
                if section.coding == TEXT:
                    config = content.decode("utf-8")
                elif section.coding == MASKS:
                    masks = unpack_codec_masks(section, content, head.count)
                else:
                    tensors[section.name] = unpack_section(section, content, head.count, masks)
            except (CorruptSection, UnicodeDecodeError) as error:
                raise CheckpointError(f"{path}: section {section.name!r} is damaged: {error}") from error
    return head.header, tensors, config


def _open_compressed_file(path: Path) -> BinaryIO:
    try:
        return io.BytesIO(path.read_bytes())  # one snapshot: size and content agree
    except FileNotFoundError:
        raise CheckpointError(f"{path}: no such model") from None
    except OSError as error:
        raise CheckpointError(f"{path}: cannot be read ({error.strerror or error})") from error


def _unpack_content(data: bytes, entry: _TableEntry) -> bytes:
    if entry.packing == _PLAIN:
        return data
    try:
        stated = zstandard.get_frame_parameters(data).content_size
        if stated != entry.content:
            raise CorruptSection(f"its zstd frame states {stated} bytes; expected {entry.content}")
        made = zstandard.ZstdDecompressor().decompress(data, max_output_size=entry.content, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise CorruptSection(f"zstd: {error}") from error
    if len(made) != entry.content:
        raise CorruptSection(f"zstd decompressed it to {len(made)} bytes; expected {entry.content}")
    return made


def _read_compressed_head(path: Path, file: BinaryIO) -> _FileHead:
    size = file.seek(0, io.SEEK_END)
    file.seek(0)
    if (found := file.read(len(MAGIC))) != MAGIC:
        raise CheckpointError(f"{path}: starts with {found!r}; expected a compressed model ({MAGIC!r})")
    start = file.read(_START.size)
    if len(start) < _START.size:
        raise CheckpointError(f"{path}: the file has {size} bytes; expected at least {len(MAGIC) + _START.size}")
    version, sections, count, text_size, table_size, checksum = _START.unpack(start)
    if version != VERSION:
        raise CheckpointError(f"{path}: format version is {version}, but this neuprim reads {VERSION}")
    for what, value, most in (
        ("sections", sections, _MAX_SECTIONS),
        ("primitives", count, _MAX_PRIMITIVES),
        ("bytes of header", text_size, min(_MAX_HEADER, size - file.tell())),
        ("bytes of table", table_size, min(_MAX_TABLE, size - file.tell() - text_size)),
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
        entries = _parse_compressed_table(table, sections, count)
        _check_total_size(entries, count, size, size - file.tell())
    except CorruptSection as error:
        raise CheckpointError(f"{path}: {error}") from error
    if header.get("primitives") != count:
        raise CheckpointError(f"{path}: the header says {header.get('primitives')!r} primitives; expected {count}")
    return _FileHead(header, count, entries)


def _parse_compressed_table(table: bytes, sections: int, count: int) -> list[_TableEntry]:
    file = io.BytesIO(table)
    made: list[_TableEntry] = []
    names: set[str] = set()
    for number in range(sections):
        try:
            name = file.read(file.read(1)[0]).decode("utf-8")
            coding, packing, dimensions = struct.unpack("<BBB", file.read(3))
            if dimensions > _MAX_DIMENSIONS:
                raise CorruptSection(
                    f"section {name!r} has {dimensions} dimensions; expected at most {_MAX_DIMENSIONS}"
                )
            shape = struct.unpack(f"<{dimensions}I", file.read(4 * dimensions))
            content, stored, checksum = _SIZES.unpack(file.read(_SIZES.size))
        except (struct.error, IndexError, UnicodeDecodeError) as error:
            raise CorruptSection(
                f"row {number} of the table of {sections} sections is cut short or damaged ({error})"
            ) from error
        if name in names:
            raise CorruptSection(f"section {name!r} is stored twice")
        names.add(name)
        made.append(_TableEntry(_checked_codec_section(name, coding, shape), content, packing, stored, checksum))
        _check_entry_sizes(made[-1], count)
    if file.read(1):
        raise CorruptSection(f"the table has more rows than its {sections} sections")
    return made


def _checked_codec_section(name: str, coding: int, shape: tuple[int, ...]) -> CompressedSection:
    if coding not in CODINGS:
        raise CorruptSection(
            f"section {name!r} has coding {coding}; expected {', '.join(f'{k} ({v})' for k, v in CODINGS.items())}"
        )
    section, wanted = (
        CompressedSection(name, coding, shape),
        {TEXT: (), POSITIONS: (3,), ROTATIONS: (4,)}.get(coding, shape),
    )
    if shape != wanted:
        raise CorruptSection(f"section {name!r} is damaged: shape {shape}; coding {CODINGS[coding]} expects {wanted}")
    if (coding == TEXT) != (name == CONFIG):
        raise CorruptSection(
            f"section {name!r} has coding {CODINGS[coding]}; expected coding text in section {CONFIG!r} and in no other"
        )
    if (coding == MASKS) != (name == MASKS_NAME) or (
        coding == MASKS and not (len(shape) == 1 and 0 < shape[0] <= _MAX_MASKS)
    ):
        raise CorruptSection(
            f"section {name!r} of {CODINGS[coding]} has shape {shape}; "
            f"expected {MASKS_NAME!r} with 1 to {_MAX_MASKS} masks"
        )
    if max(shape, default=0) > _MAX_COLUMNS or section.columns > _MAX_COLUMNS:
        raise CorruptSection(f"section {name!r} has shape {shape}; expected at most {_MAX_COLUMNS} numbers")
    return section


def _check_entry_sizes(entry: _TableEntry, count: int) -> None:
    """Raise CorruptSection if a table row claims sizes that ``count`` primitives cannot have."""
    section, head = entry.section, entry.section.head_size
    most = MAX_TEXT if section.coding == TEXT else _MAX_PLANES * count * section.columns
    if entry.content > most:
        raise CorruptSection(
            f"section {section.name!r} has planes of {entry.content} bytes; "
            f"expected at most {most} for {count} primitives"
        )
    if entry.packing not in (_PLAIN, _ZSTD):
        raise CorruptSection(
            f"section {section.name!r} has packing {entry.packing}; expected {_PLAIN} (plain) or {_ZSTD} (zstd)"
        )
    least = head + (entry.content if entry.packing == _PLAIN else 0)
    if entry.stored < least or (entry.packing == _PLAIN and entry.stored != least):
        raise CorruptSection(
            f"section {section.name!r} is stored in {entry.stored} bytes; expected {least}"
            + " or more" * (entry.packing == _ZSTD)
        )


def _check_total_size(entries: Sequence[_TableEntry], count: int, size: int, left: int) -> None:
    stored = sum(entry.stored for entry in entries)
    if stored != left:
        raise CorruptSection(f"the table states {stored} bytes for all sections, but {left} bytes follow it")
    numbers = count * sum(entry.section.columns for entry in entries if entry.section.coding != TEXT)
    if not _decompression_allowed(numbers, size):
        raise CorruptSection(
            f"decodes to {count} primitives of {numbers // max(count, 1)} numbers; "
            f"expected float32 data of at most {MAX_EXPANSION} times the file size"
        )
