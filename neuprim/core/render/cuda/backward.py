# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Backward pass of compositing: compute gradients of the primitives' rows from the gradient of the image.

A pair is a tile and a primitive that reaches it. A slot holds the data that the forward pass saved for one pixel of a
pair. A hit is a slot whose primitive lies on the pixel's ray.

1. The first kernel runs one block per tile and one thread per pixel. Each thread visits its hits back to front, and
   stores dL/dI, I the optical depth, and the weight alpha T in each slot.
2. The second kernel runs one warp per pair. The warp recomputes chords and neurons, sums gradients in registers, and
   writes one gradient row.
3. The third kernel adds each primitive's rows in the order of its pairs, so that reruns give the same bits.

With 8 neurons the sums take 59 of 128 registers, so the second kernel recomputes cheap values instead of keeping them.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import (
    FAST,
    Floats,
    Floats2d,
    Ints,
    Longs,
    Shorts2d,
    Vec2s,
    Vec4s2d,
    array,
    launch_kernel,
    wp,
)
from neuprim.core.model.edge import NORMS
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.block_ops import (
    gradient_row_sums,
    gradient_row_type,
    int_at,
    load_rasterizer_row_column,
    pixel_float_at,
    pixel_hit_at,
    pixel_row_float,
    set_pixel_hit,
    span_of,
)
from neuprim.core.render.cuda.chord import (
    TAU,
    chord_backward,
    chord_edge_profiles,
    cos_turns,
    intersect_chord,
    load_ray,
    neuron_phase,
    pixel_of_lane,
    pixel_of_slot,
    sin_turns,
    slot_of_pixel,
    xyz,
)
from neuprim.core.render.cuda.colour_net import (
    ColourNet,
    float64_net_kernel,
    net_gradient_row_width,
    rasterizer_net_gradient_kernel,
)
from neuprim.core.render.cuda.float64 import float64_pairs_kernel
from neuprim.core.render.cuda.forward import CompositedFrame, KernelArrays, warp_array
from neuprim.core.render.cuda.layout import KernelForm
from neuprim.core.render.cuda.prepare import Frame
from neuprim.core.settings import RenderSettings


@functools.cache
def pixels_kernel(form: KernelForm, depth: bool) -> Any:
    """Return the kernel that computes dL/dI of the hits, I the optical depth, with one thread per pixel.

    ``depth`` tells whether the depth image has a gradient.
    """
    C, H = form.channels, form.hidden
    colours, width = L.rasterizer_colour_column(form.neurons), L.rasterizer_row_columns(form.neurons, C)
    vecC = wp.types.vector(length=C, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False)
    def backward_pixels(
        rows: Vec4s2d, starts: Ints, ids: Ints, spans: Shorts2d, offsets: Ints, limits: wp.vec4, size: wp.vec2i,
        transmittance: Floats, reached: Ints, background: Floats, g_rgb: Floats2d, g_transmittance: Floats, g_z: Floats,
        depths: Floats, hues: Floats2d, hits: Vec2s,
    ):  # fmt: skip
        """Replace (alpha, T) in each slot by (dL/dI, w): dL/dI = (1 - alpha) T dL/dw - b, with the weight w = alpha T.

        I is the optical depth of the hit, T the transmittance in front of the hit. b is the part of the gradient from
        behind the hit: the sum of w dL/dw over later hits, plus T_end dL/dT_end at the end of the ray. Where alpha is
        clamped to alpha_max, dL/dI is 0.
        """
        tile, lane = wp.tid()
        across = (size[0] + L.TILE - 1) // L.TILE
        at = pixel_of_lane(lane)
        X = (tile % across) * L.TILE + at[0]
        Y = (tile // across) * L.TILE + at[1]
        if X < size[0] and Y < size[1]:
            n = Y * size[0] + X
            own = vecC()
            by_light = float(0.0)
            if g_transmittance:
                by_light = g_transmittance[n]
            for k in range(wp.static(C)):
                own[k] = g_rgb[n, k]
                by_light += own[k] * background[k]
            behind = transmittance[n] * by_light
            first = starts[tile]
            count = reached[tile] - first
            for back in range(count):
                p = first + count - 1 - back
                slot = slot_of_pixel(span_of(spans, p, at[1]), int_at(offsets, p), at[0])
                if slot >= 0:
                    hit = pixel_hit_at(hits, slot)
                    alpha = hit[0]
                    out = wp.vec2()
                    if alpha > 0.0:
                        i = int_at(ids, p)
                        weight = alpha * hit[1]
                        by_weight = float(0.0)
                        hue = wp.vec4()
                        for k in range(wp.static(C)):
                            if wp.static(H >= 0):
                                by_weight += wp.max(hues[slot, k], 0.0) * own[k]
                            else:
                                if wp.static(k % 4 == 0):
                                    hue = load_rasterizer_row_column(
                                        rows, i, wp.static(width), wp.static(colours + k // 4)
                                    )
                                by_weight += hue[wp.static(k % 4)] * own[k]
                        if wp.static(depth):
                            by_weight += g_z[n] * depths[slot]
                        slope = float(0.0)
                        if alpha < limits[1]:
                            slope = (1.0 - alpha) * hit[1] * by_weight - behind
                        behind += weight * by_weight
                        out = wp.vec2(slope, weight)
                    set_pixel_hit(hits, slot, out)

    return backward_pixels


@functools.cache
def pairs_kernel(form: KernelForm, depth: bool) -> Any:
    """Return the kernel that writes the gradient rows of float32 pairs, with one warp per (tile, primitive) pair.

    ``depth`` tells whether the depth image has a gradient.
    """
    K, P, C = form.neurons, form.edge, form.channels
    W, width = L.rasterizer_row_columns(K, C), L.gradient_width(K, C)
    row_of, add_lanes = gradient_row_type(width), gradient_row_sums(width)
    _, pair = chord_edge_profiles(P)
    amplitudes = L.rasterizer_amplitude_column(K)
    vecK = wp.types.vector(length=max(K, 1), dtype=wp.float32)
    vecC = wp.types.vector(length=C, dtype=wp.float32)
    mean = float(NORMS[P])
    by_rate = -TAU * TAU / (2.0 * P + 3.0)  # B' = -z B_(p+1)/(2p + 3), and z = 2 pi v

    # a cap of 128 registers allows 16 warps per multiprocessor instead of 12. With 5 to 8 neurons only: fewer need no
    # cap, and more would spill
    bounds = (L.WARP, 16) if 4 < K <= 8 else None

    @wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False, launch_bounds=bounds)
    def backward_pairs(
        rows: Vec4s2d, ids: Ints, tiles: Ints, spans: Shorts2d, offsets: Ints, lens: wp.vec4, depth_floor: float,
        size: wp.vec2i, starts: Ints, reached: Ints, hits: Vec2s, g_rgb: Floats, g_z: Floats, error: Floats,
        out: Floats,
    ):  # fmt: skip
        n, lane = wp.tid()
        tile = tiles[n]
        across = (size[0] + L.TILE - 1) // L.TILE
        i = ids[n]
        # a float64 kernel writes the rows of the others; there may be room for more pairs
        if rows[i, L.REST][3] == 0.0 and n < starts[starts.shape[0] - 1]:
            total = row_of()
            if n < reached[tile]:
                which = wp.tile_load(ids, shape=1, offset=n, storage="shared")
                own = wp.tile_load(spans, shape=(1, wp.static(L.TILE)), offset=(n, 0), storage="shared")
                row = wp.tile_load_indexed(rows, indices=which, shape=(1, W), axis=0, storage="shared")
                gE0 = wp.vec3()
                gEX = wp.vec3()
                gEY = wp.vec3()
                gXA = wp.vec3()
                g_colour = vecC()
                g_offset = float(0.0)
                g_mass = float(0.0)
                g_weight = float(0.0)
                g_error = float(0.0)
                gx = vecK()
                gy = vecK()
                gz = vecK()
                gp = vecK()
                ga = vecK()
                # outside the loop, as no compiler moves a division out of a branch
                corner = tile % across | (tile // across) << 16
                begin = offsets[n]
                count = offsets[n + 1] - begin
                for s in range(lane, count, wp.static(L.WARP)):
                    hit = pixel_hit_at(hits, begin + s)
                    if hit[1] > 0.0:
                        at = pixel_of_slot(own, 0, s)
                        X = (corner & 65535) * L.TILE + at[0]
                        Y = (corner >> 16) * L.TILE + at[1]
                        pixel = Y * size[0] + X
                        px = float(X) + 0.5
                        py = float(Y) + 0.5
                        norm = mean * wp.length(wp.vec3((px - lens[2]) / lens[0], (py - lens[3]) / lens[1], 1.0))
                        g_weight += hit[1]
                        g_error += hit[1] * pixel_float_at(error, pixel)
                        for k in range(wp.static(C)):
                            g_colour[k] += hit[1] * pixel_row_float(g_rgb, pixel, wp.static(C), k)
                        c = intersect_chord(load_ray(row, 0), px, py)
                        q = c.x + (c.h - c.half) * c.e
                        scale = float(norm)  # I = scale half field
                        if wp.static(P == 1):
                            scale *= c.D
                        if wp.static(P == 2):
                            scale *= c.D * c.D
                        gs = hit[0] * scale
                        gf = gs * c.half
                        field = float(row[0, L.XA][3])
                        gq = wp.vec3()
                        gv = wp.vec3()
                        w2 = wp.vec4()
                        for k in range(wp.static(K)):
                            if wp.static(k % 4 == 0):
                                w2 = row[0, wp.static(amplitudes + k // 4)]
                            amplitude = w2[wp.static(k % 4)]
                            w = row[0, wp.static(L.NEURONS + k)]
                            z = c.half * wp.dot(c.e, xyz(w))
                            band = pair(z)
                            u = neuron_phase(q, w)
                            r = u - wp.rint(u)
                            cosine = cos_turns(r * r)
                            one = cosine * band[0]
                            field += amplitude * one
                            ga[k] += gf * one
                            gu = gf * amplitude * band[0] * (-TAU) * sin_turns(r)
                            gw = gf * amplitude * cosine * band[1] * by_rate * z
                            gh = gw * c.half
                            gp[k] += gu
                            gx[k] += gu * q[0] + gh * c.e[0]
                            gy[k] += gu * q[1] + gh * c.e[1]
                            gz[k] += gu * q[2] + gh * c.e[2]
                            gq += gu * xyz(w)
                            gv += gw * xyz(w)
                        g_offset += gf
                        g_mass += gf * field
                        length = wp.length(c.e)
                        c.ia = 1.0 / (length * length)
                        D = c.h * c.h / c.ia
                        c.mid = c.tm + c.h - c.half
                        c.x = q - (c.h - c.half) * c.e
                        g_half = wp.dot(gv, c.e) + gs * field
                        g_mid = wp.dot(gq, c.e)
                        if wp.static(depth):
                            g_mid += hit[1] * pixel_float_at(g_z, pixel) * row[0, L.REST][1]
                        gD = float(0.0)
                        by_depth = 0.5 * c.h / D
                        if wp.static(P == 0):
                            by_depth = 0.5 * c.ia / wp.sqrt(wp.max(D, depth_floor) * c.ia)
                        else:
                            gD = float(P) * gf * field / D
                        pull = chord_backward(c, g_half, g_mid, gD, by_depth, gq, gv)
                        gG = pull.e + (row[0, L.REST][0] + c.slide) * pull.m
                        gE0 += pull.e + c.slide * pull.m
                        gEX += c.du * gG
                        gEY += c.dv * gG
                        gXA += pull.m
                for k in range(3):
                    total[k] = gE0[k]
                    total[3 + k] = gEX[k]
                    total[6 + k] = gEY[k]
                    total[9 + k] = gXA[k]
                total[L.G_OFFSET] = g_offset
                total[L.G_LOG_M] = g_mass
                total[L.G_WEIGHT] = g_weight
                total[L.G_ERROR] = g_error
                for k in range(wp.static(K)):
                    total[wp.static(L.G_NEURONS + 5 * k)] = gx[k]
                    total[wp.static(L.G_NEURONS + 5 * k + 1)] = gy[k]
                    total[wp.static(L.G_NEURONS + 5 * k + 2)] = gz[k]
                    total[wp.static(L.G_NEURONS + 5 * k + 3)] = gp[k]
                    total[wp.static(L.G_NEURONS + 5 * k + 4)] = ga[k]
                for k in range(wp.static(C)):
                    total[wp.static(L.G_NEURONS + 5 * K + k)] = g_colour[k]
            add_lanes(total, lane, out, n)

    return backward_pairs


@wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False)
def sum_pairs(
    first: Ints, slots: Ints, pair_rows: Floats2d,
    grads: Floats2d,
):  # fmt: skip
    """Sum the gradient rows of each primitive's pairs, in order; thread (i, c) sums column c for primitive i."""
    i, c = wp.tid()
    total = float(0.0)
    for k in range(first[i], first[i + 1]):
        total += pair_rows[slots[k], c]
    grads[i, c] = total


@functools.cache
def uncomposite_kernel(form: KernelForm, depth: bool) -> Any:
    """Return the version of :func:`pixels_kernel` for hits sorted by entry.

    The kernel replaces (alpha, T) in each slot by (dL/dI, weight alpha T).
    """
    C, H = form.channels, form.hidden
    colours = L.rasterizer_colour_column(form.neurons)

    @wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False)
    def uncomposite(
        rows: Vec4s2d, ids: Ints, order: Longs, begins: Ints, owners: Ints, limits: wp.vec4, transmittance: Floats,
        background: Floats, g_rgb: Floats2d, g_transmittance: Floats, g_z: Floats, depths: Floats, hues: Floats2d,
        hits: Vec2s,
    ):  # fmt: skip
        n = wp.tid()
        by_light = float(0.0)
        if g_transmittance:
            by_light = g_transmittance[n]
        for c in range(wp.static(C)):
            by_light += g_rgb[n, c] * background[c]
        behind = transmittance[n] * by_light
        first = begins[n]
        count = begins[n + 1] - first
        for back in range(count):
            slot = int(order[first + count - 1 - back])
            hit = hits[slot]
            alpha = hit[0]
            out = wp.vec2()
            if alpha > 0.0:
                weight = alpha * hit[1]
                by_weight = float(0.0)
                hue = wp.vec4()
                for c in range(wp.static(C)):
                    if wp.static(H >= 0):
                        by_weight += wp.max(hues[slot, c], 0.0) * g_rgb[n, c]
                    else:
                        if wp.static(c % 4 == 0):
                            hue = rows[ids[owners[slot]], wp.static(colours + c // 4)]
                        by_weight += hue[wp.static(c % 4)] * g_rgb[n, c]
                if wp.static(depth):
                    by_weight += g_z[n] * depths[slot]
                slope = float(0.0)
                if alpha < limits[1]:
                    slope = (1.0 - alpha) * hit[1] * by_weight - behind
                behind += weight * by_weight
                out = wp.vec2(slope, weight)
            hits[slot] = out

    return uncomposite


# ---------------------------------------------------------------- a frame


@dataclass
class ImageGradient:
    """Gradient of the loss with respect to the image, and an error per pixel; tensors are float32 and contiguous.

    The backward pass sums weight x error over each primitive's pixels. Population control (which adds and removes
    primitives during training) uses these sums.
    """

    rgb: Tensor  # (H W, C)
    transmittance: Tensor | None  # (H W,), without the background's share
    background: Tensor  # (C,) colour behind everything
    z: Tensor | None  # (H W,)
    error: Tensor  # (H W,)


def rasterizer_gradient_rows(
    frame: Frame,
    form: KernelForm,
    net: ColourNet | None,
    drawn: CompositedFrame,
    settings: RenderSettings,
    gradient: ImageGradient,
) -> tuple[Tensor, Tensor | None]:
    """Return the gradient rows of N primitives, (N, gradient_width), and the gradient rows of their colour networks.

    The rows of networks are (N, net_gradient_row_width), or None without networks. The function overwrites the slots
    that the forward pass saved, ``drawn.hits``.
    """
    lists, device, depth = frame.lists, frame.device, gradient.z is not None
    pairs, tiles = lists.pairs, lists.starts.shape[0] - 1
    a = KernelArrays(frame, net, settings, drawn.spans, drawn.offsets)
    g_z = warp_array(torch.empty(0, device=device) if gradient.z is None else gradient.z)
    g_rgb, error = warp_array(gradient.rgb), warp_array(gradient.error)
    g_T = None if gradient.transmittance is None else warp_array(gradient.transmittance)
    behind = warp_array(gradient.background)
    hits, reached, T = array(drawn.hits, wp.vec2), warp_array(drawn.reached), warp_array(drawn.transmittance)
    depths, hues, floor = warp_array(drawn.depths), warp_array(drawn.hues), settings.depth_floor
    if drawn.order is None or drawn.begins is None or drawn.owners is None:
        tile = (a.rows, a.starts, a.ids, a.spans, a.offsets, a.limits, a.size)
        images = (T, reached, behind, g_rgb, g_T, g_z, depths, hues, hits)
        launch_kernel(pixels_kernel(form, depth), (tiles, L.PIXELS), (*tile, *images), device, L.PIXELS)
    else:
        sorted_hits = (warp_array(drawn.order), warp_array(drawn.begins), warp_array(drawn.owners))
        inputs = (a.rows, a.ids, *sorted_hits, a.limits, T, behind, g_rgb, g_T, g_z, depths, hues, hits)
        launch_kernel(uncomposite_kernel(form, depth), len(drawn.transmittance), inputs, device)
    few, which = (len(drawn.in_float64), L.WARP), warp_array(drawn.in_float64)
    width = L.gradient_width(form.neurons, form.channels)
    pair_rows = torch.empty(pairs, width, dtype=torch.float32, device=device)
    out, flat_rgb = warp_array(pair_rows.view(-1)), warp_array(gradient.rgb.view(-1))
    inputs = (a.rows, *a.covered, a.lens, floor, a.size, a.starts, reached, hits, flat_rgb, g_z, error, out)
    launch_kernel(pairs_kernel(form, depth), (pairs, L.WARP), inputs, device, L.WARP)
    if len(drawn.in_float64):
        view = (a.lens, floor, a.size, form.neurons)
        inputs = (which, a.wide, a.slots, *a.covered, *view, reached, hits, g_rgb, g_z, error, out)
        launch_kernel(float64_pairs_kernel(form, depth), few, inputs, device, L.WARP)
    grads = _sum_pair_rows(frame, pair_rows)
    if net is None:
        return grads, None
    net_rows = torch.empty(pairs, net_gradient_row_width(form), device=device)
    slots = (reached, hits, hues, g_rgb, warp_array(net_rows.view(-1)))
    inputs = (a.rows, a.units, *a.covered, floor, a.size, *slots)
    launch_kernel(rasterizer_net_gradient_kernel(form), (pairs, L.WARP), inputs, device, L.WARP)
    if len(drawn.in_float64):
        weights = (which, a.wide, array(net.wide, wp.vec4d), a.units, net.hidden, a.slots)
        launch_kernel(float64_net_kernel(form), few, (*weights, *a.covered, floor, a.size, *slots), device, L.WARP)
    return grads, _sum_pair_rows(frame, net_rows)


def _sum_pair_rows(frame: Frame, pair_rows: Tensor) -> Tensor:
    """Return the (N, width) sums, for each primitive, of the gradient rows of its (tile, primitive) pairs."""
    grads = torch.empty(frame.rows.shape[0], pair_rows.shape[1], dtype=torch.float32, device=frame.device)
    lists = (warp_array(frame.lists.first), warp_array(frame.lists.slots_of))
    launch_kernel(sum_pairs, grads.shape, (*lists, warp_array(pair_rows), warp_array(grads)), frame.device)
    return grads
