"""Render a frame with the cuda backend, as one autograd operation on the tensors' device and torch's current stream."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.checks import check_primitive_colours_finite, non_finite_primitive_error
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.backward import ImageGradient, rasterizer_gradient_rows
from neuprim.core.render.cuda.binning import FrameCapacity
from neuprim.core.render.cuda.colour_net import (
    FIRST_COLOUR,
    ColourNet,
    colour_net_backward,
    fill_wide_net,
    prepare_rasterizer_colour_net,
)
from neuprim.core.render.cuda.forward import CompositedFrame, composite_frame
from neuprim.core.render.cuda.layout import KernelForm
from neuprim.core.render.cuda.prepare import NotFinitePrimitive, prepare_frame
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
        drawn = composite_frame(frame, form, net, behind, settings, request.differentiable, capacity=request.capacity)
        stats.extra["hits"], stats.extra["float64_pairs"] = drawn.hits.shape[0], drawn.in_float64.shape[0]
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
                "the cuda backend's backward pass frees what the forward pass saved: it runs once per frame. "
                "Render the frame again before another backward pass"
            )
        ctx.drawn = None
        device, pixels = frame.device, drawn.transmittance.shape[0]
        if g_rgb is None:
            rgb = torch.zeros(pixels, form.channels, device=device)
        else:
            rgb = g_rgb.reshape(pixels, -1).float().contiguous()
        T = None if g_T is None else g_T.reshape(-1).float().contiguous()
        asked = ctx.request.stats.contributions
        if asked is None:
            error = torch.zeros(pixels, device=device)
        else:
            error = asked.error.to(device, torch.float32).reshape(-1).contiguous()
        z = g_z.reshape(-1).float().contiguous() if settings.depth and g_z is not None else None
        gradient = ImageGradient(rgb, T, ctx.background, z, error)
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
    lowered: LoweredPrimitives,
    camera: Camera,
    background: Tensor | None,
    settings: RenderSettings,
    capacity: FrameCapacity | None = None,
) -> RenderOutput:
    """Render a frame; see :data:`neuprim.core.render.output.Draw` for arguments and result.

    ``capacity`` fixes the sizes of the frame's arrays, so that the host never waits for the GPU. With a ``capacity``,
    colours must be :class:`Constant`, and the statistics contain the sizes of the arrays instead of counts.
    """
    return rasterize(_Rasterize, "cuda", lowered, camera, background, settings, capacity)


def frame_counts(stats: RenderStats) -> tuple[int, int, int, int]:
    """Return the counts of a frame that was rendered without capacity, in the order of :class:`FrameCapacity`.

    The counts are the numbers of (tile, primitive) pairs, primitives in float64, slots (pixels of all pairs) and pairs
    in float64. The last two are 0 if the frame needed no slots.
    """
    return stats.pairs, stats.extra["float64"], stats.extra["hits"], stats.extra["float64_pairs"]


def render_slabs(
    lowered: LoweredPrimitives, slabs: Tensor, count: int, camera: Camera, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Render each slab (group of primitives) to an image of its own; return (count, H, W) opacities and mean depths.

    One frame renders all images, without gradients. A slab without primitives has opacity 0. ``slabs`` (N,) has the
    slab of each primitive, 0 to ``count`` - 1. See :func:`neuprim.core.render.render_slabs`.
    """
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
