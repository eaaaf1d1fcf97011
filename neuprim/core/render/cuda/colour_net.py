# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Evaluate the colour network of each primitive; the CUDA version of :mod:`neuprim.core.render.cpu.colour_net`.

A network maps the middle of a ray's chord to a colour. The row of a network is computed once per primitive, in float64.
A *hue* is the colour before max(0, .) in one slot (one pixel of a (tile, primitive) pair). The forward pass saves the
hues. The gradient of a network reaches a ray only through the chord's middle, and is added to the gradient row of the
density.
"""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import (
    FAST,
    OPTIONS,
    Bools2d,
    Doubles2d,
    Floats,
    Floats2d,
    Floats3d,
    Ints,
    Shorts2d,
    Vec2s,
    Vec3s,
    Vec3s2d,
    Vec4ds2d,
    Vec4s,
    Vec4s2d,
    array,
    launch_kernel,
    wp,
)
from neuprim.core.render import layout as W
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.block_ops import gradient_row_sums, gradient_row_type
from neuprim.core.render.cuda.chord import (
    TAU,
    chord_backward,
    cos_turns,
    intersect_chord,
    load_ray,
    neuron_phase,
    pixel_of_slot,
    sin_turns,
    xyz,
)
from neuprim.core.render.cuda.float64 import chord_backward64, intersect_chord64
from neuprim.core.render.cuda.layout import KernelForm
from neuprim.core.render.cuda.prepare_backward import quaternion_gradient
from neuprim.core.render.cuda.projection import EXACT, PER_BLOCK, View, project_primitive

FIRST_COLOUR = L.G_NEURONS
"""First of the C columns of the constant colour in a network's gradient row. The columns of the ray come before these C
columns; the columns (WX, WY, WZ, PHASE, C weights) of each unit follow."""

d, f = wp.float64, wp.float32
_TURNS = wp.constant(d(1.0 / (2.0 * math.pi)))
_TWO_PI = wp.constant(d(TAU))
_FAST = wp.constant(d(W.FLOAT64_TURNS**2))


@dataclass
class ColourNet:
    """The colour networks of a frame; parameters are contiguous, all float32 or all float64."""

    Wx: Tensor  # (N, H, 3)
    bias: Tensor  # (N, H)
    Wout: Tensor  # (N, C, H)
    rows: Tensor  # (N, H rasterizer_net_columns(C), 4) float32, see rasterizer_net_columns
    fast: Tensor  # (N,) bool, whether the phase of a unit changes too fast along a chord for float32
    wide: Tensor  # (M, H, 4) float64 (WX, WY, WZ, PHASE) of the primitives that are drawn in float64

    @property
    def hidden(self) -> int:
        return int(self.Wx.shape[1])


@wp.func
def _whitened_unit(log_scale: wp.vec3d, quat: wp.vec4d, w: wp.vec3d, phase: wp.float64):
    """Return (WX, WY, WZ, PHASE) of a network unit: frequencies in turns per semi-axis, and the phase in turns.

    ``w`` holds the unit's frequencies on scene axes, in radians per longest semi-axis; ``phase`` is the unit's phase in
    radians.
    """
    p = project_primitive(wp.vec3d(), log_scale, quat, View())
    on_axes = _TURNS * wp.cw_mul(p.axes, wp.transpose(p.local) * w)
    turns = _TURNS * phase
    return wp.vec4d(on_axes[0], on_axes[1], on_axes[2], turns - wp.rint(turns))


@functools.cache
def _colour_net_kernels(double: bool) -> tuple[Any, Any, Any]:
    """Return the kernels ``fill_rows``, ``prepare_wide`` and ``backward``; parameters are float64 if ``double``."""
    real, vec3, vec4 = (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def fill_rows(
        log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4), Wx: wp.array2d(dtype=vec3),
        bias: wp.array2d(dtype=real),
        Wout: wp.array3d(dtype=real), channels: int, rows: Vec4s2d, fast: Bools2d,
    ):  # fmt: skip
        """Fill the float32 rows of the colour networks; thread (i, j) handles unit j of primitive i."""
        i, j = wp.tid()
        unit = _whitened_unit(wp.vec3d(log_scales[i]), wp.vec4d(quats[i]), wp.vec3d(Wx[i, j]), d(bias[i, j]))
        fast[i, j] = unit[0] * unit[0] + unit[1] * unit[1] + unit[2] * unit[2] > _FAST
        at = j * (1 + (channels + 3) // 4)
        rows[i, at] = wp.vec4(unit)
        for first in range(0, channels, 4):
            out = wp.vec4()
            for c in range(4):
                if first + c < channels:
                    out[c] = f(Wout[i, first + c, j])
            rows[i, at + 1 + first // 4] = out

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def prepare_wide(
        which: Ints, log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4), Wx: wp.array2d(dtype=vec3),
        bias: wp.array2d(dtype=real), wide: Vec4ds2d,
    ):  # fmt: skip
        """Fill the float64 rows of the colour networks; thread (m, j) handles unit j of primitive ``which[m]``."""
        m, j = wp.tid()
        i = which[m]
        wide[m, j] = _whitened_unit(wp.vec3d(log_scales[i]), wp.vec4d(quats[i]), wp.vec3d(Wx[i, j]), d(bias[i, j]))

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def backward(
        log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4), Wx: wp.array2d(dtype=vec3), hidden: int,
        channels: int, weights: Floats2d, grads: Floats2d, first: int, g_log_scales: Vec3s, g_quats: Vec4s,
        g_Wx: Vec3s2d, g_bias: Floats2d, g_Wout: Floats3d,
    ):  # fmt: skip
        """Compute the parameter gradients of the colour networks; thread i handles primitive i.

        ``weights`` are the gradient rows of the density. If ``weights[i, G_WEIGHT]`` is 0, the primitive is not visible
        and has zero gradients. The kernel adds to g_log_scales and g_quats, and overwrites the other gradients.
        """
        i = wp.tid()
        seen = weights[i, wp.static(L.G_WEIGHT)] > f(0.0)
        logs, quat = wp.vec3d(log_scales[i]), wp.vec4d(quats[i])
        p = project_primitive(wp.vec3d(), logs, quat, View())
        gL, gl, log_m = wp.mat33d(), wp.vec3d(), d(0.0)
        for j in range(hidden):
            at = first + j * (4 + channels)
            if seen:
                w = wp.vec3d(Wx[i, j])
                g = wp.vec3d(d(grads[i, at]), d(grads[i, at + 1]), d(grads[i, at + 2]))
                gw = _TURNS * wp.cw_mul(g, p.axes)
                gL += wp.outer(w, gw)
                scaled = wp.cw_mul(gw, wp.transpose(p.local) * w)  # the first layer on whitened axes scales with s_a/m
                gl += scaled
                log_m -= scaled[0] + scaled[1] + scaled[2]
                g_Wx[i, j] = wp.vec3(p.local * gw)
                g_bias[i, j] = f(_TURNS * d(grads[i, at + 3]))
                for c in range(channels):
                    g_Wout[i, c, j] = grads[i, at + 4 + c]
            else:
                g_Wx[i, j] = wp.vec3()
                g_bias[i, j] = f(0.0)
                for c in range(channels):
                    g_Wout[i, c, j] = f(0.0)
        if seen:
            if logs[2] > wp.max(logs[0], logs[1]):  # the first of the longest axes is m
                gl[2] += log_m
            elif logs[1] > logs[0]:
                gl[1] += log_m
            else:
                gl[0] += log_m
            g_log_scales[i] = g_log_scales[i] + wp.vec3(gl)
            g_quats[i] = g_quats[i] + wp.vec4(quaternion_gradient(quat, p.inverse, gL))

    return fill_rows, prepare_wide, backward


def _kernel_types(double: bool) -> tuple[Any, Any, Any]:
    """Return the Warp types of numbers, 3-vectors and 4-vectors in float64 (``double``) or float32."""
    return (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)


def prepare_rasterizer_colour_net(
    log_scales: Tensor, quats: Tensor, Wx: Tensor, bias: Tensor, Wout: Tensor
) -> ColourNet:
    """Return the colour networks of all primitives with their float32 rows.

    The field ``wide`` stays empty until :func:`fill_wide_net` fills it.
    """
    tensors = (log_scales, quats, Wx, bias, Wout)
    double = any(x.dtype == torch.float64 for x in tensors)
    dtype = torch.float64 if double else torch.float32
    log_scales, quats, Wx, bias, Wout = (x.detach().to(dtype).contiguous() for x in tensors)
    (N, H, _), C, device = Wx.shape, Wout.shape[1], Wx.device
    real, vec3, vec4 = _kernel_types(double)
    rows = torch.empty(N, H * L.rasterizer_net_columns(C), 4, device=device)
    fast = torch.empty(N, H, dtype=torch.bool, device=device)
    launch_kernel(
        _colour_net_kernels(double)[0], (N, H),
        (
            array(log_scales, vec3), array(quats, vec4), array(Wx, vec3), array(bias, real), array(Wout, real), C,
            array(rows, wp.vec4), array(fast, wp.bool),
        ), device, PER_BLOCK,
    )  # fmt: skip
    return ColourNet(Wx, bias, Wout, rows, fast.any(1), torch.empty(0, H, 4, dtype=torch.float64, device=device))


def fill_wide_net(net: ColourNet, which: Tensor, log_scales: Tensor, quats: Tensor) -> None:
    """Fill ``net.wide``, the float64 network rows of the primitives ``which`` (M,) int32 that are drawn in float64."""
    M, H, device = len(which), net.hidden, net.Wx.device
    double = net.Wx.dtype == torch.float64
    real, vec3, vec4 = _kernel_types(double)
    net.wide = torch.empty(M, H, 4, dtype=torch.float64, device=device)
    launch_kernel(
        _colour_net_kernels(double)[1], (M, H),
        (
            array(which, wp.int32), array(log_scales.to(net.Wx), vec3), array(quats.to(net.Wx), vec4),
            array(net.Wx, vec3), array(net.bias, real),
            array(net.wide, wp.vec4d),
        ), device, PER_BLOCK,
    )  # fmt: skip


def colour_net_backward(
    net: ColourNet, parameters: Sequence[Tensor], weights: Tensor, grads: Tensor, out: Sequence[Tensor]
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the float32 gradients of Wx, bias and Wout; add the gradients of log_scales and quats to ``out``.

    ``parameters`` and ``out`` are the tensors of :data:`~neuprim.core.render.rasterize.PARAMETERS` and their gradients.
    ``weights`` holds the gradient rows of the density, ``grads`` the gradient rows of the networks; both have N rows.
    """
    _, log_scales, quats, *_ = parameters
    _, g_log_scales, g_quats, *_ = out
    first = FIRST_COLOUR + int(net.Wout.shape[1])
    double = net.Wx.dtype == torch.float64
    _, vec3, vec4 = _kernel_types(double)
    g_Wx, g_bias, g_Wout = (
        torch.empty(x.shape, dtype=torch.float32, device=x.device) for x in (net.Wx, net.bias, net.Wout)
    )
    launch_kernel(
        _colour_net_kernels(double)[2], net.Wx.shape[0],
        (
            array(log_scales.to(net.Wx), vec3), array(quats.to(net.Wx), vec4), array(net.Wx, vec3), net.hidden,
            int(net.Wout.shape[1]),
            array(weights, wp.float32), array(grads, wp.float32), first, array(g_log_scales, wp.vec3),
            array(g_quats, wp.vec4),
            array(g_Wx, wp.vec3), array(g_bias, wp.float32), array(g_Wout, wp.float32),
        ), net.Wx.device, PER_BLOCK,
    )  # fmt: skip
    return g_Wx, g_bias, g_Wout


def net_gradient_row_width(form: KernelForm) -> int:
    """Return the number of columns of a colour network's gradient row (gradients of one primitive's network)."""
    return L.gradient_width(0, form.channels, form.hidden)


@functools.cache
def rasterizer_net_gradient_kernel(form: KernelForm) -> Any:
    """Return a kernel that computes the gradients of colour networks and, through the chords' middles, of the rays.

    One warp handles one (tile, primitive) pair.
    """
    C, H, P = form.channels, form.hidden, form.edge
    each, width = L.rasterizer_net_columns(C), net_gradient_row_width(form)
    columns, net_columns = L.rasterizer_row_columns(form.neurons, C), max(H * each, 1)
    row_of, add_lanes = gradient_row_type(width), gradient_row_sums(width)
    vecC = wp.types.vector(length=C, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False)
    def net_pairs(
        rows: Vec4s2d, net: Vec4s2d, ids: Ints, tiles: Ints, spans: Shorts2d, offsets: Ints, depth_floor: float,
        size: wp.vec2i, reached: Ints, hits: Vec2s, hues: Floats2d, g_rgb: Floats2d, out: Floats,
    ):  # fmt: skip
        n, lane = wp.tid()
        tile = tiles[n]
        across = (size[0] + L.TILE - 1) // L.TILE
        i = ids[n]
        if rows[i, L.REST][3] == 0.0:  # a float64 kernel writes the rows of the others
            total = row_of()
            if n < reached[tile]:
                which = wp.tile_load(ids, shape=1, offset=n, storage="shared")
                row = wp.tile_load_indexed(rows, indices=which, shape=(1, columns), axis=0, storage="shared")
                units = wp.tile_load_indexed(net, indices=which, shape=(1, net_columns), axis=0, storage="shared")
                begin = offsets[n]
                left = (tile % across) * L.TILE  # outside the loop, as no compiler moves a division
                top = (tile // across) * L.TILE
                for s in range(lane, offsets[n + 1] - begin, wp.static(L.WARP)):
                    weight = hits[begin + s][1]
                    if weight > 0.0:
                        at = pixel_of_slot(spans, n, s)
                        X = left + at[0]
                        Y = top + at[1]
                        c = intersect_chord(load_ray(row, 0), float(X) + 0.5, float(Y) + 0.5)
                        q = c.x + (c.mid - c.tm) * c.e
                        g = vecC()
                        for k in range(wp.static(C)):
                            if hues[begin + s, k] >= 0.0:
                                g[k] = weight * g_rgb[Y * size[0] + X, k]
                            total[wp.static(L.G_NEURONS + k)] += g[k]
                        gq = wp.vec3()
                        for j in range(wp.static(H)):
                            w = units[0, wp.static(each * j)]
                            u = neuron_phase(q, w)
                            r = u - wp.rint(u)
                            cosine = cos_turns(r * r)
                            pull = float(0.0)
                            mixed = wp.vec4()
                            for k in range(wp.static(C)):
                                if wp.static(k % 4 == 0):
                                    mixed = units[0, wp.static(each * j + 1 + k // 4)]
                                pull += mixed[wp.static(k % 4)] * g[k]
                                total[wp.static(L.G_NEURONS + C + (4 + C) * j + 4 + k)] += g[k] * cosine
                            gu = -TAU * sin_turns(r) * pull
                            total[wp.static(L.G_NEURONS + C + (4 + C) * j)] += gu * q[0]
                            total[wp.static(L.G_NEURONS + C + (4 + C) * j + 1)] += gu * q[1]
                            total[wp.static(L.G_NEURONS + C + (4 + C) * j + 2)] += gu * q[2]
                            total[wp.static(L.G_NEURONS + C + (4 + C) * j + 3)] += gu
                            gq += gu * xyz(w)
                        D = wp.max(c.D, 1.0e-12)
                        by_depth = 0.5 * c.h / D
                        if wp.static(P == 0):
                            by_depth = 0.5 * c.ia / wp.sqrt(wp.max(D, depth_floor) * c.ia)
                        pulled = chord_backward(c, 0.0, wp.dot(gq, c.e), 0.0, by_depth, gq, wp.vec3())
                        gE = pulled.e + c.slide * pulled.m
                        gG = pulled.e + (row[0, L.REST][0] + c.slide) * pulled.m
                        for k in range(3):
                            total[k] += gE[k]
                            total[3 + k] += c.du * gG[k]
                            total[6 + k] += c.dv * gG[k]
                            total[9 + k] += pulled.m[k]
            add_lanes(total, lane, out, n)

    return net_pairs


@functools.cache
def float64_hues_kernel(channels: int) -> Any:
    """Return a kernel that computes the hues (colours before max(0, .)) of float64 pairs in all their slots."""

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def float64_hues(
        pairs: Ints, wide: Doubles2d, net: Vec4ds2d, mixes: Vec4s2d, rows: Vec4s2d, first: int, hidden: int,
        slots: Ints, ids: Ints, tiles: Ints, spans: Shorts2d, offsets: Ints, size: wp.vec2i, hues: Floats2d,
    ):  # fmt: skip
        """Fill ``hues`` in the slots of ``pairs``, one warp per pair.

        ``mixes`` holds the output weights of the units; ``rows`` holds constant colours from column ``first``.
        """
        member, lane = wp.tid()
        n = pairs[member]
        i, r = ids[n], slots[ids[n]]
        across = (size[0] + L.TILE - 1) // L.TILE
        begin = offsets[n]
        for s in range(lane, offsets[n + 1] - begin, wp.static(L.WARP)):
            at = pixel_of_slot(spans, n, s)
            c = intersect_chord64(wide, r, (tiles[n] % across) * L.TILE + at[0], (tiles[n] // across) * L.TILE + at[1])
            for k in range(wp.static(channels)):
                hue = d(rows[i, first + k // 4][k % 4])
                for j in range(hidden):
                    w = net[r, j]
                    u = wp.dot(c.q, wp.vec3d(w[0], w[1], w[2])) + w[3]
                    mixed = mixes[i, j * wp.static(L.rasterizer_net_columns(channels)) + 1 + k // 4][k % 4]
                    hue += d(mixed) * wp.cos(_TWO_PI * (u - wp.rint(u)))
                hues[begin + s, k] = float(hue)

    return float64_hues


@functools.cache
def float64_net_kernel(form: KernelForm) -> Any:
    """Return the float64 version of :func:`rasterizer_net_gradient_kernel`, for float64 pairs."""
    C = form.channels
    each, width = L.rasterizer_net_columns(C), net_gradient_row_width(form)
    row_of, add_lanes = gradient_row_type(width), gradient_row_sums(width)
    vecC = wp.types.vector(length=C, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def float64_net(
        pairs: Ints, wide: Doubles2d, net: Vec4ds2d, mixes: Vec4s2d, hidden: int, slots: Ints, ids: Ints,
        tiles: Ints, spans: Shorts2d, offsets: Ints, depth_floor: float, size: wp.vec2i, reached: Ints, hits: Vec2s,
        hues: Floats2d, g_rgb: Floats2d, out: Floats,
    ):  # fmt: skip
        member, lane = wp.tid()
        n = pairs[member]
        i, r = ids[n], slots[ids[n]]
        tile = tiles[n]
        total = row_of()
        if n < reached[tile]:
            across = (size[0] + L.TILE - 1) // L.TILE
            begin = offsets[n]
            for s in range(lane, offsets[n + 1] - begin, wp.static(L.WARP)):
                weight = hits[begin + s][1]
                if weight > 0.0:
                    at = pixel_of_slot(spans, n, s)
                    X, Y = (tile % across) * L.TILE + at[0], (tile // across) * L.TILE + at[1]
                    c = intersect_chord64(wide, r, X, Y)
                    g = vecC()
                    for k in range(wp.static(C)):
                        if hues[begin + s, k] >= 0.0:
                            g[k] = weight * g_rgb[Y * size[0] + X, k]
                        total[wp.static(L.G_NEURONS + k)] += g[k]
                    gq = wp.vec3d()
                    for j in range(hidden):
                        to = wp.static(L.G_NEURONS + C) + wp.static(4 + C) * j
                        w = net[r, j]
                        axes = wp.vec3d(w[0], w[1], w[2])
                        u = wp.dot(c.q, axes) + w[3]
                        phase = _TWO_PI * (u - wp.rint(u))
                        pull = d(0.0)
                        for k in range(wp.static(C)):
                            pull += d(mixes[i, j * wp.static(each) + 1 + k // 4][k % 4] * g[k])
                            total[to + 4 + k] += g[k] * float(wp.cos(phase))
                        gu = -_TWO_PI * wp.sin(phase) * pull
                        total[to] += float(gu * c.q[0])
                        total[to + 1] += float(gu * c.q[1])
                        total[to + 2] += float(gu * c.q[2])
                        total[to + 3] += float(gu)
                        gq += gu * axes
                    zero = d(0.0)
                    moved = chord_backward64(
                        c, wide[r, W.TC], depth_floor, zero, wp.dot(gq, c.e), zero, zero, zero, gq, wp.vec3d()
                    )
                    for k in range(3):
                        total[k] += float(moved.e[k])
                        total[3 + k] += float(c.du * moved.G[k])
                        total[6 + k] += float(c.dv * moved.G[k])
                        total[9 + k] += float(moved.m[k])
        add_lanes(total, lane, out, n)

    return float64_net
