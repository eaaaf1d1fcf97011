"""Pack the integer codes of quantizers into byte planes, and unpack and validate them (docs/data_formats.md).

Byte plane i of a column holds byte i of all its codes, the lowest byte first.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
import zstandard
from torch import Tensor

from neuprim.core.compression.quantizers import MAX_BITS, MIN_BITS, ColumnQuantizer, RotationQuantizer

TEXT, COLUMNS, POSITIONS, ROTATIONS, MASKS, SPARSE = range(6)
CODINGS = {
    TEXT: "text",
    COLUMNS: "columns",
    POSITIONS: "positions",
    ROTATIONS: "rotations",
    MASKS: "rows",
    SPARSE: "sparse columns",
}

MASKS_NAME = "rows|"  # name of the one section of bit masks; no parameter can have it

MAX_TEXT = 2**20  # largest number of bytes of a text

_ZSTD_LEVELS = 19, 1  # low levels search fewer repetitions, which in noise cost more than they save

_RECORD = struct.Struct("<Bff")
_MASK_NUMBER = struct.Struct("<H")


class CorruptSection(Exception):
    """Error for a section with invalid content. The caller adds the name of the file to the message."""


@dataclass(frozen=True)
class CompressedSection:
    """A section of a ``.neuprim`` file: one parameter, the bit masks, or the configuration as text."""

    name: str
    coding: int  # one of CODINGS
    shape: tuple[int, ...]  # shape of one primitive's row
    # the quantizer: a record (bits, low, high) per column, then the mask numbers of sparse columns; or the number of
    # bits of rotations
    head: bytes = b""
    planes: tuple[bytes, ...] = ()  # byte planes of the codes, or the text

    @property
    def columns(self) -> int:
        """Number of columns, that is, of values per primitive."""
        return math.prod(self.shape)

    @property
    def head_size(self) -> int:
        """Number of bytes in ``head``, which follows from ``coding`` and ``shape``."""
        record = _RECORD.size + (_MASK_NUMBER.size if self.coding == SPARSE else 0)
        return {TEXT: 0, MASKS: 0, ROTATIONS: 1}.get(self.coding, record * self.columns)


def pack_section(
    name: str, shape: tuple[int, ...], scheme: ColumnQuantizer | RotationQuantizer, codes: np.ndarray, coding: int
) -> CompressedSection:
    """Return a section that holds codes (N, C) of a quantizer.

    Codes of positions must be in the order of :func:`~neuprim.core.compression.codec.storage_order`.
    """
    if isinstance(scheme, RotationQuantizer):
        planes = [
            *_byte_planes(codes[:, 0], 2),
            *(plane for i in (1, 2, 3) for plane in _byte_planes(codes[:, i], scheme.bits)),
        ]
        return CompressedSection(name, coding, shape, bytes([scheme.bits]), tuple(planes))
    bits, head = scheme.bits.tolist(), _quantizer_head(scheme)
    if coding == POSITIONS:
        planes = _byte_planes(np.diff(morton_encode(codes, bits[0]), prepend=np.uint64(0)), 3 * bits[0])
    else:
        planes = [plane for i, b in enumerate(bits) for plane in _byte_planes(codes[:, i], b)]
    return CompressedSection(name, coding, shape, head, tuple(planes))


def pack_codec_masks(masks: Sequence[np.ndarray]) -> CompressedSection:
    """Return a section that holds (N,) bool masks, one bit per primitive, the lowest bit first."""
    return CompressedSection(
        MASKS_NAME, MASKS, (len(masks),), planes=tuple(np.packbits(mask, bitorder="little").tobytes() for mask in masks)
    )


def pack_sparse_columns(
    name: str,
    shape: tuple[int, ...],
    scheme: ColumnQuantizer,
    codes: np.ndarray,
    mask_of: Sequence[int],
    masks: Sequence[np.ndarray],
) -> CompressedSection:
    """Return a section of codes (N, C) in which columns store only some of the primitives.

    Column i stores the primitives for which mask number ``mask_of[i]``, counted from 1, is true. If the number is 0,
    the column stores all primitives.
    """
    own = [codes[:, i] if of == 0 else codes[masks[of - 1], i] for i, of in enumerate(mask_of)]
    planes = [plane for column, b in zip(own, scheme.bits.tolist(), strict=True) for plane in _byte_planes(column, b)]
    return CompressedSection(
        name, SPARSE, shape, _quantizer_head(scheme) + b"".join(map(_MASK_NUMBER.pack, mask_of)), tuple(planes)
    )


def _quantizer_head(scheme: ColumnQuantizer) -> bytes:
    return b"".join(
        _RECORD.pack(*r) for r in zip(scheme.bits.tolist(), scheme.low.tolist(), scheme.high.tolist(), strict=True)
    )


def _byte_planes(codes: np.ndarray, bits: int) -> list[bytes]:
    """Return the byte planes of codes of ``bits`` bits: plane i holds byte i of every code, the lowest byte first."""
    return [
        ((codes >> codes.dtype.type(8 * i)) & codes.dtype.type(255)).astype(np.uint8).tobytes()
        for i in range(_code_byte_count(bits))
    ]


def _code_byte_count(bits: int) -> int:
    return (bits + 7) // 8


def section_content_size(section: CompressedSection, count: int, masks: Sequence[np.ndarray] = ()) -> int:
    """Return the size of a section's planes in bytes, computed from its ``head``; raise CorruptSection."""
    if section.coding == MASKS:
        return section.columns * ((count + 7) // 8)
    if section.coding == ROTATIONS:
        return count * (1 + 3 * _code_byte_count(_rotations(section).bits))
    bits = _column_records(section).bits.tolist()
    if section.coding == POSITIONS:
        if len(set(bits)) != 1 or len(bits) != 3:
            raise CorruptSection(f"columns of {bits} bits; expected three columns with the same number of bits")
        return count * _code_byte_count(3 * bits[0])
    return sum(_code_byte_count(b) * n for b, n in zip(bits, _column_counts(section, count, masks), strict=True))


def unpack_codec_masks(section: CompressedSection, content: bytes, count: int) -> list[np.ndarray]:
    """Decode the (count,) bool masks of a section; raises CorruptSection."""
    bits = np.unpackbits(
        np.frombuffer(content, np.uint8).reshape(section.columns, (count + 7) // 8), axis=1, bitorder="little"
    )
    if bits[:, count:].any():
        raise CorruptSection(f"a mask has bits set after its {count} primitives")
    return list(bits[:, :count].astype(bool))


def unpack_section(section: CompressedSection, content: bytes, count: int, masks: Sequence[np.ndarray] = ()) -> Tensor:
    """Decode ``content``, the bytes of a section's planes, to (count, *shape) float32; raises CorruptSection."""
    planes = _PlaneReader(content)
    if section.coding == ROTATIONS:
        scheme = _rotations(section)
        codes = [planes.codes(count, 2, 3), *(planes.codes(count, scheme.bits, 2 * scheme.half) for _ in range(3))]
        return scheme.values(torch.from_numpy(np.stack(codes, 1)))
    columns = _column_records(section)
    if section.coding == POSITIONS:
        return columns.values(torch.from_numpy(_position_cells(planes, count, int(columns.bits[0]))))
    values = torch.zeros(count, section.columns)
    for i, (of, own) in enumerate(
        zip(_column_mask_numbers(section), _column_counts(section, count, masks), strict=True)
    ):
        one = ColumnQuantizer(columns.bits[i : i + 1], columns.low[i : i + 1], columns.high[i : i + 1])
        found = one.values(torch.from_numpy(planes.codes(own, int(one.bits), int(one.last))[:, None]))[:, 0]
        if of:
            values[torch.from_numpy(masks[of - 1]), i] = found
        else:
            values[:, i] = found
    return values.reshape(count, *section.shape)


def _column_mask_numbers(section: CompressedSection) -> list[int]:
    """Return the mask number of each column; 0 means that the column stores all primitives."""
    if section.coding != SPARSE:
        return [0] * section.columns
    return [of for (of,) in _MASK_NUMBER.iter_unpack(section.head[_RECORD.size * section.columns :])]


def _column_counts(section: CompressedSection, count: int, masks: Sequence[np.ndarray]) -> list[int]:
    """Return the number of primitives that each column stores."""
    mask_of = _column_mask_numbers(section)
    if max(mask_of, default=0) > len(masks):
        raise CorruptSection(f"a column refers to mask {max(mask_of)}; expected at most {len(masks)}")
    sizes = {of: int(masks[of - 1].sum()) if of else count for of in set(mask_of)}
    return [sizes[of] for of in mask_of]


def _rotations(section: CompressedSection) -> RotationQuantizer:
    bits = section.head[0]
    if not MIN_BITS <= bits <= 16:
        raise CorruptSection(f"{bits} bits for rotations; expected {MIN_BITS} to 16")
    return RotationQuantizer(bits)


def _column_records(section: CompressedSection) -> ColumnQuantizer:
    found = list(_RECORD.iter_unpack(section.head[: _RECORD.size * section.columns]))
    for i, (bits, low, high) in enumerate(found):
        if not 1 <= bits <= MAX_BITS:
            raise CorruptSection(f"column {i} has {bits} bits; expected 1 to {MAX_BITS}")
        if not -np.inf < low <= high < np.inf:
            raise CorruptSection(f"column {i} has the range {low} to {high}; expected ascending finite numbers")
    bits, low, high = zip(*found, strict=True) if found else ((), (), ())
    return ColumnQuantizer(
        torch.tensor(bits, dtype=torch.int64),
        torch.tensor(low, dtype=torch.float32),
        torch.tensor(high, dtype=torch.float32),
    )


def _position_cells(planes: _PlaneReader, count: int, bits: int) -> np.ndarray:
    """Read (count, 3) int64 codes of positions, which are stored as differences of Z-curve keys."""
    keys = np.cumsum(planes.codes(count, 3 * bits, (1 << 3 * bits) - 1), dtype=np.int64)
    if len(keys) and (keys.min() < 0 or keys.max() >= 1 << 3 * bits):  # no step is large enough to skip both ranges
        raise CorruptSection(f"a position code does not fit {3 * bits} bits")
    return morton_decode(keys.astype(np.uint64), bits)


class _PlaneReader:
    """Reader of byte planes that decodes the codes of one column after the other."""

    def __init__(self, content: bytes) -> None:
        self._bytes, self._at = np.frombuffer(content, np.uint8), 0

    def codes(self, count: int, bits: int, last: int) -> np.ndarray:
        """Read the next ``count`` codes of ``bits`` bits as (count,) int64; raise CorruptSection for codes above
        ``last``."""
        found = np.zeros(count, np.int64)
        if count:
            for i in range(_code_byte_count(bits)):
                found |= self._bytes[self._at : self._at + count].astype(np.int64) << (8 * i)
                self._at += count
            if found.min() < 0 or found.max() > last:
                raise CorruptSection(f"a code of {bits} bits is outside of 0 to {last}")
        return found


def morton_encode(cells: np.ndarray, bits: int) -> np.ndarray:
    """Return (N,) uint64 Z-curve keys (Morton 1966) of integer ``cells`` (N, 3).

    Bit 3 b + axis of a key is bit b of the cell's coordinate on that axis.
    """
    wide = cells.astype(np.uint64)
    keys = np.zeros(len(wide), np.uint64)
    for bit in range(bits):
        for axis in range(3):
            keys |= ((wide[:, axis] >> np.uint64(bit)) & np.uint64(1)) << np.uint64(3 * bit + axis)
    return keys


def morton_decode(keys: np.ndarray, bits: int) -> np.ndarray:
    """Return the (N, 3) int64 cells of Z-curve keys: the inverse of :func:`morton_encode`."""
    cells = np.zeros((len(keys), 3), np.uint64)
    for bit in range(bits):
        for axis in range(3):
            cells[:, axis] |= ((keys >> np.uint64(3 * bit + axis)) & np.uint64(1)) << np.uint64(bit)
    return cells.astype(np.int64)


def compress_code_planes(planes: Sequence[bytes]) -> bytes:
    """Compress byte planes in several ways by zstd; return the smallest frame, or the plain bytes if none is smaller.

    A zstd block has one entropy table. So columns with similar bytes compress best in one block, and columns with
    different bytes in several blocks.
    """
    whole = b"".join(planes)
    cuts = ([whole], _plane_runs(planes), planes)
    return min([whole, *(_zstd_frame(parts, len(whole), level) for level in _ZSTD_LEVELS for parts in cuts)], key=len)


def _plane_runs(planes: Sequence[bytes]) -> list[bytes]:
    """Join neighbouring byte planes whose largest bytes have the same number of bits."""
    made: list[list[bytes]] = []
    last = -1
    for plane in planes:
        bits = max(plane, default=0).bit_length()
        if bits != last:
            made.append([])
        made[-1].append(plane)
        last = bits
    return [b"".join(run) for run in made]


def _zstd_frame(parts: Sequence[bytes], size: int, level: int) -> bytes:
    """Return a zstd frame with one or more blocks per part; ``size`` is the total length of the parts."""
    packer = zstandard.ZstdCompressor(level=level).compressobj(size=size)
    made = []
    for i, part in enumerate(parts):
        made += [packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)] if i else []
        made.append(packer.compress(part))
    return b"".join([*made, packer.flush()])
