"""Byte planes through zstd: one frame, its blocks cut where that helps."""

from __future__ import annotations

from collections.abc import Sequence

import zstandard

__all__ = ["packed_planes"]

_TRIED = ((19, False), (19, True), (1, False), (1, True))
"""Levels, and whether blocks end with the planes. What differs between columns wants tables of its own for each, what does not wants one;
and the low levels find fewer repetitions, which in noise cost more than they save."""


def packed_planes(planes: Sequence[bytes]) -> bytes:
    """One zstd frame, which states its content's size, or the planes as they are where that is no longer."""
    whole = b"".join(planes)
    runs = _runs(planes)
    made = [_frame(whole_or_cut, len(whole), level) for level, cut in _TRIED for whole_or_cut in ([planes] if cut else [[whole], runs])]
    return min([whole, *made], key=len)


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
    packer = zstandard.ZstdCompressor(level=level).compressobj(size=size)
    made = []
    for i, part in enumerate(parts):
        made += [packer.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK)] if i else []
        made.append(packer.compress(part))
    return b"".join([*made, packer.flush()])
