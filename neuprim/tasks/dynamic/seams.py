"""Where the chunks of a sequence meet in time: how much of each counts at a time.

Over a seam from a to b the earlier chunk's share falls from 1 to 0 on a line, and the later one's rises from 0 to 1: at
every time the shares of all chunks add up to 1, and at most two are above 0. So a joined model's extinction and source
are the chunks' own, weighted by their shares, and no primitive counts where its chunk has seen nothing.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import torch
from torch import Tensor

__all__ = ["Seams", "checked_seams", "shares"]

Seams = tuple[tuple[float, float], ...]
"""(from, to) of each, ascending; chunk k ends with seam k."""


def checked_seams(seams: Sequence[Sequence[float]]) -> Seams:
    """The same as tuples.

    Raises:
        ValueError: they are no pairs of ascending times, or overlap.
    """
    try:
        found = tuple((float(begin), float(end)) for begin, end in seams)
    except (TypeError, ValueError):
        raise ValueError(f"seams {seams!r}; expected pairs of times") from None
    flat = list(itertools.chain.from_iterable(found))
    if not all(map(math.isfinite, flat)) or flat != sorted(flat) or any(begin == end for begin, end in found):
        raise ValueError(f"seams {seams!r}; expected pairs of ascending times, one after the other")
    return found


def shares(chunk: Tensor, seams: Seams, xi: Tensor) -> Tensor:
    """float64 in the shape of ``chunk``: what counts at time ``xi`` () of the primitives of these chunks, 0 to 1.

    Args:
        chunk: numbers from 0 to len(seams), of any dtype; rounded, as a compressed file may return them a little off.
    """
    own = chunk.detach().double().round()
    counts = torch.ones_like(own)
    for number, (begin, end) in enumerate(seams):
        handed = ((xi.to(own) - begin) / (end - begin)).clamp(0.0, 1.0)
        later = own > number
        counts = counts * torch.where(later, handed, 1.0 - handed)
    return counts
