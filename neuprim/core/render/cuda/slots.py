# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Slots: memory for each pixel of each (tile, primitive) pair, in which the forward pass saves data for backward.

This module also empties the tiles of frames that exceed the array sizes of a
:class:`~neuprim.core.render.cuda.binning.FrameCapacity`.
"""

import torch
from torch import Tensor

from neuprim.core.compute.warp import (
    OPTIONS,
    Floats2d,
    Ints,
    Ints2d,
    Longs2d,
    Shorts2d,
    Vec4is,
    Vec4s2d,
    array,
    launch_kernel,
    wp,
)
from neuprim.core.errors import BackendUnavailable
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.binning import FrameCapacity, running_sums
from neuprim.core.render.cuda.prepare import Frame
from neuprim.core.render.layout import HX, HY, SKEW, XC, YC

_MAX_HITS = 2**31
_MARGIN, _ROUNDING = 2e-3, 4e-7  # of a span: pixels, and per pixel of the ellipse; D rejects superfluous pixels

_PackedSpans = wp.types.vector(length=L.TILE // 2, dtype=wp.uint32)

_STORE_SPANS = f"""
    wp::uint32* to = reinterpret_cast<wp::uint32*>(spans.data + size_t(n) * {L.TILE});
#if defined(__CUDA_ARCH__)
    reinterpret_cast<uint4*>(to)[0] = make_uint4(packed[0], packed[1], packed[2], packed[3]);
    reinterpret_cast<uint4*>(to)[1] = make_uint4(packed[4], packed[5], packed[6], packed[7]);
#else
    for (int k = 0; k < {L.TILE // 2}; ++k) to[k] = packed[k];
#endif
"""


@wp.func_native(_STORE_SPANS)
def _store_spans(spans: Shorts2d, n: int, packed: _PackedSpans):
    """Store the 16 row spans of pair ``n``, packed into eight numbers, in two instructions instead of 16."""


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def row_spans(
    rows: Vec4s2d, silhouettes: Floats2d, boxes: Vec4is, starts: Ints, ids: Ints, tiles: Ints, size: wp.vec2i,
    spans: Shorts2d, counts: Ints2d,
):  # fmt: skip
    """Write the pixels that each (tile, primitive) pair covers in its tile, as 16 row spans; thread n handles pair n.

    A span is start << 8 | last << 4 | first. ``start`` is the number of covered pixels in earlier rows; ``last`` and
    ``first`` are the last and first covered pixel of the row. Each covered pixel has a slot for the data of the
    backward pass, in the order of pairs, rows and pixels. The slots take a fifth of the memory of whole tiles. The
    kernel also fills ``counts`` (2, pairs): row 0 is the number of slots of each pair, row 1 is 1 for float64 pairs.
    """
    n = wp.tid()
    if n >= starts[starts.shape[0] - 1]:  # the arrays are larger than the frame needs
        counts[0, n] = 0
        counts[1, n] = 0
        return
    i = ids[n]
    across = (size[0] + L.TILE - 1) // L.TILE
    tx = (tiles[n] % across) * L.TILE
    ty = (tiles[n] // across) * L.TILE
    box = boxes[i]
    hx = silhouettes[i, HX]
    hy = silhouettes[i, HY]
    xc = silhouettes[i, XC] + rows[i, L.E0][3] - 0.5 - float(tx)
    yc = silhouettes[i, YC] + rows[i, L.EX][3] - 0.5 - float(ty)
    total = int(0)
    packed = _PackedSpans()
    for y in range(L.TILE):
        first = int(15)
        last = int(0)
        start = int(total)
        dv = float(y) - yc
        k = dv / hy
        s = 1.0 - k * k
        if ty + y >= box[1] and ty + y < box[3] and s > -1.0e-2:
            mid = xc + silhouettes[i, SKEW] * dv
            half = hx * wp.sqrt(wp.max(s, 0.0))
            half += _MARGIN + _ROUNDING * (half + wp.abs(mid))
            low = int(wp.max(wp.ceil(mid - half), float(wp.max(box[0] - tx, 0))))
            high = int(wp.min(wp.floor(mid + half), float(wp.min(box[2] - tx, L.TILE) - 1)))
            if high >= low:
                first = low
                last = high
                total += high - low + 1
        packed[y // 2] = packed[y // 2] | wp.uint32(start << 8 | last << 4 | first) << wp.uint32(16 * (y % 2))
    _store_spans(spans, n, packed)
    counts[0, n] = total
    counts[1, n] = int(rows[i, L.REST][3])


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def list_float64_pairs(starts: Ints, counts: Ints2d, ends: Longs2d, found: Ints):
    """Write the indices of all (tile, primitive) pairs that are drawn in float64 to ``found``, in order.

    ``counts[1]`` is 1 for these pairs, and ``ends`` holds the running sums of ``counts``.
    """
    n = wp.tid()
    if counts[1, n] > 0 and n < starts[starts.shape[0] - 1]:  # a refused frame has no pairs
        found[int(ends[1, n]) - 1] = n


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def refuse_frame(
    ends: Longs2d, slot_ends: Longs2d, bad: Ints, capacity: wp.vec4i, starts: Ints, refused: Ints,
):  # fmt: skip
    """Empty all tiles and set ``refused`` if the frame exceeds its capacity or a primitive is not finite.

    ``capacity`` holds the sizes of :class:`FrameCapacity`. ``ends`` and ``slot_ends`` are running sums of the counts of
    primitives and of pairs.
    """
    t = wp.tid()
    last, pair = ends.shape[1] - 1, slot_ends.shape[1] - 1
    if (
        ends[0, last] > wp.int64(capacity[0])
        or ends[1, last] > wp.int64(capacity[1])
        or slot_ends[0, pair] > wp.int64(capacity[2])
        or slot_ends[1, pair] > wp.int64(capacity[3])
        or bad[0] < ends.shape[1]
    ):
        starts[t] = 0
        refused[0] = 1


def count_slots(frame: Frame, counts: Tensor, capacity: FrameCapacity | None) -> tuple[int, Tensor, Tensor]:
    """Return the number of slots, the (pairs + 1,) first slot of each pair, and a list of the float64 pairs.

    ``counts`` (2, pairs) comes from :func:`row_spans`. Without a ``capacity``, the function waits for the device. With
    a ``capacity``, the list has a fixed length, and -1 fills its rest. Raises BackendUnavailable if there are 2^31
    slots or more.
    """
    device, pairs = frame.device, counts.shape[1]
    ends = running_sums(counts)
    offsets = torch.zeros(pairs + 1, dtype=torch.int32, device=device)
    offsets[1:] = ends[0]
    if capacity is None:
        total, few = ends[:, -1].tolist()
        if total >= _MAX_HITS:
            raise BackendUnavailable(
                f"primitives cover {total} pixels in all; the cuda backend can count at most {_MAX_HITS - 1}: "
                "render a smaller image"
            )
    else:
        total, few = capacity.slots, capacity.float64_pairs
        refuse_misfit(frame, ends, capacity)
    in_float64 = torch.full((few,), -1, dtype=torch.int32, device=device)
    if few:
        lists = (array(frame.lists.starts, wp.int32), array(counts, wp.int32))
        inputs = (*lists, array(ends, wp.int64), array(in_float64, wp.int32))
        launch_kernel(list_float64_pairs, pairs, inputs, device)
    return total, offsets, in_float64


def refuse_misfit(frame: Frame, slot_ends: Tensor, capacity: FrameCapacity) -> None:
    """Empty all tiles of a frame that exceeds ``capacity`` or has a primitive that is not finite.

    ``slot_ends`` (2, pairs) holds the running sums of slots and of float64 pairs.
    """
    starts = frame.lists.starts
    sizes = wp.vec4i(*capacity.sizes)
    sums = (array(frame.ends, wp.int64), array(slot_ends, wp.int64), array(frame.bad, wp.int32))
    inputs = (*sums, sizes, array(starts, wp.int32), array(capacity.refused, wp.int32))
    launch_kernel(refuse_frame, len(starts), inputs, frame.device)
