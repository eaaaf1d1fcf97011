"""The CUDA backend as one differentiable operation, on the tensors' device and the caller's stream."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.warp import array, launch_kernel, wp
from neuprim.core.errors import BackendUnavailable
from neuprim.core.model.checks import check_primitive_colours_finite, non_finite_primitive_error
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.backward import pairs_kernel, pixels_kernel, sum_pairs
from neuprim.core.render.cuda.binning import row_spans
from neuprim.core.render.cuda.colour_net import (
    FIRST_COLOUR,
    ColourNet,
    colour_net_backward,
    fill_wide_net,
    float64_hues_kernel,
    float64_net_kernel,
    net_gradient_row_width,
    net_pairs_kernel,
    prepare_rasterizer_colour_net,
)
from neuprim.core.render.cuda.float64 import float64_opacity_kernel, float64_pairs_kernel
from neuprim.core.render.cuda.forward import composite_kernel, forward_kernel, uncomposite_kernel
from neuprim.core.render.cuda.frame import Frame, NotFinitePrimitive, prepare_frame
from neuprim.core.render.cuda.layout import KernelForm
from neuprim.core.render.cuda.prepare_backward import prepare_backward
from neuprim.core.render.output import RenderOutput, RenderStats, mean_depth
from neuprim.core.render.rasterize import (
    NET,
    PARAMETERS,
    RasterRequest,
    rasterize,
    rasterizer_input_gradients,
    rasterizer_tensors,
    remember_rasterizer_inputs,
)
from neuprim.core.settings import RenderSettings


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, request: RasterRequest, viewmat: Tensor, background: Tensor, palette: Tensor, *tensors: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        parameters, weights = tensors[: len(PARAMETERS)], tensors[len(PARAMETERS) :]
        _, log_scales, quats, W1, *_ = parameters
        form = KernelForm(W1.shape[1], request.edge, palette.shape[1], weights[0].shape[1] if weights else -1)
        net: ColourNet | None = None
        if weights:
            check_primitive_colours_finite(dict(zip(NET, weights, strict=True)))
            net = prepare_rasterizer_colour_net(log_scales, quats, *weights)
        forced = net.fast if net is not None and net.hidden else None
        try:
            frame = prepare_frame(request, viewmat, palette, parameters, forced)
        except NotFinitePrimitive as error:
            named = dict(zip(PARAMETERS, parameters, strict=True)) | {"base" if weights else "colors": palette}
            raise non_finite_primitive_error(named, error.row) from None
        if net is not None and net.hidden and len(frame.which):
            fill_wide_net(net, frame.which, frame.parameters[1], frame.parameters[2])
        settings, stats, camera = request.settings, request.stats, request.camera
        stats.pairs, stats.extra["float64"] = frame.lists.pairs, frame.wide.shape[0]
        behind = background.detach().to(frame.device, torch.float32).contiguous()
        drawn = composite_frame(frame, form, net, behind, settings, request.differentiable)
        stats.extra["hits"] = drawn.hits.shape[0]
        ctx.request, ctx.frame, ctx.form, ctx.net, ctx.drawn, ctx.background = request, frame, form, net, drawn, behind
        remember_rasterizer_inputs(ctx, (viewmat, background, palette, *tensors))
        h, w = camera.height, camera.width
        z = drawn.zsum.view(h, w) if settings.depth else drawn.zsum
        return drawn.rgb.view(h, w, form.channels), drawn.transmittance.view(h, w), z

    @staticmethod
    def backward(ctx: Any, g_rgb: Tensor | None, g_T: Tensor | None, g_z: Tensor | None) -> tuple[Any, ...]:  # type: ignore[override]
        frame, form, settings = ctx.frame, ctx.form, ctx.request.settings
        drawn: CompositedFrame | None = ctx.drawn
        net: ColourNet | None = ctx.net
        if drawn is None:
            raise RuntimeError(
                "the cuda backend's backward pass frees what the forward pass saved: it runs once per frame"
            )
        ctx.drawn = None
        device, pixels = frame.device, drawn.transmittance.shape[0]
        if g_rgb is None:
            rgb = torch.zeros(pixels, form.channels, device=device)
        else:
            rgb = g_rgb.reshape(pixels, -1).float().contiguous()
        T = rgb @ ctx.background
        if g_T is not None:
            T = T + g_T.reshape(-1).float()
        asked = ctx.request.stats.contributions
        if asked is None:
            error = torch.zeros(pixels, device=device)
        else:
            error = asked.error.to(device, torch.float32).reshape(-1).contiguous()
        z = g_z.reshape(-1).float().contiguous() if settings.depth and g_z is not None else None
        gradient = ImageGradient(rgb, T.contiguous(), z, error)
        grads, net_grads = rasterizer_gradient_rows(frame, form, net, drawn, settings, gradient)
        base = L.G_NEURONS + L.PER_NEURON * form.neurons
        colours = grads[:, base : base + form.channels]
        if net_grads is not None:
            grads[:, : L.G_OFFSET] += net_grads[:, : L.G_OFFSET]
            colours = net_grads[:, FIRST_COLOUR : FIRST_COLOUR + form.channels]
        own, view = prepare_backward(frame, grads, bool(ctx.needs_input_grad[1]))
        if asked is not None:
            asked.fill(grads[:, L.G_WEIGHT].clone(), grads[:, L.G_ERROR].clone())
        g_net: tuple[Tensor, ...] = ()
        if net is not None and net_grads is not None:
            g_net = colour_net_backward(net, frame.parameters, grads, net_grads, own)
        background = (rgb * drawn.transmittance[:, None]).sum(0) if ctx.needs_input_grad[2] else None
        return rasterizer_input_gradients(ctx, view, (background, colours.clone(), *own, *g_net))


def render(
    lowered: LoweredPrimitives, camera: Camera, background: Tensor | None, settings: RenderSettings
) -> RenderOutput:
    """Draw a frame; see :data:`neuprim.core.render.draw.Draw`."""
    return rasterize(_Rasterize, "cuda", lowered, camera, background, settings)


def render_slabs(
    lowered: LoweredPrimitives, slabs: Tensor, count: int, camera: Camera, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Return opacity and depth of each slab, in one frame; see :func:`neuprim.core.render.render_slabs`."""
    means, settings = lowered.geometry.means, replace(settings, depth=True)
    tensors = rasterizer_tensors(lowered)
    blank = torch.zeros(len(means), 1, device=means.device)
    request = RasterRequest.of(lowered, camera, settings, RenderStats("cuda", len(means)))
    try:
        images = (slabs.int().contiguous(), count)
        frame = prepare_frame(request, camera.viewmat, blank, tensors, images=images)
    except NotFinitePrimitive as error:
        raise non_finite_primitive_error(dict(zip(PARAMETERS, tensors, strict=True)), error.row) from None
    drawn = composite_frame(
        frame, KernelForm(frame.neurons, request.edge, 1), None, blank.new_zeros(1), settings, False, count
    )
    alpha = (1 - drawn.transmittance).view(count, camera.height, camera.width).to(means.dtype)
    return alpha, mean_depth(drawn.zsum.view(alpha.shape), alpha).to(alpha.dtype)


_MAX_HITS = 2**31

_NUMBERS = {
    torch.float32: wp.float32,
    torch.float64: wp.float64,
    torch.int32: wp.int32,
    torch.int64: wp.int64,
    torch.int16: wp.uint16,
}


@dataclass
class CompositedFrame:
    """What a forward pass leaves."""

    rgb: Tensor  # (H W, C)
    transmittance: Tensor  # (H W,)
    zsum: Tensor  # (H W,) sum of w z, empty if no depth is wanted
    spans: Tensor  # (pairs, 16) int16, which with the offsets say the pixels of each pair, see row_spans
    offsets: Tensor  # (pairs + 1,) int32
    hits: Tensor  # (slots, 2) opacity and transmittance before it, if they were kept
    depths: Tensor  # (slots,) camera-z, if wanted
    hues: Tensor  # (slots, C) colours before max(0, .), of colour networks
    reached: Tensor  # (tiles,) int32, the pairs before it were composited
    in_float64: Tensor  # (D,) int32, the pairs that are drawn in float64, rising
    # where hits were sorted by entry:
    order: Tensor | None = None  # (slots,) int64 slots by pixel and entry
    begins: Tensor | None = None  # (H W + 1,) int32, first of each pixel
    owners: Tensor | None = None  # (slots,) int32, pair of each slot


@dataclass
class ImageGradient:
    """Gradients of an image, float32 and contiguous, and the error of each pixel for the contributions."""

    rgb: Tensor  # (H W, C)
    transmittance: Tensor  # (H W,), with the background's share
    z: Tensor | None  # (H W,)
    error: Tensor  # (H W,)


def _warp_array(tensor: Tensor) -> Any:
    return array(tensor, _NUMBERS[tensor.dtype])


class _KernelArrays:
    """Arrays and numbers of a frame as the kernels take them."""

    def __init__(
        self, frame: Frame, net: ColourNet | None, settings: RenderSettings, spans: Tensor, offsets: Tensor
    ) -> None:
        camera, device = frame.projection.camera, frame.device
        self.rows, self.wide, self.slots = (
            array(frame.rows, wp.vec4),
            _warp_array(frame.wide),
            _warp_array(frame.slots),
        )
        self.starts, self.ids = _warp_array(frame.lists.starts), _warp_array(frame.lists.ids)
        self.tile_of, self.spans, self.offsets = (
            _warp_array(frame.lists.tile_of),
            _warp_array(spans),
            _warp_array(offsets),
        )
        units = torch.empty(1, 1, 4, device=device) if net is None or not net.hidden else net.rows
        self.units = array(units, wp.vec4)
        self.lens = wp.vec4(camera.fx, camera.fy, camera.cx, camera.cy)
        self.size = wp.vec2i(camera.width, camera.height)
        self.limits = wp.vec4(settings.alpha_min, settings.alpha_max, settings.transmittance_min, 0.0)

    @property
    def covered(self) -> tuple[Any, ...]:
        """Primitive, tile, and pixels of every pair."""
        return self.ids, self.tile_of, self.spans, self.offsets


def _marked_pairs(marked: Tensor, count: int) -> Tensor:
    """(count,) int32, where a mask with so many is set; the host does not wait."""
    place = torch.where(marked, torch.cumsum(marked, 0) - 1, count)
    numbers = torch.arange(marked.shape[0], dtype=torch.int32, device=marked.device)
    return torch.empty(count + 1, dtype=torch.int32, device=marked.device).index_copy_(0, place, numbers)[:count]


def _count_slots(frame: Frame, counts: Tensor) -> tuple[int, Tensor, Tensor]:
    """Number of slots, (pairs + 1,) first slot of each pair, float64 pairs; waits. BackendUnavailable: too many."""
    in_float64 = torch.empty(0, dtype=torch.int32, device=frame.device)
    offsets = torch.zeros(len(counts) + 1, dtype=torch.int32, device=frame.device)
    ends = torch.cumsum(counts, 0, dtype=torch.int64)
    offsets[1:] = ends
    if frame.wide.shape[0] > 0:
        marked = frame.slots[frame.lists.ids] >= 0
        total, few = torch.stack((ends[-1], marked.sum())).tolist()
        in_float64 = _marked_pairs(marked, few)
    else:
        total = int(ends[-1])
    if total >= _MAX_HITS:
        raise BackendUnavailable(
            f"primitives cover {total} pixels in all; the cuda backend counts to {_MAX_HITS - 1}: render a smaller "
            f"image"
        )
    return total, offsets, in_float64


def composite_frame(
    frame: Frame,
    form: KernelForm,
    net: ColourNet | None,
    background: Tensor,
    settings: RenderSettings,
    differentiable: bool,
    images: int = 1,
) -> CompositedFrame:
    """Draw; several ``images`` without gradients, sorted by centres. The host waits where slots are kept."""
    lists, device, camera = frame.lists, frame.device, frame.projection.camera
    pairs, tiles = lists.pairs, lists.starts.shape[0] - 1

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=device)

    spans, counts = empty(pairs, L.TILE, dtype=torch.int16), empty(pairs, dtype=torch.int32)
    offsets = torch.zeros(pairs + 1, dtype=torch.int32, device=device)
    a = _KernelArrays(frame, net, settings, spans, offsets)
    silhouettes = (_warp_array(frame.spans), array(frame.boxes, wp.vec4i))
    launch_kernel(
        row_spans, pairs, (a.rows, *silhouettes, a.ids, a.tile_of, a.size, a.spans, _warp_array(counts)), device
    )
    sorts = settings.sort == "entry"
    keep = differentiable or sorts or frame.wide.shape[0] > 0
    total, in_float64 = 0, empty(0, dtype=torch.int32)
    if keep and pairs:
        total, offsets, in_float64 = _count_slots(frame, counts)
        a.offsets = _warp_array(offsets)
    hits, depths = empty(total, 2), empty(total if settings.depth else 0)
    hues = empty(total if net is not None else 0, form.channels)
    if len(in_float64):
        few, which = (len(in_float64), L.WARP), _warp_array(in_float64)
        kept = (array(hits, wp.vec2), _warp_array(depths))
        launch_kernel(
            float64_opacity_kernel(settings.depth),
            few,
            (which, a.wide, a.slots, *a.covered, a.lens, a.limits, a.size, form.neurons, form.edge, *kept),
            device,
            L.WARP,
        )
        if net is not None and net.hidden:
            wide_net, first = array(net.wide, wp.vec4d), L.rasterizer_colour_column(form.neurons)
            launch_kernel(
                float64_hues_kernel(form.channels),
                few,
                (
                    which,
                    a.wide,
                    wide_net,
                    a.units,
                    a.rows,
                    first,
                    net.hidden,
                    a.slots,
                    *a.covered,
                    a.size,
                    _warp_array(hues),
                ),
                device,
                L.WARP,
            )
    pixels = images * camera.width * camera.height
    rgb, T, z = empty(pixels, form.channels), empty(pixels), empty(pixels if settings.depth else 0)
    reached = empty(tiles, dtype=torch.int32)
    keys, owners = empty(total if sorts else 0, dtype=torch.int64), empty(total if sorts else 0, dtype=torch.int32)
    drawn = CompositedFrame(rgb, T, z, spans, offsets, hits, depths, hues, reached, in_float64)
    image, slots = (
        (_warp_array(rgb), _warp_array(T), _warp_array(z)),
        (array(hits, wp.vec2), _warp_array(depths), _warp_array(hues)),
    )
    tile = (a.rows, a.units, a.starts, a.ids, a.spans, a.offsets, a.lens, a.limits, _warp_array(background), a.size)
    listed = (_warp_array(keys), _warp_array(owners))
    kernel = forward_kernel(form, keep, settings.depth, sorts, images > 1)
    launch_kernel(kernel, (tiles, L.PIXELS), (*tile, *image, *slots, _warp_array(reached), *listed), device, L.PIXELS)
    if not sorts:
        return drawn
    keys, order = torch.sort(keys, stable=True)
    begins = torch.empty(pixels + 1, dtype=torch.int32, device=device)
    begins[pixels] = torch.searchsorted(keys, pixels << 32)
    sorted_hits = (a.rows, a.ids, _warp_array(keys), _warp_array(order), total, _warp_array(owners), a.limits)
    written = (*reversed(slots), *image, _warp_array(begins))
    launch_kernel(
        composite_kernel(form, settings.depth), pixels, (*sorted_hits, _warp_array(background), *written), device
    )
    drawn.order, drawn.begins, drawn.owners = order, begins, owners
    return drawn


def rasterizer_gradient_rows(
    frame: Frame,
    form: KernelForm,
    net: ColourNet | None,
    drawn: CompositedFrame,
    settings: RenderSettings,
    gradient: ImageGradient,
) -> tuple[Tensor, Tensor | None]:
    """Return (N, gradient_width) rows, and (N, net_gradient_row_width) of networks; uses up the slots' contents."""
    lists, device, depth = frame.lists, frame.device, gradient.z is not None
    pairs, tiles = lists.pairs, lists.starts.shape[0] - 1
    a = _KernelArrays(frame, net, settings, drawn.spans, drawn.offsets)
    g_z = _warp_array(torch.empty(0, device=device) if gradient.z is None else gradient.z)
    g_rgb, g_T, error = _warp_array(gradient.rgb), _warp_array(gradient.transmittance), _warp_array(gradient.error)
    hits, reached, T = array(drawn.hits, wp.vec2), _warp_array(drawn.reached), _warp_array(drawn.transmittance)
    depths, hues, floor = _warp_array(drawn.depths), _warp_array(drawn.hues), settings.depth_floor
    if drawn.order is None or drawn.begins is None or drawn.owners is None:
        tile = (a.rows, a.starts, a.ids, a.spans, a.offsets, a.limits, a.size)
        images = (T, reached, g_rgb, g_T, g_z, depths, hues, hits)
        launch_kernel(pixels_kernel(form, depth), (tiles, L.PIXELS), (*tile, *images), device, L.PIXELS)
    else:
        sorted_hits = (_warp_array(drawn.order), _warp_array(drawn.begins), _warp_array(drawn.owners))
        launch_kernel(
            uncomposite_kernel(form, depth),
            len(drawn.transmittance),
            (a.rows, a.ids, *sorted_hits, a.limits, T, g_rgb, g_T, g_z, depths, hues, hits),
            device,
        )
    few, which = (len(drawn.in_float64), L.WARP), _warp_array(drawn.in_float64)
    width = L.gradient_width(form.neurons, form.channels)
    pair_rows = torch.empty(pairs, width, dtype=torch.float32, device=device)
    out, flat_rgb = _warp_array(pair_rows.view(-1)), _warp_array(gradient.rgb.view(-1))
    launch_kernel(
        pairs_kernel(form, depth),
        (pairs, L.WARP),
        (a.rows, *a.covered, a.lens, floor, a.size, reached, hits, flat_rgb, g_z, error, out),
        device,
        L.WARP,
    )
    if len(drawn.in_float64):
        wide = (which, a.wide, a.slots, *a.covered, a.lens, floor, a.size, form.neurons)
        launch_kernel(
            float64_pairs_kernel(form, depth), few, (*wide, reached, hits, g_rgb, g_z, error, out), device, L.WARP
        )
    grads = _sum_pair_rows(frame, pair_rows)
    if net is None:
        return grads, None
    net_rows = torch.empty(pairs, net_gradient_row_width(form), device=device)
    slots = (reached, hits, hues, g_rgb, _warp_array(net_rows.view(-1)))
    launch_kernel(
        net_pairs_kernel(form), (pairs, L.WARP), (a.rows, a.units, *a.covered, floor, a.size, *slots), device, L.WARP
    )
    if len(drawn.in_float64):
        weights = (which, a.wide, array(net.wide, wp.vec4d), a.units, net.hidden, a.slots)
        launch_kernel(float64_net_kernel(form), few, (*weights, *a.covered, floor, a.size, *slots), device, L.WARP)
    return grads, _sum_pair_rows(frame, net_rows)


def _sum_pair_rows(frame: Frame, pair_rows: Tensor) -> Tensor:
    """(N, width) sums of the rows of each primitive's pairs."""
    grads = torch.empty(frame.rows.shape[0], pair_rows.shape[1], dtype=torch.float32, device=frame.device)
    lists = (_warp_array(frame.lists.first), _warp_array(frame.lists.slots_of))
    launch_kernel(sum_pairs, grads.shape, (*lists, _warp_array(pair_rows), _warp_array(grads)), frame.device)
    return grads
