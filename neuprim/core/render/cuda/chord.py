# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""One pixel's chord on the device, forward and backward: :mod:`neuprim.core.render.cpu.chord` in vectors.

An optical depth is I = N_p |d| D^p half field, with field the mean of the density's numerator, weighted by the edge.
"""

from __future__ import annotations

from typing import Any

from neuprim.core.compute.warp import wp
from neuprim.core.render.cuda import layout as L


@wp.struct
class Ray:
    """What a chord reads of a primitive's row, but for what its loops read themselves."""

    e0: wp.vec4
    ex: wp.vec4
    ey: wp.vec4
    xa: wp.vec4
    xu: wp.vec4
    xv: wp.vec4


@wp.struct
class Chord:
    """A pixel's ray in whitened space; t counts in units of m from an origin slid by ``slide``."""

    du: float  # pixel offset from the anchor
    dv: float
    slide: float
    e: wp.vec3  # direction
    x: wp.vec3  # closest point
    D: float  # 1 - |x|^2
    ia: float  # 1/(e.e)
    tm: float  # where the closest point is
    h: float  # half chord before the near plane cuts it
    uncut: float  # 1 where it does not
    mid: float
    half: float  # 0 where the ray misses


@wp.func
def xyz(a: wp.vec4):
    return wp.vec3(a[0], a[1], a[2])


@wp.func
def neuron_phase(q: wp.vec3, w: wp.vec4):
    """Of a neuron at q, in turns: three multiplications with additions, as the sum begins with its own phase."""
    return w[3] + q[0] * w[0] + q[1] * w[1] + q[2] * w[2]


@wp.func
def load_ray(rows: Any, j: int):
    """From row ``j`` of a tile of rows or of the whole array."""
    r = Ray()
    r.e0 = rows[j, L.E0]
    r.ex = rows[j, L.EX]
    r.ey = rows[j, L.EY]
    r.xa = rows[j, L.XA]
    r.xu = rows[j, L.XU]
    r.xv = rows[j, L.XV]
    return r


@wp.func
def intersect_chord(r: Ray, px: float, py: float):
    """Of the pixel centre (px, py)."""
    c = Chord()
    c.du = px - r.e0[3]
    c.dv = py - r.ex[3]
    G = c.du * xyz(r.ex) + c.dv * xyz(r.ey)
    c.e = xyz(r.e0) + G
    c.slide = c.du * r.xu[3] + c.dv * r.xv[3]
    m = xyz(r.xa) + c.du * xyz(r.xu) + c.dv * xyz(r.xv) + c.slide * G
    c.ia = 1.0 / wp.dot(c.e, c.e)
    c.tm = -wp.dot(m, c.e) * c.ia
    c.x = m + c.tm * c.e
    c.D = 1.0 - c.x[0] * c.x[0] - c.x[1] * c.x[1] - c.x[2] * c.x[2]
    c.h = wp.sqrt(wp.max(c.D, 1.0e-12) * c.ia)
    near = r.ey[3] - c.slide
    t0 = c.tm - c.h
    c.uncut = wp.where(t0 > near, 1.0, 0.0)
    t0 = wp.max(t0, near)
    c.half = 0.5 * (c.tm + c.h - t0)
    c.mid = t0 + c.half
    if c.D <= 0.0 or c.half < 0.0:
        c.half = 0.0
    return c


@wp.struct
class Pull:
    """dL/d(origin m, direction e) of a ray."""

    m: wp.vec3
    e: wp.vec3


@wp.func
def chord_ends_backward(
    c: Chord, g_half: float, g_mid: float, g_tm: float, gD: float, gA: float, gq: wp.vec3, gv: wp.vec3
):
    """From dL/d(half, mid), dL/d(chord middle) = gq, dL/d(half e) = gv; gD has what reaches D through ``h``, too."""
    gt1 = 0.5 * (g_mid + g_half)
    gt0 = 0.5 * (g_mid - g_half) * c.uncut
    tm = g_tm + gt0 + gt1
    g_h = gt1 - gt0
    a = gA - (0.5 * g_h * c.h + tm * c.tm) * c.ia
    b = -tm * c.ia
    m2 = -2.0 * gD
    out = Pull()
    out.m = gq + m2 * c.x + b * c.e
    out.e = c.half * gv + c.mid * gq + (c.tm * m2 + b) * c.x + (2.0 * a - b * c.tm) * c.e
    return out


@wp.func
def chord_backward(c: Chord, g_half: float, g_mid: float, gD: float, by_depth: float, gq: wp.vec3, gv: wp.vec3):
    """The same in float32, where dh/dD = ``by_depth`` and nothing reaches a ray on other ways than D and the ends."""
    gt1 = 0.5 * (g_mid + g_half)
    gt0 = 0.5 * (g_mid - g_half) * c.uncut
    return chord_ends_backward(c, g_half, g_mid, 0.0, gD + (gt1 - gt0) * by_depth, 0.0, gq, gv)


@wp.func
def pixel_of_lane(lane: int):
    """(x, y) in the tile of a block's thread: a warp covers 8 x 4 pixels, which small primitives fill better."""
    return wp.vec2i((lane & 7) | ((lane >> 2) & 8), ((lane >> 3) & 3) | ((lane >> 4) & 12))


@wp.func
def slot_of_pixel(span: int, offset: int, x: int):
    """Slot of pixel x of a tile row, -1 outside its span (start << 8 | last << 4 | first)."""
    slot = int(-1)
    if x >= (span & 15) and x <= ((span >> 4) & 15):
        slot = offset + (span >> 8) + x - (span & 15)
    return slot


@wp.func
def pixel_of_slot(spans: Any, n: int, s: int):
    """(x, y) in the tile of pixel ``s`` of pair ``n``: in the last row of ``spans`` that starts at or before it."""
    y = int(0)
    for b in range(4):
        if int(spans[n, y + (8 >> b)]) >> 8 <= s:
            y += 8 >> b
    row = int(spans[n, y])
    return wp.vec2i((row & 15) + s - (row >> 8), y)
