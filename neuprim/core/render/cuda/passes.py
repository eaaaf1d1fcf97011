"""The pixel kernels of one frame in their order, on arrays that :mod:`~neuprim.core.render.cuda.frame` prepared."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.compute.warp import array, launch, wp
from neuprim.core.errors import BackendUnavailable
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.backward_pairs import pairs_kernel, sum_pairs
from neuprim.core.render.cuda.backward_pixels import pixels_kernel
from neuprim.core.render.cuda.by_entry import composite_kernel, uncomposite_kernel
from neuprim.core.render.cuda.delicate import delicate_kernel
from neuprim.core.render.cuda.delicate_backward import delicate_pairs_kernel
from neuprim.core.render.cuda.forms import Form
from neuprim.core.render.cuda.forward import forward_kernel
from neuprim.core.render.cuda.frame import Frame
from neuprim.core.render.cuda.net import Net
from neuprim.core.render.cuda.ray_colours import delicate_hues_kernel, delicate_net_kernel, net_pairs_kernel, net_width
from neuprim.core.render.cuda.spans import row_spans
from neuprim.core.settings import RenderSettings

__all__ = ["Composited", "backward", "forward"]

_MOST_HITS = 2**31


@dataclass
class Composited:
    """What a forward pass leaves.

    Attributes:
        rgb: (H W, C); transmittance: (H W,); zsum: (H W,) sum of w z, one number device no depth is wanted.
        spans: (pairs, 16) int16, offsets: (pairs + 1,) int32: the pixels that each pair covers
        (:mod:`~neuprim.core.render.cuda.spans`). hits: (slots, 2) opacity and transmittance before it, if they were
        kept; depths: (slots,) camera-z, if wanted, too;
            hues: (slots, C) colours before max(0, .), of colour networks.
        reached: (tiles,) int32, the pairs before it were composited.
        delicate: (D,) int32, the pairs that are drawn in float64, rising.
        order: (slots,) int64 slots by pixel and entry, begins: (H W + 1,) int32 and owners: (slots,) int32, the pair of
        each; where hits were
            sorted by entry.
    """

    rgb: Tensor
    transmittance: Tensor
    zsum: Tensor
    spans: Tensor
    offsets: Tensor
    hits: Tensor
    depths: Tensor
    hues: Tensor
    reached: Tensor
    delicate: Tensor
    order: Tensor | None = None
    begins: Tensor | None = None
    owners: Tensor | None = None


def _numbers_of(marked: Tensor, count: int) -> Tensor:
    """(count,) int32, where a mask with so many is set; the host does not wait."""
    place = torch.where(marked, torch.cumsum(marked, 0) - 1, count)
    numbers = torch.arange(marked.shape[0], dtype=torch.int32, device=marked.device)
    return torch.empty(count + 1, dtype=torch.int32, device=marked.device).index_copy_(0, place, numbers)[:count]


def _camera(frame: Frame) -> tuple[object, object]:
    c = frame.projection.camera
    return wp.vec4(c.fx, c.fy, c.cx, c.cy), wp.vec2i(c.width, c.height)


def _limits(s: RenderSettings) -> object:
    return wp.vec4(s.alpha_min, s.alpha_max, s.transmittance_min, 0.0)


def forward(
    frame: Frame,
    form: Form,
    net: Net | None,
    background: Tensor,
    settings: RenderSettings,
    differentiable: bool,
    images: int = 1,
) -> Composited:
    """Draw; of several ``images``, whose pixels come one after the other, without gradients and sorted by centres. The
    host waits for the device once device slots are kept, for how many there are.

    Raises:
        BackendUnavailable: the frame's hits are more than int32 counts.
    """
    lists, device, camera = frame.lists, frame.device, frame.projection.camera
    pairs, tiles = lists.pairs, lists.starts.shape[0] - 1
    lens, size = _camera(frame)
    rows, ids, tile_of = array(frame.rows, wp.vec4), array(lists.ids, wp.int32), array(lists.tile_of, wp.int32)
    spans = torch.empty(pairs, L.TILE, dtype=torch.int16, device=device)
    counts = torch.empty(pairs, dtype=torch.int32, device=device)
    shapes = array(spans, wp.uint16)
    launch(
        row_spans, pairs,
        (rows, array(frame.spans, wp.float32), array(frame.boxes, wp.vec4i), ids, tile_of, size, shapes, array(counts, wp.int32)), device,
    )  # fmt: skip
    sorts = settings.sort == "entry"
    keep = differentiable or sorts or frame.wide.shape[0] > 0
    total, delicate = 0, torch.empty(0, dtype=torch.int32, device=device)
    offsets = torch.zeros(pairs + 1, dtype=torch.int32, device=device)
    if keep and pairs:
        ends = torch.cumsum(counts, 0, dtype=torch.int64)
        offsets[1:] = ends
        if frame.wide.shape[0] > 0:
            marked = frame.slots[lists.ids] >= 0
            total, few = torch.stack((ends[-1], marked.sum())).tolist()
            delicate = _numbers_of(marked, few)
        else:
            total = int(ends[-1])
        if total >= _MOST_HITS:
            raise BackendUnavailable(
                f"primitives cover {total} pixels in all; the cuda backend counts to {_MOST_HITS - 1}: render a smaller image"
            )

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=device)

    hits, depths = empty(total, 2), empty(total if settings.depth else 0)
    hues = empty(total if net is not None else 0, form.channels)
    units = array(empty(1, 1, 4) if net is None or not net.hidden else net.rows, wp.vec4)
    starts_at = array(offsets, wp.int32)
    if len(delicate):
        launch(
            delicate_kernel(settings.depth), (len(delicate), L.WARP),
            (
                array(delicate, wp.int32), array(frame.wide, wp.float64), array(frame.slots, wp.int32), ids, tile_of, shapes, starts_at, lens, _limits(settings), size,
                form.neurons, form.edge, array(hits, wp.vec2), array(depths, wp.float32),
            ), device, L.WARP,
        )  # fmt: skip
    if len(delicate) and net is not None and net.hidden:
        launch(
            delicate_hues_kernel(form.channels), (len(delicate), L.WARP),
            (
                array(delicate, wp.int32), array(frame.wide, wp.float64), array(net.wide, wp.vec4d), units, rows, L.colours(form.neurons), net.hidden,
                array(frame.slots, wp.int32), ids, tile_of, shapes, starts_at, size, array(hues, wp.float32),
            ), device, L.WARP,
        )  # fmt: skip
    pixels = images * camera.width * camera.height
    rgb, T, z = empty(pixels, form.channels), empty(pixels), empty(pixels if settings.depth else 0)
    reached = empty(tiles, dtype=torch.int32)
    keys, owners = empty(total if sorts else 0, dtype=torch.int64), empty(total if sorts else 0, dtype=torch.int32)
    launch(
        forward_kernel(form, keep, settings.depth, sorts, images > 1), (tiles, L.PIXELS),
        (
            rows, units, array(lists.starts, wp.int32), ids, shapes, starts_at, lens, _limits(settings), array(background, wp.float32), size,
            array(rgb, wp.float32), array(T, wp.float32), array(z, wp.float32), array(hits, wp.vec2), array(depths, wp.float32),
            array(hues, wp.float32), array(reached, wp.int32),
            array(keys, wp.int64), array(owners, wp.int32),
        ), device, L.PIXELS,
    )  # fmt: skip
    if not sorts:
        return Composited(rgb, T, z, spans, offsets, hits, depths, hues, reached, delicate)
    keys, order = torch.sort(keys, stable=True)
    begins = torch.empty(pixels + 1, dtype=torch.int32, device=device)
    begins[pixels] = torch.searchsorted(keys, pixels << 32)
    launch(
        composite_kernel(form, settings.depth), pixels,
        (
            rows, ids, array(keys, wp.int64), array(order, wp.int64), total, array(owners, wp.int32), _limits(settings), array(background, wp.float32),
            array(hues, wp.float32), array(depths, wp.float32), array(hits, wp.vec2), array(rgb, wp.float32), array(T, wp.float32),
            array(z, wp.float32), array(begins, wp.int32),
        ), device,
    )  # fmt: skip
    return Composited(rgb, T, z, spans, offsets, hits, depths, hues, reached, delicate, order, begins, owners)


def backward(
    frame: Frame,
    form: Form,
    net: Net | None,
    drawn: Composited,
    settings: RenderSettings,
    g_rgb: Tensor,
    g_T: Tensor,
    g_z: Tensor | None,
    error: Tensor,
) -> tuple[Tensor, Tensor | None]:
    """(N, gradient_width) gradient rows, and (N, net_width) of colour networks; the slots' contents are used up.

    Args:
        g_rgb: (H W, C); g_T: (H W,), with the background's share; g_z: (H W,) or None; error: (H W,). float32,
        contiguous.
    """
    lists, device = frame.lists, frame.device
    pairs, tiles = lists.pairs, lists.starts.shape[0] - 1
    lens, size = _camera(frame)
    depth = g_z is not None
    gz = array(torch.empty(0, device=device) if g_z is None else g_z, wp.float32)
    rows, ids, tile_of = array(frame.rows, wp.vec4), array(lists.ids, wp.int32), array(lists.tile_of, wp.int32)
    shapes, starts_at, hits = array(drawn.spans, wp.uint16), array(drawn.offsets, wp.int32), array(drawn.hits, wp.vec2)
    reached, grad = array(drawn.reached, wp.int32), array(g_rgb, wp.float32)
    T, gT, zs, hues = (
        array(drawn.transmittance, wp.float32),
        array(g_T, wp.float32),
        array(drawn.depths, wp.float32),
        array(drawn.hues, wp.float32),
    )
    if drawn.order is None or drawn.begins is None or drawn.owners is None:
        launch(
            pixels_kernel(form, depth), (tiles, L.PIXELS),
            (rows, array(lists.starts, wp.int32), ids, shapes, starts_at, _limits(settings), size, T, reached, grad, gT, gz, zs, hues, hits),
            device, L.PIXELS,
        )  # fmt: skip
    else:
        launch(
            uncomposite_kernel(form, depth), len(drawn.transmittance),
            (
                rows, ids, array(drawn.order, wp.int64), array(drawn.begins, wp.int32), array(drawn.owners, wp.int32), _limits(settings), T, grad, gT, gz,
                zs, hues, hits,
            ), device,
        )  # fmt: skip
    width = L.gradient_width(form.neurons, form.channels)
    pair_rows = torch.empty(pairs, width, dtype=torch.float32, device=device)
    out, error_at = array(pair_rows.view(-1), wp.float32), array(error, wp.float32)
    launch(
        pairs_kernel(form, depth), (pairs, L.WARP),
        (
            rows, ids, tile_of, shapes, starts_at, lens, settings.depth_floor, size, reached, hits, array(g_rgb.view(-1), wp.float32), gz, error_at,
            out,
        ), device, L.WARP,
    )  # fmt: skip
    if len(drawn.delicate):
        launch(
            delicate_pairs_kernel(form, depth), (len(drawn.delicate), L.WARP),
            (
                array(drawn.delicate, wp.int32), array(frame.wide, wp.float64), array(frame.slots, wp.int32), ids, tile_of, shapes, starts_at, lens, settings.depth_floor, size,
                form.neurons, reached, hits, grad, gz, error_at, out,
            ), device, L.WARP,
        )  # fmt: skip
    grads = _sums(frame, pair_rows)
    if net is None:
        return grads, None
    own = torch.empty(pairs, net_width(form), device=device)
    units = array(net.rows if net.hidden else torch.empty(1, 1, 4, device=device), wp.vec4)
    launch(
        net_pairs_kernel(form), (pairs, L.WARP),
        (rows, units, ids, tile_of, shapes, starts_at, settings.depth_floor, size, reached, hits, hues, grad, array(own.view(-1), wp.float32)),
        device, L.WARP,
    )  # fmt: skip
    if len(drawn.delicate):
        launch(
            delicate_net_kernel(form), (len(drawn.delicate), L.WARP),
            (
                array(drawn.delicate, wp.int32), array(frame.wide, wp.float64), array(net.wide, wp.vec4d), units, net.hidden,
                array(frame.slots, wp.int32), ids, tile_of, shapes, starts_at, settings.depth_floor, size, reached, hits, hues, grad,
                array(own.view(-1), wp.float32),
            ), device, L.WARP,
        )  # fmt: skip
    return grads, _sums(frame, own)


def _sums(frame: Frame, pair_rows: Tensor) -> Tensor:
    """(N, width) sums of the rows of each primitive's pairs."""
    grads = torch.empty(frame.rows.shape[0], pair_rows.shape[1], dtype=torch.float32, device=frame.device)
    lists = frame.lists
    launch(
        sum_pairs, grads.shape,
        (array(lists.first, wp.int32), array(lists.slots_of, wp.int32), array(pair_rows, wp.float32), array(grads, wp.float32)), frame.device,
    )  # fmt: skip
    return grads
