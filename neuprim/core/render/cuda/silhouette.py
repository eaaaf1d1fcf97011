# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Which tiles a primitive's silhouette reaches, row by row: exact for ellipses, up to a margin of 1e-3 pixels; the twin
of ``_reached``."""

from neuprim.core.compute.warp import wp
from neuprim.core.render.cpu.layout import UNBOUNDED
from neuprim.core.render.cuda.layout import TILE

__all__ = ["Ellipse", "ellipse", "tile_range"]

d = wp.float64
_TILE, _UNBOUNDED = TILE, wp.constant(d(UNBOUNDED))


@wp.struct
class Ellipse:
    """A silhouette on the screen, from the float32 numbers that the pixel kernels read; ``box`` in pixels."""

    box: wp.vec4i
    bounded: wp.int32
    hx: wp.float64
    hy: wp.float64
    skew: wp.float64
    base: wp.float64
    middle: wp.float64
    peak: wp.float64


@wp.func
def ellipse(span: wp.vec4, hy: wp.float32, ux: wp.float32, uy: wp.float32, box: wp.vec4i):
    """``span``: SKEW, XC, YC, HX."""
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
    """First tile and one past the last that the silhouette reaches in row ``ty`` of tiles; nothing, where they are
    equal."""
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
