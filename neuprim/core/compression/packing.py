"""Byte planes through zstd: one frame, its blocks cut where that helps."""

from __future__ import annotations

from collections.abc import Sequence

import zstandard

__all__ = ["packed_planes"]

_LEVELS = 19, 1
"""Low levels look for fewer repetitions, which in noise cost more than they save."""


def packed_planes(planes: Sequence[bytes]) -> bytes:
    """The smallest that was found: one zstd frame, which states its content's size, or the planes as they are where no
    frame is smaller.

    A block of a frame has one table of how often bytes occur. Columns that are alike share one best, others have their
    own.
    """
    whole = b"".join(planes)
    cuts = ([whole], _runs(planes), planes)
    return min([whole, *(_frame(parts, len(whole), level) for level in _LEVELS for parts in cuts)], key=len)


def _runs(planes: Sequence[bytes]) -> list[bytes]:
    """Neighbours with codes of equally many bits together."""
    made: list[list[bytes]] = []
    last = -1
    for plane in planes:
        bits = max(plane, default=0).bit_length()
        if bits != last:
            made.append([])
        made[-1].append(plane)
        last = bits
    return [b"".join(run) for run in made]


def _frame(parts: Sequence[bytes], size: int, level: int) -> bytes:
    """A frame whose blocks end with the parts."""
    packer = zstandard.ZstdCompressor(level=level).compressobj(size=size)
    made = []
    for i, part in enumerate(parts):
        made += [packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)] if i else []
        made.append(packer.compress(part))
    return b"".join([*made, packer.flush()])
