# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Forward pass of compositing: one block per tile, one thread per pixel; two passes for ``sort = "entry"``.

The rows of primitives are loaded into shared memory in batches. A tile is finished when the transmittance T is below
T_min in all of its pixels. A slot is memory for one pixel of a (tile, primitive) pair
(:func:`~neuprim.core.render.cuda.slots.row_spans`). A hit is a primitive on a pixel's ray. The slot of a hit stores the
opacity alpha and T in front of the hit. For primitives that are drawn in float64, slots already contain opacities
(:mod:`~neuprim.core.render.cuda.float64`).
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
from neuprim.core.render.cuda.binning import FrameCapacity
from neuprim.core.render.cuda.block_ops import any_tile_thread, int_at, pixel_hit_at, set_pixel_hit, span_of
from neuprim.core.render.cuda.chord import (
    chord_edge_profiles,
    cos_turns,
    intersect_chord,
    load_ray,
    neuron_phase,
    opacity_of_depth,
    pixel_of_lane,
    slot_of_pixel,
    xyz,
)
from neuprim.core.render.cuda.colour_net import ColourNet, float64_hues_kernel
from neuprim.core.render.cuda.float64 import float64_opacity_kernel
from neuprim.core.render.cuda.layout import CUT_AT, KernelForm
from neuprim.core.render.cuda.prepare import Frame
from neuprim.core.render.cuda.slots import count_slots, refuse_misfit, row_spans
from neuprim.core.settings import RenderSettings


@wp.func
def entry_sort_key(pixel: int, entry: float):
    """Return an int64 key that sorts by pixel, then by ``entry``, the depth at which the ray enters the primitive."""
    bits = wp.int64(wp.cast(entry, wp.int32))
    if bits < wp.int64(0):
        bits = wp.int64(-1) - bits  # negative floats: larger ones have more bits
    else:
        bits = bits + (wp.int64(1) << wp.int64(31))
    return (wp.int64(pixel) << wp.int64(32)) | bits


BATCH = 16  # rows in shared memory at a time


@functools.cache
def forward_kernel(form: KernelForm, keep: bool, depth: bool, listing: bool = False, several: bool = False) -> Any:
    """Return the compositing kernel for primitives of the given ``form``.

    With ``keep``, the kernel fills the slots (saved data of hits), and reads the opacities of float64 primitives from
    slots. With ``depth``, the kernel also computes the sum of weight x depth. With ``listing``, the kernel does not
    composite; it lists the sort key and the pair of every hit, for :func:`composite_kernel`. With ``several``, there is
    more than one image.
    """
    assert (keep or not listing) and not (listing and several)
    K, P, C = form.neurons, form.edge, form.channels
    width = L.rasterizer_row_columns(K, C)
    amplitudes, colours = L.rasterizer_amplitude_column(K), L.rasterizer_colour_column(K)
    value, _ = chord_edge_profiles(P)
    H = form.hidden
    each = L.rasterizer_net_columns(C)
    net_width = max(H * each, 1)
    colour_type = wp.types.vector(length=C, dtype=wp.float32)
    mean = float(NORMS[P])

    @wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False)
    def forward(
        rows: Vec4s2d, net: Vec4s2d, starts: Ints, ids: Ints, spans: Shorts2d, offsets: Ints, lens: wp.vec4,
        limits: wp.vec4, background: Floats, size: wp.vec2i, rgb: Floats2d, transmittance: Floats, zsum: Floats,
        hits: Vec2s, depths: Floats, hues: Floats2d, reached: Ints, keys: Longs, owners: Ints,
    ):  # fmt: skip
        """Composite one tile per block; set ``reached[tile]`` to the index after the last composited pair.

        ``limits`` holds alpha_min, alpha_max, transmittance_min and an unused number.
        """
        tile, lane = wp.tid()
        across = (size[0] + L.TILE - 1) // L.TILE
        at = pixel_of_lane(lane)
        place_of = int(tile)
        if wp.static(several):
            place_of = tile % (across * ((size[1] + L.TILE - 1) // L.TILE))
        X = (place_of % across) * L.TILE + at[0]
        Y = (place_of // across) * L.TILE + at[1]
        px = float(X) + 0.5
        py = float(Y) + 0.5
        norm = mean * wp.length(wp.vec3((px - lens[2]) / lens[0], (py - lens[3]) / lens[1], 1.0))
        T = float(1.0)
        if X >= size[0] or Y >= size[1]:
            T = -1.0
        color = colour_type()
        z = float(0.0)
        first = starts[tile]
        end = starts[tile + 1]
        done = int(first)
        for base in range(first, end, BATCH):
            which = wp.tile_load(ids, shape=BATCH, offset=base, storage="shared")
            staged = wp.tile_load_indexed(rows, indices=which, shape=(BATCH, width), axis=0, storage="shared")
            if wp.static(H > 0):
                units = wp.tile_load_indexed(net, indices=which, shape=(BATCH, net_width), axis=0, storage="shared")
            count = wp.min(BATCH, end - base)
            for j in range(count):
                slot = slot_of_pixel(span_of(spans, base + j, at[1]), int_at(offsets, base + j), at[0])
                if slot >= 0:
                    alpha = float(0.0)
                    before = float(T)
                    if T >= limits[2]:
                        mid = float(0.0)
                        entry = float(CUT_AT)
                        known = float(0.0)
                        hue = wp.vec4()
                        tint = colour_type()
                        if wp.static(H >= 0):
                            for k in range(wp.static(C)):
                                if wp.static(k % 4 == 0):
                                    hue = staged[j, wp.static(colours + k // 4)]
                                tint[k] = hue[wp.static(k % 4)]
                        if wp.static(keep):
                            known = staged[j, L.REST][3]
                        if known > 0.0:
                            alpha = pixel_hit_at(hits, slot)[0]
                            if wp.static(depth):
                                mid = depths[slot]
                            if wp.static(listing):
                                entry = pixel_hit_at(hits, slot)[1]
                            if wp.static(H > 0):
                                for k in range(wp.static(C)):
                                    tint[k] = hues[slot, k]
                        else:
                            c = intersect_chord(load_ray(staged, j), px, py)
                            if c.half > 0.0:
                                q = c.x + (c.mid - c.tm) * c.e
                                v = c.half * c.e
                                field = float(staged[j, L.XA][3])
                                w2 = wp.vec4()
                                for k in range(wp.static(K)):
                                    if wp.static(k % 4 == 0):
                                        w2 = staged[j, wp.static(amplitudes + k // 4)]
                                    w = staged[j, wp.static(L.NEURONS + k)]
                                    u = neuron_phase(q, w)
                                    r = u - wp.rint(u)
                                    field += w2[wp.static(k % 4)] * cos_turns(r * r) * value(wp.dot(v, xyz(w)))
                                I = field * c.half * norm
                                if wp.static(P == 1):
                                    I *= c.D
                                if wp.static(P == 2):
                                    I *= c.D * c.D
                                if I > 0.0:
                                    alpha = wp.min(opacity_of_depth(I), limits[1])
                                    if alpha < limits[0]:
                                        alpha = 0.0
                                if wp.static(H > 0):
                                    for h in range(wp.static(H)):
                                        w = units[j, wp.static(each * h)]
                                        u = neuron_phase(q, w)
                                        r = u - wp.rint(u)
                                        wave = cos_turns(r * r)
                                        for k in range(wp.static(C)):
                                            if wp.static(k % 4 == 0):
                                                hue = units[j, wp.static(each * h + 1 + k // 4)]
                                            tint[k] += wave * hue[wp.static(k % 4)]
                                if wp.static(depth):
                                    rest = staged[j, L.REST]
                                    mid = rest[2] + rest[1] * (c.mid + c.slide)
                                if wp.static(listing):
                                    if c.uncut > 0.0:
                                        rest = staged[j, L.REST]
                                        entry = rest[2] + rest[1] * (c.mid + c.slide - c.half)
                        weight = alpha * T
                        if wp.static(listing):
                            weight = 0.0
                            before = 0.0  # for slots without a hit, which nothing else writes
                            keys[slot] = entry_sort_key(
                                wp.where(alpha > 0.0, Y * size[0] + X, size[0] * size[1]), entry
                            )
                            owners[slot] = base + j
                        for k in range(wp.static(C)):
                            if wp.static(H >= 0):
                                color[k] += weight * wp.max(tint[k], 0.0)
                                if wp.static(keep):
                                    hues[slot, k] = tint[k]
                            else:
                                if wp.static(k % 4 == 0):
                                    hue = staged[j, wp.static(colours + k // 4)]
                                color[k] += weight * hue[wp.static(k % 4)]
                        if wp.static(depth):
                            z += weight * mid
                            if wp.static(keep):
                                depths[slot] = mid
                        T -= weight
                    if wp.static(keep):
                        set_pixel_hit(hits, slot, wp.vec2(alpha, before))
            done = base + count
            if any_tile_thread(int(T >= limits[2])) == 0:
                break
        if X < size[0] and Y < size[1]:
            n = Y * size[0] + X
            if wp.static(several):
                n += tile // (across * ((size[1] + L.TILE - 1) // L.TILE)) * size[0] * size[1]
            for k in range(wp.static(C)):
                rgb[n, k] = color[k] + T * background[k]
            transmittance[n] = T
            if wp.static(depth):
                zsum[n] = z
        if lane == 0:
            reached[tile] = done

    return forward


# ---- sort = "entry". Every hit is listed, with a key of pixel and entry, and the list is sorted. One thread per
# pixel composites its part. Entries that agree in float32, and all chords that the near plane cuts, keep the order of
# the centres: slots are in that order, and the sort is stable. Nothing can stop early before the list is complete.


@wp.func
def _first_hit_of_pixel(keys: Longs, count: int, pixel: int):
    """Return the index of the first sorted key that belongs to ``pixel`` or to a later pixel."""
    low, high = int(0), int(count)
    while low < high:
        middle = low + (high - low) // 2
        if int(keys[middle] >> wp.int64(32)) < pixel:
            low = middle + 1
        else:
            high = middle
    return low


@functools.cache
def composite_kernel(form: KernelForm, depth: bool) -> Any:
    """Return a kernel that composites hits sorted by entry, with one thread per pixel.

    The kernel writes (alpha, transmittance T in front of the hit) to the slot of each hit.
    """
    C, H = form.channels, form.hidden
    colours = L.rasterizer_colour_column(form.neurons)
    colour_type = wp.types.vector(length=C, dtype=wp.float32)

    @wp.kernel(enable_backward=False, module="unique", module_options=FAST, grid_stride=False)
    def composite(
        rows: Vec4s2d, ids: Ints, keys: Longs, order: Longs, count: int, owners: Ints, limits: wp.vec4,
        background: Floats, hues: Floats2d, depths: Floats, hits: Vec2s, rgb: Floats2d, transmittance: Floats,
        zsum: Floats, begins: Ints,
    ):  # fmt: skip
        """Composite the sorted hits of pixel n in thread n; set ``begins[n]`` to the pixel's first hit in ``order``."""
        n = wp.tid()
        first = _first_hit_of_pixel(keys, count, n)
        begins[n] = first
        T, z = float(1.0), float(0.0)
        color = colour_type()
        for k in range(first, _first_hit_of_pixel(keys, count, n + 1)):
            slot = int(order[k])
            alpha = hits[slot][0]
            if T < limits[2]:
                alpha = 0.0
            hits[slot] = wp.vec2(alpha, T)
            weight = alpha * T
            hue = wp.vec4()
            for c in range(wp.static(C)):
                if wp.static(H >= 0):
                    color[c] += weight * wp.max(hues[slot, c], 0.0)
                else:
                    if wp.static(c % 4 == 0):
                        hue = rows[ids[owners[slot]], wp.static(colours + c // 4)]
                    color[c] += weight * hue[wp.static(c % 4)]
            if wp.static(depth):
                z += weight * depths[slot]
            T -= weight
        for c in range(wp.static(C)):
            rgb[n, c] = color[c] + T * background[c]
        transmittance[n] = T
        if wp.static(depth):
            zsum[n] = z

    return composite


# ---------------------------------------------------------------- a frame

_NUMBERS = {
    torch.float32: wp.float32,
    torch.float64: wp.float64,
    torch.int32: wp.int32,
    torch.int64: wp.int64,
    torch.int16: wp.uint16,
}


@dataclass
class CompositedFrame:
    """Images of a forward pass, and the data that the pass saves for backward."""

    rgb: Tensor  # (H W, C)
    transmittance: Tensor  # (H W,)
    zsum: Tensor  # (H W,) sum over hits of weight x depth, empty without depth
    spans: Tensor  # (pairs, 16) int16 row spans: the pixels of each pair, see row_spans
    offsets: Tensor  # (pairs + 1,) int32, first slot of each pair
    hits: Tensor  # (slots, 2) opacity of each hit and transmittance in front of it; empty if no slots are kept
    depths: Tensor  # (slots,) camera-z of the chords' middles, empty without depth
    hues: Tensor  # (slots, C) colours before max(0, .); empty without colour networks
    reached: Tensor  # (tiles,) int32, index after the last composited pair of each tile
    in_float64: Tensor  # (D,) int32, the pairs that are drawn in float64, in order
    # only if hits were sorted by entry:
    order: Tensor | None = None  # (slots,) int64 slots, sorted by pixel and entry
    begins: Tensor | None = None  # (H W + 1,) int32, index in order of each pixel's first hit
    owners: Tensor | None = None  # (slots,) int32, pair of each slot


def warp_array(tensor: Tensor) -> Any:
    """Return a tensor as a kernel argument with the Warp type of its dtype; int16 becomes uint16."""
    return array(tensor, _NUMBERS[tensor.dtype])


class KernelArrays:
    """Arrays and numbers of a frame, in the form that kernels take as arguments.

    ``lens`` is (fx, fy, cx, cy), ``size`` is (width, height), ``limits`` is
    (alpha_min, alpha_max, transmittance_min, 0). ``units`` are the rows of colour networks. ``spans`` and ``offsets``
    are fields of :class:`CompositedFrame`; the other arrays are fields of :class:`Frame` and of its tile lists.
    """

    def __init__(
        self, frame: Frame, net: ColourNet | None, settings: RenderSettings, spans: Tensor, offsets: Tensor
    ) -> None:
        camera, device = frame.projection.camera, frame.device
        self.rows = array(frame.rows, wp.vec4)
        self.wide, self.slots = warp_array(frame.wide), warp_array(frame.slots)
        lists = (frame.lists.starts, frame.lists.ids, frame.lists.tile_of)
        self.starts, self.ids, self.tile_of = (warp_array(x) for x in lists)
        self.spans, self.offsets = warp_array(spans), warp_array(offsets)
        units = torch.empty(1, 1, 4, device=device) if net is None or not net.hidden else net.rows
        self.units = array(units, wp.vec4)
        self.lens = wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy)
        self.size = wp.vec2i(camera.width, camera.height)
        self.limits = wp.vec4(settings.alpha_min, settings.alpha_max, settings.transmittance_min, 0.0)

    @property
    def covered(self) -> tuple[Any, ...]:
        """Arrays with the primitive, the tile and the covered pixels of every (tile, primitive) pair."""
        return self.ids, self.tile_of, self.spans, self.offsets


def composite_frame(
    frame: Frame,
    form: KernelForm,
    net: ColourNet | None,
    background: Tensor,
    settings: RenderSettings,
    differentiable: bool,
    images: int = 1,
    capacity: FrameCapacity | None = None,
) -> CompositedFrame:
    """Composite a frame to one image or several ``images``; several images have no gradients and no entry sorting.

    The backward pass, float64 and sorting by entry need slots. If slots are needed and there is no ``capacity``, the
    function waits for the device.
    """
    lists, device, camera = frame.lists, frame.device, frame.projection.camera
    pairs, tiles = lists.pairs, lists.starts.shape[0] - 1

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=device)

    spans, counts = empty(pairs, L.TILE, dtype=torch.int16), empty(2, pairs, dtype=torch.int32)
    offsets = torch.zeros(pairs + 1, dtype=torch.int32, device=device)
    a = KernelArrays(frame, net, settings, spans, offsets)
    silhouettes = (warp_array(frame.spans), array(frame.boxes, wp.vec4i))
    inputs = (a.rows, *silhouettes, a.starts, a.ids, a.tile_of, a.size, a.spans, warp_array(counts))
    launch_kernel(row_spans, pairs, inputs, device)
    sorts = settings.sort == "entry"
    keep = differentiable or sorts or frame.wide.shape[0] > 0
    total, in_float64 = 0, empty(0, dtype=torch.int32)
    if keep and pairs:
        total, offsets, in_float64 = count_slots(frame, counts, capacity)
        a.offsets = warp_array(offsets)
    elif capacity is not None:
        refuse_misfit(frame, torch.zeros(2, 1, dtype=torch.int64, device=device), capacity)
    hits, depths = empty(total, 2), empty(total if settings.depth else 0)
    hues = empty(total if net is not None else 0, form.channels)
    if len(in_float64):
        few, which = (len(in_float64), L.WARP), warp_array(in_float64)
        kept = (array(hits, wp.vec2), warp_array(depths))
        wide = (which, a.wide, a.slots, *a.covered, a.lens, a.limits, a.size, form.neurons, form.edge, *kept)
        dims = (len(in_float64), L.PIXELS)
        launch_kernel(float64_opacity_kernel(settings.depth), dims, wide, device, L.PIXELS)
        if net is not None and net.hidden:
            units = (array(net.wide, wp.vec4d), a.units, a.rows, L.rasterizer_colour_column(form.neurons), net.hidden)
            wide = (which, a.wide, *units, a.slots, *a.covered, a.size, warp_array(hues))
            launch_kernel(float64_hues_kernel(form.channels), few, wide, device, L.WARP)
    pixels = images * camera.width * camera.height
    rgb, T, z = empty(pixels, form.channels), empty(pixels), empty(pixels if settings.depth else 0)
    reached = empty(tiles, dtype=torch.int32)
    keys, owners = empty(total if sorts else 0, dtype=torch.int64), empty(total if sorts else 0, dtype=torch.int32)
    drawn = CompositedFrame(rgb, T, z, spans, offsets, hits, depths, hues, reached, in_float64)
    image = (warp_array(rgb), warp_array(T), warp_array(z))
    slots = (array(hits, wp.vec2), warp_array(depths), warp_array(hues))
    tile = (a.rows, a.units, a.starts, a.ids, a.spans, a.offsets, a.lens, a.limits, warp_array(background), a.size)
    listed = (warp_array(keys), warp_array(owners))
    kernel = forward_kernel(form, keep, settings.depth, sorts, images > 1)
    launch_kernel(kernel, (tiles, L.PIXELS), (*tile, *image, *slots, warp_array(reached), *listed), device, L.PIXELS)
    if not sorts:
        return drawn
    keys, order = torch.sort(keys, stable=True)
    begins = torch.empty(pixels + 1, dtype=torch.int32, device=device)
    begins[pixels] = torch.searchsorted(keys, pixels << 32)
    sorted_hits = (a.rows, a.ids, warp_array(keys), warp_array(order), total, warp_array(owners), a.limits)
    written = (*reversed(slots), *image, warp_array(begins))
    inputs = (*sorted_hits, warp_array(background), *written)
    launch_kernel(composite_kernel(form, settings.depth), pixels, inputs, device)
    drawn.order, drawn.begins, drawn.owners = order, begins, owners
    return drawn
