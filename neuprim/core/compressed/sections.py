"""Codes as bytes: byte planes, which compress better than numbers one by one, and the way back from bytes of strangers.

All numbers are little-endian. What every section holds stands in docs/data_formats.md, byte by byte.
"""

from __future__ import annotations

import math
import struct
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compressed.columns import MOST_BITS, Columns
from neuprim.core.compressed.order import morton, unmorton
from neuprim.core.compressed.rotations import LEAST_BITS, Rotations

__all__ = ["CODINGS", "COLUMNS", "MOST_TEXT", "POSITIONS", "ROTATIONS", "TEXT", "Damaged", "Section", "pack", "plane_count", "unpack"]

TEXT, COLUMNS, POSITIONS, ROTATIONS = range(4)
CODINGS = {TEXT: "text", COLUMNS: "columns", POSITIONS: "positions", ROTATIONS: "rotations"}

MOST_TEXT = 2**20
"""Bytes of a text."""

_RECORD = struct.Struct("<Bff")


class Damaged(Exception):
    """What is wrong with a section's content, without the file's and the section's name."""


@dataclass(frozen=True)
class Section:
    """A parameter, or the one text, as it goes into a file.

    Attributes:
        coding, shape: one of :data:`CODINGS`, and the shape of one primitive's row.
        head: how its numbers are coded: a record per column, or the bits of rotations.
        planes: its codes, a byte plane each; of a text all of it.
    """

    name: str
    coding: int
    shape: tuple[int, ...]
    head: bytes = b""
    planes: tuple[bytes, ...] = ()

    @property
    def columns(self) -> int:
        """Numbers per primitive."""
        return math.prod(self.shape)

    @property
    def head_size(self) -> int:
        """Bytes of the head, which follow from the rest."""
        return {TEXT: 0, ROTATIONS: 1}.get(self.coding, _RECORD.size * self.columns)


def pack(name: str, shape: tuple[int, ...], scheme: Columns | Rotations, codes: np.ndarray, coding: int) -> Section:
    """The section of codes (N, C). Positions must be in their order already."""
    if isinstance(scheme, Rotations):
        planes = [*_planes(codes[:, 0], 2), *(plane for i in (1, 2, 3) for plane in _planes(codes[:, i], scheme.bits))]
        return Section(name, coding, shape, bytes([scheme.bits]), tuple(planes))
    bits = scheme.bits.tolist()
    head = b"".join(_RECORD.pack(*record) for record in zip(bits, scheme.low.tolist(), scheme.high.tolist(), strict=True))
    if coding == POSITIONS:
        planes = _planes(np.diff(morton(codes, bits[0]), prepend=np.uint64(0)), 3 * bits[0])
    else:
        planes = [plane for i, b in enumerate(bits) for plane in _planes(codes[:, i], b)]
    return Section(name, coding, shape, head, tuple(planes))


def _planes(codes: np.ndarray, bits: int) -> list[bytes]:
    """Low bytes of all codes, then the next, as many as so many bits need."""
    return [((codes >> codes.dtype.type(8 * i)) & codes.dtype.type(255)).astype(np.uint8).tobytes() for i in range(_bytes(bits))]


def _bytes(bits: int) -> int:
    return (bits + 7) // 8


def plane_count(section: Section) -> int:
    """Byte planes that a section with this head has.

    Raises:
        Damaged: the head is not one.
    """
    if section.coding == ROTATIONS:
        return 1 + 3 * _bytes(_rotations(section).bits)
    bits = _records(section).bits.tolist()
    if section.coding == POSITIONS:
        if len(set(bits)) != 1 or len(bits) != 3:
            raise Damaged(f"{bits} bits; expected three columns of as many bits each")
        return _bytes(3 * bits[0])
    return sum(map(_bytes, bits))


def unpack(section: Section, content: bytes, count: int) -> Tensor:
    """(count, *shape) float32 of a section's head and ``content``: :func:`plane_count` planes of ``count`` bytes.

    Raises:
        Damaged: codes that do not exist.
    """
    planes = _Planes(content, count)
    if section.coding == ROTATIONS:
        scheme = _rotations(section)
        codes = [planes.codes(2, 3), *(planes.codes(scheme.bits, 2 * scheme.half) for _ in range(3))]
        return scheme.values(torch.from_numpy(np.stack(codes, 1)))
    columns = _records(section)
    if section.coding == POSITIONS:
        return columns.values(torch.from_numpy(_cells(planes, int(columns.bits[0]))))
    values = torch.empty(count, section.columns)
    for i in range(section.columns):
        one = Columns(columns.bits[i : i + 1], columns.low[i : i + 1], columns.high[i : i + 1])
        values[:, i] = one.values(torch.from_numpy(planes.codes(int(one.bits), int(one.last))[:, None]))[:, 0]
    return values.reshape(count, *section.shape)


def _rotations(section: Section) -> Rotations:
    bits = section.head[0]
    if not LEAST_BITS <= bits <= 16:
        raise Damaged(f"{bits} bits for rotations; expected {LEAST_BITS} to 16")
    return Rotations(bits)


def _records(section: Section) -> Columns:
    found = list(_RECORD.iter_unpack(section.head))
    for i, (bits, low, high) in enumerate(found):
        if not 1 <= bits <= MOST_BITS:
            raise Damaged(f"column {i} has {bits} bits; expected 1 to {MOST_BITS}")
        if not -np.inf < low <= high < np.inf:
            raise Damaged(f"column {i} goes from {low} to {high}; expected two finite numbers, ascending")
    bits, low, high = zip(*found, strict=True) if found else ((), (), ())
    return Columns(torch.tensor(bits, dtype=torch.int64), torch.tensor(low, dtype=torch.float32), torch.tensor(high, dtype=torch.float32))


def _cells(planes: _Planes, bits: int) -> np.ndarray:
    keys = np.cumsum(planes.codes(3 * bits, (1 << 3 * bits) - 1), dtype=np.int64)
    if len(keys) and (keys.min() < 0 or keys.max() >= 1 << 3 * bits):  # a step is too small to pass over both
        raise Damaged(f"steps along the curve leave its {3 * bits} bits")
    return unmorton(keys.astype(np.uint64), bits)


class _Planes:
    """Byte planes from front to back."""

    def __init__(self, content: bytes, count: int) -> None:
        self._planes, self._count = iter(np.frombuffer(content, np.uint8).reshape(-1, max(count, 1))), count

    def codes(self, bits: int, last: int) -> np.ndarray:
        """(count,) int64 out of as many planes as so many bits need, each at most ``last``."""
        found = np.zeros(self._count, np.int64)
        if self._count:
            for i in range(_bytes(bits)):
                found |= next(self._planes).astype(np.int64) << (8 * i)
            if found.min() < 0 or found.max() > last:
                raise Damaged(f"a code of {bits} bits that is not among 0 to {last}")
        return found
