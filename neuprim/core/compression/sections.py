"""Codes as bytes: byte planes, which compress better than numbers one by one, and the way back from bytes of strangers.

All numbers are little-endian. What every section holds stands in docs/data_formats.md, byte by byte.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from neuprim.core.compression.columns import MOST_BITS, Columns
from neuprim.core.compression.order import morton, unmorton
from neuprim.core.compression.rotations import LEAST_BITS, Rotations

__all__ = [
    "CODINGS",
    "COLUMNS",
    "MOST_TEXT",
    "POSITIONS",
    "ROTATIONS",
    "ROWS",
    "ROWS_NAME",
    "SPARSE",
    "TEXT",
    "Damaged",
    "Section",
    "content_size",
    "pack",
    "pack_rows",
    "pack_sparse",
    "unpack",
    "unpack_rows",
]

TEXT, COLUMNS, POSITIONS, ROTATIONS, ROWS, SPARSE = range(6)
CODINGS = {
    TEXT: "text",
    COLUMNS: "columns",
    POSITIONS: "positions",
    ROTATIONS: "rotations",
    ROWS: "rows",
    SPARSE: "sparse columns",
}

ROWS_NAME = "rows|"
"""Of the one section that says which primitives have what; no parameter is called so."""

MOST_TEXT = 2**20
"""Bytes of a text."""

_RECORD = struct.Struct("<Bff")
_WHOSE = struct.Struct("<H")


class Damaged(Exception):
    """What is wrong with a section's content, without the file's and the section's name."""


@dataclass(frozen=True)
class Section:
    """A parameter, or the one text, as it goes into a file.

    Attributes:
        coding, shape: one of :data:`CODINGS`, and the shape of one primitive's row.
        head: how its numbers are coded: a record per column, of sparse ones then whose they are, or the bits of
        rotations. planes: its codes, a byte plane each; of a text all of it.
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
        record = _RECORD.size + (_WHOSE.size if self.coding == SPARSE else 0)
        return {TEXT: 0, ROWS: 0, ROTATIONS: 1}.get(self.coding, record * self.columns)


def pack(name: str, shape: tuple[int, ...], scheme: Columns | Rotations, codes: np.ndarray, coding: int) -> Section:
    """The section of codes (N, C). Positions must be in their order already."""
    if isinstance(scheme, Rotations):
        planes = [*_planes(codes[:, 0], 2), *(plane for i in (1, 2, 3) for plane in _planes(codes[:, i], scheme.bits))]
        return Section(name, coding, shape, bytes([scheme.bits]), tuple(planes))
    bits, head = scheme.bits.tolist(), _head(scheme)
    if coding == POSITIONS:
        planes = _planes(np.diff(morton(codes, bits[0]), prepend=np.uint64(0)), 3 * bits[0])
    else:
        planes = [plane for i, b in enumerate(bits) for plane in _planes(codes[:, i], b)]
    return Section(name, coding, shape, head, tuple(planes))


def pack_rows(masks: Sequence[np.ndarray]) -> Section:
    """The section of (N,) bool masks: who has what, a bit per primitive, the lowest first."""
    return Section(
        ROWS_NAME, ROWS, (len(masks),), planes=tuple(np.packbits(mask, bitorder="little").tobytes() for mask in masks)
    )


def pack_sparse(
    name: str,
    shape: tuple[int, ...],
    scheme: Columns,
    codes: np.ndarray,
    whose: Sequence[int],
    masks: Sequence[np.ndarray],
) -> Section:
    """The section of codes (N, C) of which column i has those of mask ``whose[i] - 1`` alone, or all of them for 0."""
    own = [codes[:, i] if of == 0 else codes[masks[of - 1], i] for i, of in enumerate(whose)]
    planes = [plane for column, b in zip(own, scheme.bits.tolist(), strict=True) for plane in _planes(column, b)]
    return Section(name, SPARSE, shape, _head(scheme) + b"".join(map(_WHOSE.pack, whose)), tuple(planes))


def _head(scheme: Columns) -> bytes:
    return b"".join(
        _RECORD.pack(*r) for r in zip(scheme.bits.tolist(), scheme.low.tolist(), scheme.high.tolist(), strict=True)
    )


def _planes(codes: np.ndarray, bits: int) -> list[bytes]:
    """Low bytes of all codes, then the next, as many as so many bits need."""
    return [
        ((codes >> codes.dtype.type(8 * i)) & codes.dtype.type(255)).astype(np.uint8).tobytes()
        for i in range(_bytes(bits))
    ]


def _bytes(bits: int) -> int:
    return (bits + 7) // 8


def content_size(section: Section, count: int, masks: Sequence[np.ndarray] = ()) -> int:
    """Bytes of the planes of a section with this head, of ``count`` primitives.

    Args:
        masks: those of the file.

    Raises:
        Damaged: the head is not one.
    """
    if section.coding == ROWS:
        return section.columns * ((count + 7) // 8)
    if section.coding == ROTATIONS:
        return count * (1 + 3 * _bytes(_rotations(section).bits))
    bits = _records(section).bits.tolist()
    if section.coding == POSITIONS:
        if len(set(bits)) != 1 or len(bits) != 3:
            raise Damaged(f"{bits} bits; expected three columns of as many bits each")
        return count * _bytes(3 * bits[0])
    return sum(_bytes(b) * n for b, n in zip(bits, _counts(section, count, masks), strict=True))


def unpack_rows(section: Section, content: bytes, count: int) -> list[np.ndarray]:
    """(count,) bool masks of a section's ``content``.

    Raises:
        Damaged: bits of primitives that do not exist.
    """
    bits = np.unpackbits(
        np.frombuffer(content, np.uint8).reshape(section.columns, (count + 7) // 8), axis=1, bitorder="little"
    )
    if bits[:, count:].any():
        raise Damaged(f"bits beyond those of {count} primitives")
    return list(bits[:, :count].astype(bool))


def unpack(section: Section, content: bytes, count: int, masks: Sequence[np.ndarray] = ()) -> Tensor:
    """(count, *shape) float32 of a section's head and ``content``, :func:`content_size` bytes; what a sparse column
    does not have is 0.

    Raises:
        Damaged: codes that do not exist.
    """
    planes = _Planes(content)
    if section.coding == ROTATIONS:
        scheme = _rotations(section)
        codes = [planes.codes(count, 2, 3), *(planes.codes(count, scheme.bits, 2 * scheme.half) for _ in range(3))]
        return scheme.values(torch.from_numpy(np.stack(codes, 1)))
    columns = _records(section)
    if section.coding == POSITIONS:
        return columns.values(torch.from_numpy(_cells(planes, count, int(columns.bits[0]))))
    values = torch.zeros(count, section.columns)
    for i, (of, own) in enumerate(zip(_whose(section), _counts(section, count, masks), strict=True)):
        one = Columns(columns.bits[i : i + 1], columns.low[i : i + 1], columns.high[i : i + 1])
        found = one.values(torch.from_numpy(planes.codes(own, int(one.bits), int(one.last))[:, None]))[:, 0]
        if of:
            values[torch.from_numpy(masks[of - 1]), i] = found
        else:
            values[:, i] = found
    return values.reshape(count, *section.shape)


def _whose(section: Section) -> list[int]:
    """Of each column the number of its mask, 0 for all primitives."""
    if section.coding != SPARSE:
        return [0] * section.columns
    return [of for (of,) in _WHOSE.iter_unpack(section.head[_RECORD.size * section.columns :])]


def _counts(section: Section, count: int, masks: Sequence[np.ndarray]) -> list[int]:
    """Primitives that each column has numbers of."""
    whose = _whose(section)
    if max(whose, default=0) > len(masks):
        raise Damaged(
            f"a column of the primitives of mask {max(whose)}; expected at most {len(masks)}, as many as there are before it"
        )
    sizes = {
        of: int(masks[of - 1].sum()) if of else count for of in set(whose)
    }  # no more work than the section has numbers
    return [sizes[of] for of in whose]


def _rotations(section: Section) -> Rotations:
    bits = section.head[0]
    if not LEAST_BITS <= bits <= 16:
        raise Damaged(f"{bits} bits for rotations; expected {LEAST_BITS} to 16")
    return Rotations(bits)


def _records(section: Section) -> Columns:
    found = list(_RECORD.iter_unpack(section.head[: _RECORD.size * section.columns]))
    for i, (bits, low, high) in enumerate(found):
        if not 1 <= bits <= MOST_BITS:
            raise Damaged(f"column {i} has {bits} bits; expected 1 to {MOST_BITS}")
        if not -np.inf < low <= high < np.inf:
            raise Damaged(f"column {i} goes from {low} to {high}; expected two finite numbers, ascending")
    bits, low, high = zip(*found, strict=True) if found else ((), (), ())
    return Columns(
        torch.tensor(bits, dtype=torch.int64),
        torch.tensor(low, dtype=torch.float32),
        torch.tensor(high, dtype=torch.float32),
    )


def _cells(planes: _Planes, count: int, bits: int) -> np.ndarray:
    keys = np.cumsum(planes.codes(count, 3 * bits, (1 << 3 * bits) - 1), dtype=np.int64)
    if len(keys) and (keys.min() < 0 or keys.max() >= 1 << 3 * bits):  # a step is too small to pass over both
        raise Damaged(f"steps along the curve leave its {3 * bits} bits")
    return unmorton(keys.astype(np.uint64), bits)


class _Planes:
    """Byte planes from front to back."""

    def __init__(self, content: bytes) -> None:
        self._bytes, self._at = np.frombuffer(content, np.uint8), 0

    def codes(self, count: int, bits: int, last: int) -> np.ndarray:
        """(count,) int64 out of as many planes as so many bits need, each at most ``last``."""
        found = np.zeros(count, np.int64)
        if count:
            for i in range(_bytes(bits)):
                found |= self._bytes[self._at : self._at + count].astype(np.int64) << (8 * i)
                self._at += count
            if found.min() < 0 or found.max() > last:
                raise Damaged(f"a code of {bits} bits that is not among 0 to {last}")
        return found
