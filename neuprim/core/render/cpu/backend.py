"""The cpu backend as one differentiable operation: tensors of primitives in, image out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.threads import chunk_size, parallel_for, resolve_threads
from neuprim.core.model.checks import check_primitive_colours_finite, non_finite_primitive_error
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import layout as P
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.backward import ImageGradient, backward_tiles, sum_tile_pair_gradients
from neuprim.core.render.cpu.chord import EDGE_TYPES
from neuprim.core.render.cpu.colour_net import ColourNet, colour_net_backward, prepare_rasterizer_colour_net
from neuprim.core.render.cpu.entry import backward_tiles_by_entry, composite_tiles_by_entry
from neuprim.core.render.cpu.forward import SavedForBackward, TileImage, composite_tiles
from neuprim.core.render.cpu.prepare import (
    PrimitiveArrays,
    Projected,
    View,
    prepare_primitives,
    prepare_wide,
)
from neuprim.core.render.cpu.prepare_backward import prepare_backward
from neuprim.core.render.cpu.tiles import FrameArrays, TileLists, bin_primitives
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

_PRIMITIVES_PER_CHUNK = 512
_UNITS_PER_THREAD = 8  # a thread gets about this many units of work per frame, or fewer
_TILES_ALONE = 64  # least tiles per unit of work of a single thread
Array = np.ndarray[Any, Any]


@dataclass(frozen=True)
class _PreparedFrame:
    """The data of one frame that both the forward and the backward pass use."""

    request: RasterRequest
    tensors: dict[str, Array]  # parameters and weights of colour networks by name; all have the same dtype
    view: View
    projected: Projected
    arrays: FrameArrays
    lists: TileLists
    net: ColourNet | None
    tiles: int  # number of tiles per image
    chunk: int  # number of tiles per unit of work

    @property
    def parameters(self) -> PrimitiveArrays:
        return PrimitiveArrays(*(self.tensors[name] for name in PARAMETERS))


def _cpu_array(tensor: Tensor) -> Array:
    return np.ascontiguousarray(tensor.detach().resolve_neg().numpy())


def _rasterizer_arrays_by_name(tensors: Sequence[Tensor]) -> dict[str, Array]:
    """Return ``tensors``, in the order of PARAMETERS and NET, as a dictionary of numpy arrays by name.

    If dtypes differ, all arrays are float64.
    """
    arrays = [_cpu_array(x) for x in tensors]
    if len({x.dtype for x in arrays}) > 1:
        arrays = [x.astype(np.float64, copy=False) for x in arrays]
    return dict(zip((*PARAMETERS, *NET), arrays, strict=False))


@lru_cache(maxsize=4)
def _ray_norms(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Array:
    """Return (H, W) float32 lengths of the pixels' ray directions, each scaled so that its camera-z is 1."""
    x = (np.arange(width) + 0.5 - cx) / fx
    y = (np.arange(height) + 0.5 - cy) / fy
    result: Array = np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2).astype(np.float32)
    return result


def _rasterizer_view(camera: Camera, viewmat: Tensor, near: float, turns: float) -> View:
    matrix = viewmat.detach().double().numpy()
    R, t = np.ascontiguousarray(matrix[:3, :3]), np.ascontiguousarray(matrix[:3, 3])
    fx, fy, cx, cy = (float(x) for x in (camera.fx, camera.fy, camera.cx, camera.cy))
    return View(R, t, fx, fy, cx, cy, camera.width, camera.height, near, turns)


def _prepare_frame(
    request: RasterRequest, viewmat: Tensor, tensors: Sequence[Tensor], images: tuple[Array, int] | None = None
) -> _PreparedFrame:
    """Project the primitives, sort them into tiles, and return the data of the frame.

    ``images`` is the (N,) image index of each primitive and the number of images; None means one image.
    """
    camera, settings = request.camera, request.settings
    arrays, threads = _rasterizer_arrays_by_name(tensors), settings.threads
    parameters = PrimitiveArrays(*(arrays[name] for name in PARAMETERS))
    count, K = parameters.W1.shape[:2]
    projected = Projected.allocate(count, K)
    view = _rasterizer_view(camera, viewmat, settings.near_plane, request.turns)
    least = P.min_visible_depth(settings.alpha_min)
    share = chunk_size(count, _PRIMITIVES_PER_CHUNK, threads)
    parallel_for(prepare_primitives, count, share, threads, parameters, view, request.edge, least, projected)
    bad = np.flatnonzero(projected.status == P.NON_FINITE)
    if bad.size:
        raise non_finite_primitive_error({name: torch.from_numpy(array) for name, array in arrays.items()}, int(bad[0]))
    in_float64, net_rows = projected.in_float64, None
    if "Wx" in arrays:
        net_rows, fast = prepare_rasterizer_colour_net(np.arange(count), arrays, False, threads)
        in_float64 = in_float64 | fast
    slots, which = np.full(count, -1, np.int32), np.flatnonzero(in_float64 & (projected.status == P.VISIBLE))
    slots[which] = np.arange(len(which), dtype=np.int32)
    wide = np.empty((len(which), projected.rows.shape[1]))
    parallel_for(
        prepare_wide, len(which), _PRIMITIVES_PER_CHUNK, threads, which, parameters, view, projected.order, wide
    )
    net = None
    if net_rows is not None:
        hidden = arrays["Wx"].shape[1]
        net = ColourNet(net_rows, prepare_rasterizer_colour_net(which, arrays, True, threads)[0], hidden + hidden % 2)
    lists = bin_primitives(projected, camera.width, camera.height, threads, images)
    request.stats.extra["float64"], request.stats.pairs = len(which), lists.pairs
    frame = FrameArrays(
        rows=projected.rows,
        wide=wide,
        slots=slots,
        spans=projected.spans,
        boxes=projected.boxes,
        kinds=projected.kinds,
        starts=lists.starts,
        ids=lists.ids,
        norms=_ray_norms(view.width, view.height, view.fx, view.fy, view.cx, view.cy),
        alpha_min=np.float32(settings.alpha_min),
        alpha_max=np.float32(settings.alpha_max),
        transmittance_min=np.float32(settings.transmittance_min),
        depth_floor=np.float32(settings.depth_floor),
        neurons=K + K % 2,  # a padding neuron has amplitude 0
    )
    # Both passes use the same unit of work: half a row of tiles, or more if threads are few, because every unit costs
    # a call.
    across, workers = -(-camera.width // P.TILE), resolve_threads(threads)
    tiles = across * -(-camera.height // P.TILE)
    chunk = max(2 if workers > 1 else _TILES_ALONE, across // 2, tiles // (_UNITS_PER_THREAD * workers))
    return _PreparedFrame(request, arrays, view, projected, frame, lists, net, tiles, chunk)


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, request: RasterRequest, viewmat: Tensor, background: Tensor, palette: Tensor, *tensors: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        weights = dict(zip(NET, tensors[len(PARAMETERS) :], strict=False))
        colours = weights | {"base" if weights else "colors": palette}
        check_primitive_colours_finite(colours, dict(zip(PARAMETERS, tensors, strict=False)) | colours)
        frame = _prepare_frame(request, viewmat, tensors)
        settings, camera = request.settings, request.camera
        h, w = camera.height, camera.width
        image = TileImage(
            rgb=np.empty((h, w, palette.shape[1]), np.float32),
            transmittance=np.empty((h, w), np.float32),
            zsum=np.zeros((h, w) if settings.depth else (1, 1), np.float32),
            last=np.empty((h, w), np.int32),
            background=_cpu_array(background.float()),
            with_depth=settings.depth,
        )
        colors = np.ascontiguousarray(_cpu_array(palette), np.float32)
        work = (frame.tiles, frame.chunk, settings.threads, frame.arrays, colors, image)
        form, saved = (frame.net, EDGE_TYPES[request.edge]), None
        if settings.sort == "entry":
            lanes = parallel_for(composite_tiles_by_entry, *work, *form)
        else:
            saved = SavedForBackward.allocate(frame.lists.pairs if request.differentiable else 0)
            drawn = parallel_for(composite_tiles, *work, saved.live, saved.first_lane, *form)
            lanes, saved.depths = [n for n, _ in drawn], [depths for _, depths in drawn]
        request.stats.extra["forward_lanes"] = sum(lanes)
        ctx.frame, ctx.colors, ctx.image, ctx.saved = frame, colors, image, saved
        remember_rasterizer_inputs(ctx, (viewmat, background, palette, *tensors))
        return torch.from_numpy(image.rgb), torch.from_numpy(image.transmittance), torch.from_numpy(image.zsum)

    @staticmethod
    def backward(ctx: Any, g_rgb: Tensor | None, g_T: Tensor | None, g_z: Tensor | None) -> tuple[Any, ...]:  # type: ignore[override]
        frame: _PreparedFrame = ctx.frame
        image: TileImage = ctx.image
        request, count, threads = frame.request, len(ctx.colors), frame.request.settings.threads
        (h, w), C = image.transmittance.shape, ctx.colors.shape[1]
        g_rgb = torch.zeros(h, w, C) if g_rgb is None else g_rgb
        g_T = torch.zeros(h, w) if g_T is None else g_T
        with_depth = request.settings.depth and g_z is not None
        asked = request.stats.contributions
        width = L.gradient_width(frame.arrays.neurons, C, frame.net.hidden if frame.net else 0)
        pair_rows = np.empty((frame.lists.pairs, width), np.float32)
        gradient = ImageGradient(
            transmittance=image.transmittance,
            last=image.last,
            rgb=_float32_render_image(g_rgb),
            g_transmittance=_float32_render_image(g_T + g_rgb @ torch.from_numpy(image.background)),
            z=_float32_render_image(g_z) if with_depth and g_z is not None else np.zeros((1, 1), np.float32),
            error=np.zeros((h, w), np.float32) if asked is None else _float32_render_image(asked.error.detach()),
            pair_rows=pair_rows,
            with_depth=with_depth,
        )
        form, saved = (frame.net, EDGE_TYPES[request.edge]), ctx.saved
        work = (frame.tiles, frame.chunk, threads, frame.arrays, ctx.colors, gradient)
        if saved is None:
            lanes = parallel_for(backward_tiles_by_entry, *work, *form)
        else:

            def tiles(start: int, stop: int, *arguments: Any) -> Any:
                depths = saved.depths[start // frame.chunk]
                return backward_tiles(start, stop, *arguments, saved.live, saved.first_lane, depths, *form)

            lanes = parallel_for(tiles, *work)
        request.stats.extra["backward_lanes"] = sum(lanes)
        grads, touched = np.empty((count, width), np.float32), np.empty(count, np.bool_)
        lists, primitives = frame.lists, (count, chunk_size(count, _PRIMITIVES_PER_CHUNK, threads), threads)
        parallel_for(sum_tile_pair_gradients, *primitives, lists.first, lists.slots, pair_rows, grads, touched)
        parameters = frame.parameters
        out = PrimitiveArrays(*(np.empty(x.shape, np.float32) for x in parameters))
        g_view = np.zeros((count if ctx.needs_input_grad[1] else 0, 3, 4), np.float64)
        parallel_for(
            prepare_backward, *primitives, parameters, frame.view, frame.projected, grads, touched, out, g_view
        )
        base = P.G_NEURONS + P.PER_NEURON * frame.arrays.neurons
        g_net = []
        if frame.net:
            t = frame.tensors
            g_net = [np.zeros(t[name].shape, np.float32) for name in NET]
            parallel_for(
                colour_net_backward, *primitives, t["log_scales"], t["quats"], t["Wx"], frame.net.rows,
                grads, base + C, touched, out.log_scales, out.quats, *g_net,
            )  # fmt: skip
        if asked is not None:
            asked.fill(torch.from_numpy(grads[:, P.G_WEIGHT].copy()), torch.from_numpy(grads[:, P.G_ERROR].copy()))
        view = torch.from_numpy(g_view.sum(0)) if len(g_view) or ctx.needs_input_grad[1] else None
        background = None
        if ctx.needs_input_grad[2]:
            background = (g_rgb * torch.from_numpy(image.transmittance)[..., None]).sum((0, 1))
        results = (np.ascontiguousarray(grads[:, base : base + C]), *out, *g_net)
        return rasterizer_input_gradients(ctx, view, (background, *map(torch.from_numpy, results)))


def _float32_render_image(tensor: Tensor) -> Array:
    return np.ascontiguousarray(tensor.resolve_neg().numpy(), np.float32)


def render(
    lowered: LoweredPrimitives, camera: Camera, background: Tensor | None, settings: RenderSettings
) -> RenderOutput:
    """Render a frame on the CPU; for arguments and result see :data:`neuprim.core.render.output.Draw`."""
    return rasterize(_Rasterize, "cpu", lowered, camera, background, settings)


def render_slabs(
    lowered: LoweredPrimitives, slabs: Tensor, count: int, camera: Camera, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Render each slab (group of primitives) to an image of its own; return (count, H, W) opacities and mean depths.

    One pass renders all images. For arguments see :func:`neuprim.core.render.render_slabs`. A slab without primitives
    has opacity 0.
    """
    means = lowered.geometry.means
    request = RasterRequest.of(lowered, camera, settings, RenderStats("cpu", len(means)))
    frame = _prepare_frame(request, camera.viewmat, rasterizer_tensors(lowered), (slabs.numpy(), count))
    shape, saved = (count * camera.height, camera.width), SavedForBackward.allocate(0)
    T, z, last = np.empty(shape, np.float32), np.empty(shape, np.float32), np.empty(shape, np.int32)
    image = TileImage(np.empty((*shape, 0), np.float32), T, z, last, np.zeros(0, np.float32), True)
    tiles, threads = count * frame.tiles, settings.threads
    chunk = max(frame.chunk, tiles // (_UNITS_PER_THREAD * resolve_threads(threads)))
    parallel_for(
        composite_tiles, tiles, chunk, threads, frame.arrays, np.zeros((len(means), 0), np.float32), image,
        saved.live, saved.first_lane, None, EDGE_TYPES[request.edge],
    )  # fmt: skip
    alpha = 1 - torch.from_numpy(T)
    images = alpha.to(means.dtype), mean_depth(torch.from_numpy(z), alpha).to(means.dtype)
    return images[0].unflatten(0, (count, -1)), images[1].unflatten(0, (count, -1))
