# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""List the primitives that reach each tile, by their silhouettes; CUDA version of :mod:`neuprim.core.render.cpu.tiles`.

The kernels count the entries before they write any, and the entries are sorted by integer keys, so that reruns give
the same bits. The host waits once for the counts, unless the caller gives the sizes of the arrays
(:class:`FrameCapacity`).
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.warp import (
    Ints,
    Ints2d,
    Longs,
    Longs2d,
    Vec4is,
    Vec4s2d,
    array,
    launch_kernel,
    wp,
)
from neuprim.core.errors import BackendUnavailable
from neuprim.core.model.edge import NORMS
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.projection import (
    EXACT,
    PER_BLOCK,
    ProjectedPrimitive,
    Ray,
    View,
    round_projected_to_float32,
)
from neuprim.core.render.layout import FLOAT64_RADII, MIN_RIM_SHARES, RIM_POWERS, UNBOUNDED

d = wp.float64
_E0, _EX, _TILE, _UNBOUNDED = L.E0, L.EX, L.TILE, wp.constant(d(UNBOUNDED))
_RADII = wp.constant(d(FLOAT64_RADII))
(_N0, _N1, _N2), (_P0, _P1, _P2), (_W0, _W1, _W2) = (
    [wp.constant(d(number)) for number in numbers] for numbers in (NORMS, RIM_POWERS, MIN_RIM_SHARES)
)
_MOST = 2**31  # indices of pairs are int32
_MARGIN, _SPARE = 1.5, 256  # factor and addend from counts to the sizes of arrays with room


@dataclass(frozen=True)
class FrameCapacity:
    """Fixed sizes of a frame's arrays, so that the host need not wait for the frame's counts.

    A frame that does not fit, or has a primitive that is not finite, is drawn empty and sets ``refused`` to 1.
    """

    pairs: int  # (tile, primitive) pairs
    in_float64: int  # primitives that are drawn in float64
    slots: int  # pixels of all pairs
    float64_pairs: int  # pairs of the primitives that are drawn in float64
    refused: Tensor  # (1,) int32 on the device

    @classmethod
    def around(
        cls, counts: Sequence[int], refused: Tensor, zeros: bool, least: "FrameCapacity | None" = None
    ) -> "FrameCapacity":
        """Return a capacity with the sizes 1.5 x ``counts`` + 256; ``counts`` has the order of the fields.

        No size is less than the same size of ``least``. With ``zeros``, a count of 0 gets the size 0 instead of 256.
        """
        sizes = [0 if zeros and not count else int(_MARGIN * count) + _SPARE for count in counts]
        if least is not None:
            sizes = [max(pair) for pair in zip(sizes, least.sizes, strict=True)]
        pairs, in_float64, slots, float64_pairs = sizes
        return cls(pairs, in_float64, slots, float64_pairs, refused)

    @property
    def sizes(self) -> tuple[int, int, int, int]:
        """The four sizes, in the order of the fields."""
        return (self.pairs, self.in_float64, self.slots, self.float64_pairs)

    def fits(self, counts: Sequence[int]) -> bool:
        """Return whether a frame with these counts, in the order of the fields, fits into the arrays."""
        return all(count <= size for count, size in zip(counts, self.sizes, strict=True))


@dataclass(frozen=True)
class TileCounts:
    """Sizes of a frame's arrays on the host, and running sums of the primitives' counts on the device."""

    pairs: int  # (tile, primitive) pairs
    in_float64: int  # primitives that are drawn in float64
    bad: int  # the first primitive that is not finite, or -1
    # (2, N) int64 on the device: running sums over primitives of the tiles reached, and of primitives in float64
    ends: Tensor


@dataclass(frozen=True)
class TileLists:
    """Pairs (tile, primitive), sorted by image (if there are several), then by tile, depth and index.

    With a :class:`FrameCapacity`, the arrays have room for more pairs, and zeros fill the rest. The last element of
    ``starts`` is the number of pairs.
    """

    starts: Tensor  # (tiles + 1,) int32, first pair of each tile, of all images
    ids: Tensor  # (pairs,) int32, primitive of each pair
    tile_of: Tensor  # (pairs,) int32, tile of each pair in its image
    first: Tensor  # (N + 1,) int32, first entry of each primitive in slots_of
    slots_of: Tensor  # (pairs,) int32, indices in ids of the pairs of primitive 0, then of primitive 1 and so on

    @property
    def pairs(self) -> int:
        return int(self.ids.shape[0])


def running_sums(counts: Tensor) -> Tensor:
    """Return the (R, N) int64 running sums of each row of ``counts``."""
    ends = torch.empty(counts.shape, dtype=torch.int64, device=counts.device)
    for row, out in zip(counts, ends, strict=True):  # torch's scan of a single row is ten times faster
        torch.cumsum(row, 0, dtype=torch.int64, out=out)
    return ends


def count_tiles(counts: Tensor, bad: Tensor, capacity: FrameCapacity | None = None) -> TileCounts:
    """Return the sizes of a frame's arrays and the running sums of ``counts``.

    Row 0 of ``counts`` (2, N) is the number of tiles that each primitive reaches; row 1 is 1 for primitives in float64.
    ``bad`` (1,) is the first primitive that is not finite, or N. Without a ``capacity``, the function waits for the
    device. Raises BackendUnavailable if there are 2^31 or more (tile, primitive) pairs.
    """
    ends = running_sums(counts)
    if capacity is not None:
        return TileCounts(capacity.pairs, capacity.in_float64, -1, ends)
    if counts.shape[1] == 0:
        return TileCounts(0, 0, -1, ends)
    pairs, in_float64, first_bad = torch.cat((ends[:, -1], bad.long())).tolist()
    if pairs >= _MOST:
        raise BackendUnavailable(
            f"primitives reach {pairs} tiles in all; the cuda backend can count at most {_MOST - 1}: "
            "render a smaller image"
        )
    return TileCounts(pairs, in_float64, first_bad if first_bad < counts.shape[1] else -1, ends)


@wp.func
def projected_covariance(p: ProjectedPrimitive, i: int, j: int):
    """Return entry (i, j) of B diag(s^2) B^T / m^2.

    B is the ellipsoid's orientation in camera axes, s its semi-axes, and m the longest semi-axis.
    """
    return wp.dot(wp.cw_mul(p.B[i], p.B[j]), wp.cw_mul(p.axes, p.axes))


@wp.func
def silhouette_screen_extent(p: ProjectedPrimitive, v: View, axis: int, s22: wp.float64, square: wp.float64):
    """Return the first and last pixel coordinate of an ellipsoid's silhouette along screen ``axis``, 0 (x) or 1 (y).

    The ellipsoid is first scaled by ``square``^0.5. ``s22`` is entry (2, 2) of :func:`projected_covariance` before
    scaling.
    """
    z, ci, szz = p.centre[2] / p.m, p.centre[axis] / p.m, square * s22
    sii, siz = square * projected_covariance(p, axis, axis), square * projected_covariance(p, axis, 2)
    D = z * z * sii - d(2.0) * ci * z * siz + ci * ci * szz - (sii * szz - siz * siz)
    root, mid, den = wp.sqrt(wp.max(D, d(0.0))), ci * z - siz, z * z - szz
    return wp.vec2d(
        v.focal[axis] * (mid - root) / den + v.centre[axis], v.focal[axis] * (mid + root) / den + v.centre[axis]
    )


@wp.struct
class SilhouetteSpans:
    """A silhouette as one span per pixel row; ``in_float64`` is 1 if float32 is not accurate over its spans, else 0.

    Pixel offsets (du, dv) are relative to the anchor pixel, which usually shows the centre. In the row at offset dv,
    the ends of the span are xc + skew (dv - yc) +- hx (1 - ((dv - yc)/hy)^2)^0.5. hx and hy are UNBOUNDED if the
    silhouette is not an ellipse.
    """

    skew: wp.float64
    xc: wp.float64
    yc: wp.float64
    hx: wp.float64
    hy: wp.float64
    in_float64: wp.int32


@wp.func
def silhouette_spans(p: ProjectedPrimitive, r: Ray, width: int, height: int, square: wp.float64):
    """Return the silhouette of an ellipsoid scaled by ``square``^0.5, in an image of ``width`` x ``height`` pixels.

    A ray with origin x and direction e hits the scaled ellipsoid if ``square`` |e|^2 > |x cross e|^2, in coordinates in
    which the unscaled ellipsoid is the unit sphere.
    """
    o = SilhouetteSpans()
    o.hx = _UNBOUNDED
    o.hy = _UNBOUNDED
    k0 = wp.cross(r.xa, r.e0)
    ka = wp.cross(r.xa, r.ex) + r.tc * wp.cross(r.ex, r.e0)
    kb = wp.cross(r.xa, r.ey) + r.tc * wp.cross(r.ey, r.e0)
    q0, q1 = square * wp.dot(r.e0, r.e0) - wp.dot(k0, k0), square * wp.dot(r.e0, r.ex) - wp.dot(k0, ka)
    q2, q3 = square * wp.dot(r.e0, r.ey) - wp.dot(k0, kb), square * wp.dot(r.ex, r.ex) - wp.dot(ka, ka)
    q4, q5 = square * wp.dot(r.ex, r.ey) - wp.dot(ka, kb), square * wp.dot(r.ey, r.ey) - wp.dot(kb, kb)
    d0, d1, d2 = q1 * q1 - q3 * q0, q1 * q4 - q3 * q2, q4 * q4 - q3 * q5
    if q3 < d(0.0) and d2 < d(0.0):
        yc = -d1 / d2
        peak = d0 + d1 * yc
        if peak > d(0.0):
            o.skew = round_projected_to_float32(-q4 / q3)
            o.xc = round_projected_to_float32(-(q1 + q4 * yc) / q3)
            o.yc = round_projected_to_float32(yc)
            o.hx = round_projected_to_float32(wp.sqrt(peak) / -q3)
            o.hy = round_projected_to_float32(wp.sqrt(-peak / d2))
            # the largest pixel offsets of the silhouette on the screen
            ux, uy, half = p.anchor[1], p.anchor[2], d(0.5)
            tall = wp.min(wp.abs(yc) + o.hy, wp.max(wp.abs(half - uy), wp.abs(d(height) - half - uy)))
            broad = wp.abs(o.xc) + wp.abs(o.skew) * (wp.abs(yc) + o.hy) + o.hx
            broad = wp.min(broad, wp.max(wp.abs(half - ux), wp.abs(d(width) - half - ux)))
            # the rest of sliding the origin, s G, and the two terms of the closest point: across a slanted needle, each
            # is many radii of its thin axis long, and they cancel
            slide = wp.abs(r.tu) * broad + wp.abs(r.tv) * tall
            if slide * (wp.sqrt(wp.dot(r.ex, r.ex)) * broad + wp.sqrt(wp.dot(r.ey, r.ey)) * tall) > _RADII:
                o.in_float64 = 1
            xu, xv = r.tc * r.ex + r.tu * r.e0, r.tc * r.ey + r.tv * r.e0
            for a in range(3):
                if wp.abs(xu[a]) * broad + wp.abs(xv[a]) * tall > _RADII:
                    o.in_float64 = 1
    return o


@wp.func
def longest_half_chord(p: ProjectedPrimitive, r: Ray, v: View, reach: wp.float64):
    """Return an upper bound, at most 1, of half the length of any chord, in units of the longest semi-axis.

    A chord is the part of a ray inside the ellipsoid. ``reach`` is the ellipsoid's half extent along camera z.
    """
    bound, one = d(1.0), d(1.0)
    if r.tc != d(0.0):
        z = p.centre[2]
        slope_x, slope_y, wide = wp.abs(p.centre[0] / z), wp.abs(p.centre[1] / z), p.m / (z - reach)
        du, dv = wide * (one + slope_x), wide * (one + slope_y)
        least = (
            wp.sqrt(wp.dot(r.e0, r.e0))
            - v.focal[0] * du * wp.sqrt(wp.dot(r.ex, r.ex))
            - v.focal[1] * dv * wp.sqrt(wp.dot(r.ey, r.ey))
        )
        most = wp.sqrt(one + (slope_x + du) * (slope_x + du) + (slope_y + dv) * (slope_y + dv))
        if least > most:
            bound = most / least
    return bound


@wp.func
def _chord_bound_by_edge(edge: int, hard: wp.float64, one: wp.float64, two: wp.float64):
    """Return ``hard``, ``one`` or ``two`` for edge exponent 0, 1 or 2; indexing an array would need stack memory."""
    number = hard
    if edge == 1:
        number = one
    if edge == 2:
        number = two
    return number


@wp.func
def is_too_faint_to_draw(most: wp.float64, edge: int, least: wp.float64):
    """Return whether no chord of a primitive with b2 + sum |w2| = ``most`` can reach the optical depth ``least``."""
    return most <= d(0.0) or most * _chord_bound_by_edge(edge, _N0, _N1, _N2) <= least


@wp.func
def visible_square(most: wp.float64, bound: wp.float64, edge: int, least: wp.float64):
    """Return r^2, where only rays through the ellipsoid scaled by r can reach the optical depth ``least``.

    r^2 is 0 if no ray can reach ``least``. ``most`` is b2 + sum |w2|. Half chords are at most ``bound``, in units of
    the longest semi-axis.
    """
    square, share = d(0.0), least / (most * _chord_bound_by_edge(edge, _N0, _N1, _N2) * bound)
    if share <= _chord_bound_by_edge(edge, _W0, _W1, _W2):
        square = d(1.0)
    elif share < d(1.0):
        square = round_projected_to_float32(d(1.0) - wp.exp(wp.log(share) * _chord_bound_by_edge(edge, _P0, _P1, _P2)))
    return square


@wp.struct
class Ellipse:
    """A primitive's silhouette on the screen, in pixels, from the float32 values that pixel kernels read.

    With d = y + ``base``, the silhouette covers row y between ``middle`` + ``skew`` d - h and ``middle`` + ``skew`` d +
    h, where h = ``hx`` (1 - (d/``hy``)^2)^0.5. The rightmost point has d = ``peak``, the leftmost point d = -``peak``.
    If ``bounded`` is 0, the silhouette is not an ellipse, and only the ``box`` (x0, y0, x1, y1) is valid.
    """

    box: wp.vec4i
    bounded: wp.int32
    hx: wp.float64
    hy: wp.float64
    skew: wp.float64
    base: wp.float64
    middle: wp.float64
    peak: wp.float64


@wp.func
def silhouette_ellipse(span: wp.vec4, hy: wp.float32, ux: wp.float32, uy: wp.float32, box: wp.vec4i):
    """Return the ellipse of a silhouette from ``span`` (SKEW, XC, YC, HX), ``hy`` and the anchor (``ux``, ``uy``)."""
    e = Ellipse()
    e.box = box
    e.skew = d(span[0])
    e.hx = d(span[3])
    e.hy = d(hy)
    if e.hy < _UNBOUNDED:
        e.bounded = 1
    e.base = d(0.5) - d(uy) - d(span[2])
    e.middle = d(span[1]) + d(ux)
    e.peak = e.skew * e.hy * e.hy / wp.sqrt(e.hx * e.hx + e.skew * e.skew * e.hy * e.hy)  # where it is furthest right
    return e


@wp.func
def tile_range(e: Ellipse, ty: int):
    """Return the range [first, end) of the tiles that the silhouette ``e`` reaches in tile row ``ty``."""
    lo, hi = e.box[0] // _TILE, (e.box[2] - 1) // _TILE + 1
    if e.bounded > 0:
        d0 = wp.max(d(wp.max(ty * _TILE, e.box[1])) + e.base, -e.hy)
        d1 = wp.min(d(wp.min(ty * _TILE + _TILE, e.box[3]) - 1) + e.base, e.hy)
        x0, x1 = d(1.0), d(0.0)
        if d1 >= d0:
            one, zero, over = d(1.0), d(0.0), d(1.0) / e.hy
            a, b = wp.min(wp.max(e.peak, d0), d1), wp.min(wp.max(-e.peak, d0), d1)
            right = e.skew * a + e.hx * wp.sqrt(wp.max(one - (a * over) * (a * over), zero)) + e.middle
            left = e.skew * b - e.hx * wp.sqrt(wp.max(one - (b * over) * (b * over), zero)) + e.middle
            x0 = wp.max(wp.ceil(left - d(0.501)), d(e.box[0]))
            x1 = wp.min(wp.floor(right - d(0.499)), d(e.box[2] - 1))
        hi = lo
        if x1 >= x0:
            lo, hi = int(x0) // _TILE, int(x1) // _TILE + 1
    return wp.vec2i(lo, hi)


@wp.func
def _primitives_fit(ends: Longs2d, pairs: int, which: Ints):
    """Return whether a frame's pairs and float64 primitives fit into the arrays.

    ``ends`` holds the running sums of the counts, ``pairs`` and the length of ``which`` are the sizes of the arrays.
    """
    last = ends.shape[1] - 1
    return ends[0, last] <= wp.int64(pairs) and ends[1, last] <= wp.int64(which.shape[0])


@functools.cache
def _binning_kernels(short: bool) -> tuple[Any, Any]:
    """Return the kernels ``emit`` and ``list_pairs``, with int32 sort keys if ``short``, else int64.

    int32 keys sort in half the time.
    """
    number = wp.int32 if short else wp.int64
    Keys: Any = wp.array(dtype=number)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def emit(
        rows: Vec4s2d, spans: Vec4s2d, boxes: Vec4is, order: Longs, counts: Ints2d, ends: Longs2d, across: int,
        images: Ints, tiles: int, first: Ints, keys: Keys, slots: Ints, which: Ints,
    ):  # fmt: skip
        """Write one sort key, tile x N + rank, for each tile that a primitive reaches; one thread per rank.

        N is the number of primitives. The rank of a primitive is its position in the order of depth. The kernel also
        fills ``first``, ``slots`` and ``which``, see :func:`bin_primitives`. ``tiles`` is the number of tiles per image
        if there are several images, else 0.
        """
        rank = wp.tid()
        i = int(order[rank])
        fits = _primitives_fit(ends, keys.shape[0], which)
        last = int(0)
        if fits:
            last = int(ends[0, i])
        first[i + 1] = last
        slots[i] = -1
        if fits and counts[1, i] > 0:
            slots[i] = int(ends[1, i]) - 1
            which[slots[i]] = i
        if fits and counts[0, i] > 0:
            box, at = boxes[i], last - counts[0, i]
            origin = int(0)
            if tiles > 0:
                origin = images[i] * tiles
            e = silhouette_ellipse(spans[i, 0], spans[i, 1][0], rows[i, _E0][3], rows[i, _EX][3], box)
            for ty in range(box[1] // _TILE, (box[3] - 1) // _TILE + 1):
                lo_hi = tile_range(e, ty)
                for tx in range(lo_hi[0], lo_hi[1]):
                    keys[at] = number(origin + ty * across + tx) * number(order.shape[0]) + number(rank)
                    at += 1

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def list_pairs(
        keys: Keys, came_from: Longs, order: Longs, ends: Longs2d, which: Ints, tiles: int, each: int,
        starts: Ints, ids: Ints, tile_of: Ints, slots_of: Ints,
    ):  # fmt: skip
        """Fill the tile lists from the sorted ``keys``; each thread handles one key.

        ``tiles`` is the number of tiles of all images, ``each`` the number of tiles of one image.
        """
        k = wp.tid()
        pairs = int(0)
        if _primitives_fit(ends, keys.shape[0], which):
            pairs = int(ends[0, ends.shape[1] - 1])
        if k >= pairs:
            return
        count = number(order.shape[0])
        tile, rank = int(keys[k] // count), int(keys[k] % count)
        ids[k] = int(order[rank])
        tile_of[k] = tile % each
        slots_of[int(came_from[k])] = k
        before = wp.int32(-1)
        if k > 0:
            before = int(keys[k - 1] // count)
        for t in range(before + 1, tile + 1):
            starts[t] = k
        if k == pairs - 1:
            for t in range(tile + 1, tiles + 1):
                starts[t] = pairs

    return emit, list_pairs


def bin_primitives(
    rows: Tensor,
    spans: Tensor,
    boxes: Tensor,
    depth: Tensor,
    counts: Tensor,
    counted: TileCounts,
    camera: Camera,
    images: tuple[Tensor, int] | None = None,
) -> tuple[TileLists, Tensor, Tensor]:
    """Return a frame's tile lists, and ``slots`` and ``which`` of the primitives that are drawn in float64.

    ``slots`` (N,) has the float64 row of each primitive, or -1; ``which`` has the primitive of each float64 row.
    ``images`` holds each primitive's image index, (N,) int32, and the number of images; None means one image.
    ``counts`` is the argument of :func:`count_tiles` and ``counted`` its result. The other tensors are fields of
    :class:`~neuprim.core.render.cuda.prepare.Frame`.
    """
    device, N, pairs = rows.device, depth.shape[0], counted.pairs
    across, down = -(-camera.width // L.TILE), -(-camera.height // L.TILE)
    image_of, several = (None, 1) if images is None else (array(images[0], wp.int32), images[1])
    each = across * down

    # zeros: there may be fewer pairs, and zero is an index
    sizes = [pairs, pairs, pairs, several * each + 1, N + 1, N, counted.in_float64]
    ids, tile_of, slots_of, starts, first, slots, which = torch.zeros(
        sum(sizes), dtype=torch.int32, device=device
    ).split(sizes)

    dtype = torch.int32 if several * each * N < torch.iinfo(torch.int32).max else torch.int64
    emit, list_pairs = _binning_kernels(dtype == torch.int32)
    number = wp.int32 if dtype == torch.int32 else wp.int64
    order = torch.argsort(depth, stable=True)
    keys = torch.full((pairs,), torch.iinfo(dtype).max, dtype=dtype, device=device)  # sorts behind all pairs
    reached = (
        array(rows, wp.vec4), array(spans.view(N, 2, 4), wp.vec4), array(boxes, wp.vec4i), array(order, wp.int64),
        array(counts, wp.int32),
        array(counted.ends, wp.int64), across, image_of, 0 if images is None else each, array(first, wp.int32),
        array(keys, number), array(slots, wp.int32), array(which, wp.int32),
    )  # fmt: skip
    launch_kernel(emit, N, reached, device, PER_BLOCK)
    keys, came_from = torch.sort(keys)
    found = (
        array(keys, number), array(came_from, wp.int64), array(order, wp.int64), array(counted.ends, wp.int64),
        array(which, wp.int32), several * each, each,
        array(starts, wp.int32), array(ids, wp.int32), array(tile_of, wp.int32), array(slots_of, wp.int32),
    )  # fmt: skip
    launch_kernel(list_pairs, pairs, found, device)
    return TileLists(starts, ids, tile_of, first, slots_of), slots, which
