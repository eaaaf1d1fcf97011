"""Codes as bytes: byte planes, which compress better than numbers one by one, and the way back from bytes of strangers.

All numbers are little-endian. What every section holds stands in docs/data_formats.md, byte by byte.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compressed.columns import MOST_BITS, Columns
from neuprim.core.compressed.order import morton, unmorton
from neuprim.core.compressed.rotations import LEAST_BITS, Rotations

__all__ = ["CODINGS", "COLUMNS", "MOST_TEXT", "POSITIONS", "ROTATIONS", "TEXT", "Damaged", "Section", "least_and_most", "pack", "unpack"]

TEXT, COLUMNS, POSITIONS, ROTATIONS = range(4)
CODINGS = {TEXT: "text", COLUMNS: "columns", POSITIONS: "positions", ROTATIONS: "rotations"}

MOST_TEXT = 2**20
"""Bytes of a text."""

_RECORD = struct.Struct("<Bff")


class Damaged(Exception):
    """What is wrong with a section's content, without the file's and the section's name."""


@dataclass(frozen=True)
class Section:
    """A name, how its content is coded, the shape of one primitive's row, and the content."""

    name: str
    coding: int
    shape: tuple[int, ...]
    content: bytes

    @property
    def columns(self) -> int:
        """Numbers per primitive."""
        return math.prod(self.shape)


def least_and_most(coding: int, columns: int, count: int) -> tuple[int, int]:
    """Bytes that a section's content of these sizes may have."""
    if coding == TEXT:
        return 0, MOST_TEXT
    if coding == ROTATIONS:
        return 1 + 4 * count, 1 + 7 * count
    planes = 8 if coding == POSITIONS else 3 * columns
    return _RECORD.size * columns + count * (1 if coding == POSITIONS else columns), _RECORD.size * columns + count * planes


def pack(coding: int, scheme: Columns | Rotations, codes: np.ndarray) -> bytes:
    """The content of a section: how it is coded, and codes (N, C) in byte planes. Positions must be in their order already."""
    if isinstance(scheme, Rotations):
        return bytes([scheme.bits]) + _planes(codes[:, 0], 2) + b"".join(_planes(codes[:, i], scheme.bits) for i in (1, 2, 3))
    bits = scheme.bits.tolist()
    head = b"".join(_RECORD.pack(*record) for record in zip(bits, scheme.low.tolist(), scheme.high.tolist(), strict=True))
    if coding == POSITIONS:
        return head + _planes(np.diff(morton(codes, bits[0]), prepend=np.uint64(0)), 3 * bits[0])
    return head + b"".join(_planes(codes[:, i], b) for i, b in enumerate(bits))


def _planes(codes: np.ndarray, bits: int) -> bytes:
    """Low bytes of all codes, then the next, as many as so many bits need."""
    return b"".join(((codes >> codes.dtype.type(8 * i)) & codes.dtype.type(255)).astype(np.uint8).tobytes() for i in range((bits + 7) // 8))


def unpack(section: Section, count: int) -> Tensor:
    """(count, *shape) float32 of a section with numbers.

    Raises:
        Damaged: the content is not what such a section holds.
    """
    reader = _Reader(section.content, count)
    if section.coding == ROTATIONS:
        values = _rotations(reader)
    else:
        columns = _records(reader, section.columns)
        if section.coding == POSITIONS:
            values = columns.values(torch.from_numpy(_cells(reader, columns)))
        else:
            values = torch.empty(count, section.columns)
            for i in range(section.columns):
                one = Columns(columns.bits[i : i + 1], columns.low[i : i + 1], columns.high[i : i + 1])
                values[:, i] = one.values(torch.from_numpy(reader.codes(int(one.bits), int(one.last))[:, None]))[:, 0]
    reader.end()
    return values.reshape(count, *section.shape)


def _rotations(reader: _Reader) -> Tensor:
    bits = reader.take(1)[0]
    if not LEAST_BITS <= bits <= 16:
        raise Damaged(f"{bits} bits for rotations; expected {LEAST_BITS} to 16")
    scheme = Rotations(bits)
    columns = [reader.codes(2, 3), *(reader.codes(bits, 2 * scheme.half) for _ in range(3))]
    return scheme.values(torch.from_numpy(np.stack(columns, 1)))


def _records(reader: _Reader, count: int) -> Columns:
    found = list(_RECORD.iter_unpack(reader.take(_RECORD.size * count)))
    for i, (bits, low, high) in enumerate(found):
        if not 1 <= bits <= MOST_BITS:
            raise Damaged(f"column {i} has {bits} bits; expected 1 to {MOST_BITS}")
        if not -np.inf < low <= high < np.inf:
            raise Damaged(f"column {i} goes from {low} to {high}; expected two finite numbers, ascending")
    bits, low, high = zip(*found, strict=True) if found else ((), (), ())
    return Columns(torch.tensor(bits, dtype=torch.int64), torch.tensor(low, dtype=torch.float32), torch.tensor(high, dtype=torch.float32))


def _cells(reader: _Reader, columns: Columns) -> np.ndarray:
    bits = columns.bits.tolist()
    if len(set(bits)) != 1 or len(bits) != 3:
        raise Damaged(f"{bits} bits; expected three columns of as many bits each")
    steps = reader.codes(3 * bits[0], (1 << 3 * bits[0]) - 1)
    keys = np.cumsum(steps, dtype=np.int64)
    if len(keys) and (keys.min() < 0 or keys.max() >= 1 << 3 * bits[0]):  # a step is too small to pass over both
        raise Damaged(f"steps along the curve that leave its {3 * bits[0]} bits")
    return unmorton(keys.astype(np.uint64), bits[0])


class _Reader:
    """Content from front to back."""

    def __init__(self, content: bytes, count: int) -> None:
        self._content, self._count, self._at = content, count, 0

    def take(self, size: int) -> bytes:
        if size > len(self._content) - self._at:
            raise Damaged(f"ends after {len(self._content)} bytes; {self._at + size} are needed")
        self._at += size
        return self._content[self._at - size : self._at]

    def codes(self, bits: int, last: int) -> np.ndarray:
        """(count,) int64 out of byte planes, each at most ``last``."""
        found = np.zeros(self._count, np.int64)
        for i, plane in enumerate(self._each((bits + 7) // 8)):
            found |= plane.astype(np.int64) << (8 * i)
        if len(found) and (found.min() < 0 or found.max() > last):
            raise Damaged(f"a code of {bits} bits that is not among 0 to {last}")
        return found

    def _each(self, planes: int) -> Iterator[np.ndarray]:
        for _ in range(planes):
            yield np.frombuffer(self.take(self._count), np.uint8)

    def end(self) -> None:
        if self._at != len(self._content):
            raise Damaged(f"holds {len(self._content)} bytes; {self._at} are needed")
