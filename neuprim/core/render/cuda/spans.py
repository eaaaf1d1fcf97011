# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Which pixels of a tile a primitive's silhouette covers: a span in each of its 16 rows.

Each pixel inside has a slot of its own, in the order of pairs, rows and pixels, where the forward pass leaves what the
backward pass needs: a fifth of the memory of whole tiles, and lists without gaps for the pass over pairs.
"""

from __future__ import annotations

from neuprim.core.compute.warp import OPTIONS, wp
from neuprim.core.render.cpu.layout import HX, HY, SKEW, XC, YC
from neuprim.core.render.cuda import layout as L

__all__ = ["row_spans"]

_MARGIN, _ROUNDING = 2e-3, 4e-7  # pixels, and per pixel of the ellipse; a pixel too many is rejected by its own D


@wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
def row_spans(
    rows: wp.array2d(dtype=wp.vec4),
    silhouettes: wp.array2d(dtype=wp.float32),
    boxes: wp.array(dtype=wp.vec4i),
    ids: wp.array(dtype=wp.int32),
    tiles: wp.array(dtype=wp.int32),
    size: wp.vec2i,
    spans: wp.array2d(dtype=wp.uint16),
    counts: wp.array(dtype=wp.int32),
):
    """Thread n: the rows of pair n, start << 8 | last << 4 | first, and how many pixels they have together."""
    n = wp.tid()
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
        spans[n, y] = wp.uint16(start << 8 | last << 4 | first)
    counts[n] = total
