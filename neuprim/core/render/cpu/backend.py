"""The numba backend as one differentiable operation: lowered tensors in, image out."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.operation import apply_autograd, needs_grad
from neuprim.core.compute.threads import parallel_for, resolve_threads
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.fields import Constant, Cosine, RayNet
from neuprim.core.model.primitives import Lowered
from neuprim.core.render.cpu import layout as L
from neuprim.core.render.cpu.backward import backward_tiles, sum_rows
from neuprim.core.render.cpu.binning import TileLists, bin_primitives
from neuprim.core.render.cpu.colour_net import Net, net_backward, net_rows
from neuprim.core.render.cpu.entry import backward_tiles_by_entry, composite_tiles_by_entry
from neuprim.core.render.cpu.forward import composite_tiles
from neuprim.core.render.cpu.kept import Kept
from neuprim.core.render.cpu.prepare import NON_FINITE, VISIBLE, prepare, prepare_backward, prepare_wide
from neuprim.core.render.cpu.profiles import EDGE_TYPES
from neuprim.core.render.cpu.seen import depth_that_counts
from neuprim.core.render.output import RenderOutput, RenderStats, mean_depth
from neuprim.core.settings import RenderSettings

__all__ = ["render", "render_parts"]

_PRIMITIVES_PER_CHUNK = 512
_UNITS_PER_THREAD = 8  # units of work among which threads share a frame
_TILES_ALONE = 64  # tiles that a thread which shares with no other does at once, at least
_TURN = 2.0 * np.pi
_NAMES = ("means", "log_scales", "quats", "W1", "b1", "w2", "b2")
_NET = ("Wx", "bias", "Wout", "base")
Array = np.ndarray[Any, Any]


@dataclass
class _Prepared:
    """Everything the backward pass shares with the forward pass of one view."""

    camera: Camera
    settings: RenderSettings
    omega0: float
    edge: int
    background: Array
    stats: RenderStats
    R: Array
    t: Array
    neurons: int
    rows: Array
    spans: Array
    wide: Array
    slots: Array
    kinds: Array
    order: Array
    boxes: Array
    norms: Array
    limits: Array
    lists: TileLists
    net: Net | None
    chunk: int = field(init=False)

    def __post_init__(self) -> None:
        """Fixes the unit of work for both passes: half a row of tiles, or more where threads are few, as every unit
        costs a call."""
        threads = resolve_threads(self.settings.threads)
        least = 2 if threads > 1 else _TILES_ALONE
        self.chunk = max(least, -(-self.camera.width // L.TILE) // 2, self.tiles // (_UNITS_PER_THREAD * threads))

    @property
    def intrinsics(self) -> Array:
        c = self.camera
        return np.array([c.fx, c.fy, c.cx, c.cy], np.float64)

    @property
    def tiles(self) -> int:
        return -(-self.camera.width // L.TILE) * -(-self.camera.height // L.TILE)


def _array(tensor: Tensor) -> Array:
    return np.ascontiguousarray(tensor.detach().resolve_neg().numpy())


def _alike(tensors: dict[str, Array]) -> dict[str, Array]:
    """One dtype, the widest, so that a mix does not compile kernels of its own; they compute in float64 in any case."""
    if len({v.dtype for v in tensors.values()}) == 1:
        return tensors
    return {name: v.astype(np.float64, copy=False) for name, v in tensors.items()}


@lru_cache(maxsize=4)
def _norms(width: int, height: int, fx: float, fy: float, cx: float, cy: float) -> Array:
    """(H, W) length of each pixel's ray direction whose camera-z is 1."""
    x = (np.arange(width) + 0.5 - cx) / fx
    y = (np.arange(height) + 0.5 - cy) / fy
    result: Array = np.sqrt(1 + x[None, :] ** 2 + y[:, None] ** 2).astype(np.float32)
    return result


def _prepare(
    tensors: dict[str, Array],
    camera: Camera,
    view: Array,
    omega0: float,
    edge: int,
    background: Array,
    settings: RenderSettings,
    stats: RenderStats,
    images: tuple[Array, int] | None = None,
) -> _Prepared:
    """``images``: as of :func:`~neuprim.core.render.cpu.binning.bin_primitives`."""
    count, K = tensors["W1"].shape[:2]
    neurons = K + K % 2  # the backward kernel takes neurons in pairs; a padded one has amplitude 0
    rows = np.empty((count, L.row_width(neurons)), np.float32)
    spans = np.zeros((count, L.SPAN_WIDTH), np.float32)
    kinds, order = np.empty((count, neurons // 2), np.uint8), np.empty((count, K), np.uint8)
    boxes, depth, status = np.empty((count, 4), np.int32), np.empty(count, np.float64), np.empty(count, np.uint8)
    in_float64 = np.empty(count, np.bool_)
    R, t = np.ascontiguousarray(view[:3, :3]), np.ascontiguousarray(view[:3, 3])
    cam = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)
    size = np.array([camera.width, camera.height], np.int64)
    parallel_for(
        prepare, count, _PRIMITIVES_PER_CHUNK, settings.threads, *(tensors[n] for n in _NAMES),
        R, t, cam, size, settings.near_plane, omega0 / _TURN, edge, depth_that_counts(settings.alpha_min), rows, spans, kinds, order, boxes, depth, status, in_float64,
    )  # fmt: skip
    if bool((status == NON_FINITE).any()):
        raise _non_finite(tensors, int(np.flatnonzero(status == NON_FINITE)[0]))
    net_narrow = None
    if "Wx" in tensors:
        net_narrow, fast = net_rows(np.arange(count), tensors, False, settings.threads)
        in_float64 |= fast
    slots, which = np.full(count, -1, np.int32), np.flatnonzero(in_float64 & (status == VISIBLE))
    slots[which] = np.arange(len(which), dtype=np.int32)
    wide = np.empty((len(which), rows.shape[1]))
    parallel_for(
        prepare_wide, len(which), _PRIMITIVES_PER_CHUNK, settings.threads, which, *(tensors[n] for n in _NAMES),
        R, t, cam, settings.near_plane, omega0 / _TURN, order, wide,
    )  # fmt: skip
    net = None
    if net_narrow is not None:
        hidden = tensors["Wx"].shape[1]
        net = Net(net_narrow, net_rows(which, tensors, True, settings.threads)[0], hidden + hidden % 2)
    stats.extra["float64"] = len(which)
    lists = bin_primitives(rows, spans, boxes, depth, status, camera.width, camera.height, settings.threads, images)
    stats.pairs = lists.pairs
    limits = np.array(
        [settings.alpha_min, settings.alpha_max, settings.transmittance_min, settings.depth_floor], np.float32
    )
    return _Prepared(
        camera,
        settings,
        omega0,
        edge,
        background,
        stats,
        R,
        t,
        neurons,
        rows,
        spans,
        wide,
        slots,
        kinds,
        order,
        boxes,
        _norms(camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy),
        limits,
        lists,
        net,
    )


def _check_colours(tensors: dict[str, Array], names: tuple[str, ...]) -> None:
    for name in names:
        if not np.isfinite(tensors[name].sum(dtype=np.float64)):
            bad = np.flatnonzero(~np.isfinite(tensors[name]).reshape(len(tensors[name]), -1).all(axis=1))
            if bad.size:
                raise _non_finite(tensors, int(bad[0]))


def _non_finite(tensors: dict[str, Array], row: int) -> NonFiniteError:
    for name, value in tensors.items():
        if not np.isfinite(value[row]).all():
            return NonFiniteError(f"{name} of primitive {row} is not finite: {value[row].ravel()[:8].tolist()}")
    if not tensors["quats"][row].any():
        return NonFiniteError(f"quats of primitive {row} is zero; expected a non-zero quaternion")
    scale = tensors["log_scales"][row].tolist()
    return NonFiniteError(
        f"log_scales of primitive {row} is {scale}: the semi-axes or weights leave the range of float32"
    )


class _Rasterize(torch.autograd.Function):
    @staticmethod
    def forward(  # type: ignore[override]
        ctx: Any, means: Tensor, log_scales: Tensor, quats: Tensor, W1: Tensor, b1: Tensor, w2: Tensor, b2: Tensor,
        colors: Tensor, viewmat: Tensor, background: Tensor, camera: Camera, omega0: float, edge: int, settings: RenderSettings, stats: RenderStats,
        differentiable: bool, *net: Tensor,
    ) -> tuple[Tensor, Tensor, Tensor]:  # fmt: skip
        painted = _NET if net else ("colors",)
        kernels = zip((*_NAMES, *painted[:-1]), (means, log_scales, quats, W1, b1, w2, b2, *net), strict=True)
        tensors = _alike({n: _array(v) for n, v in kernels}) | {painted[-1]: _array(colors)}
        _check_colours(tensors, painted)
        frame = _prepare(
            tensors,
            camera,
            viewmat.detach().double().numpy(),
            omega0,
            edge,
            _array(background.float()),
            settings,
            stats,
        )
        h, w, C = camera.height, camera.width, colors.shape[1]
        rgb, T = np.empty((h, w, C), np.float32), np.empty((h, w), np.float32)
        z, last = np.zeros((h, w) if settings.depth else (1, 1), np.float32), np.empty((h, w), np.int32)
        palette = np.ascontiguousarray(tensors[painted[-1]], np.float32)
        pixels = (
            frame.rows, frame.wide, frame.slots, frame.spans, frame.kinds, frame.boxes,
            frame.lists.starts, frame.lists.ids, palette, frame.norms, frame.background, frame.limits, settings.depth, frame.neurons,
            rgb, T, z, last,
        )  # fmt: skip
        form, kept = (frame.net, EDGE_TYPES[frame.edge]), None
        if settings.sort == "entry":
            lanes = parallel_for(composite_tiles_by_entry, frame.tiles, frame.chunk, settings.threads, *pixels, *form)
        else:
            kept = Kept.of(frame.lists.pairs if differentiable else 0)
            drawn = parallel_for(
                composite_tiles, frame.tiles, frame.chunk, settings.threads, *pixels, kept.live, kept.found, *form
            )
            lanes, kept.depths = [n for n, _ in drawn], [depths for _, depths in drawn]
        stats.extra["forward_lanes"] = sum(lanes)
        ctx.frame, ctx.tensors, ctx.palette, ctx.last, ctx.T, ctx.kept = frame, tensors, palette, last, T, kept
        ctx.dtypes = [x.dtype for x in (means, log_scales, quats, W1, b1, w2, b2, colors)]
        ctx.net_dtypes = [x.dtype for x in net]
        ctx.view_dtype, ctx.background_dtype = viewmat.dtype, background.dtype
        ctx.set_materialize_grads(False)  # a depth image that nothing is asked of costs the backward pass nothing
        return torch.from_numpy(rgb), torch.from_numpy(T), torch.from_numpy(z)

    @staticmethod
    def backward(ctx: Any, g_rgb: Tensor | None, g_T: Tensor | None, g_z: Tensor | None) -> tuple[Any, ...]:  # type: ignore[override]
        frame: _Prepared = ctx.frame
        s, t = frame.settings, ctx.tensors
        count = t["W1"].shape[0]
        (h, w), C = ctx.T.shape, ctx.palette.shape[1]
        with_depth = s.depth and g_z is not None
        g_rgb = torch.zeros(h, w, C) if g_rgb is None else g_rgb
        g_T = torch.zeros(h, w) if g_T is None else g_T
        g_z = g_z if with_depth and g_z is not None else torch.zeros(1, 1)
        grad_rgb = np.ascontiguousarray(g_rgb.numpy(), np.float32)
        gT = np.ascontiguousarray((g_T + g_rgb @ torch.from_numpy(frame.background)).numpy(), np.float32)
        gz = np.ascontiguousarray(g_z.numpy(), np.float32)
        watched = frame.stats.watched
        error = (
            np.zeros((h, w), np.float32) if watched is None else np.ascontiguousarray(_array(watched.error), np.float32)
        )
        width = L.gradient_width(frame.neurons, C, frame.net.hidden if frame.net else 0)
        pair_rows = np.empty((frame.lists.pairs, width), np.float32)
        pixels = (
            frame.rows, frame.wide, frame.slots, frame.spans, frame.kinds, frame.boxes,
            frame.lists.starts, frame.lists.ids, ctx.palette, frame.norms, frame.limits, with_depth, frame.neurons,
            ctx.T, ctx.last, grad_rgb, gT, gz, error, pair_rows,
        )  # fmt: skip
        form, kept = (frame.net, EDGE_TYPES[frame.edge]), ctx.kept
        if kept is None:
            lanes = parallel_for(backward_tiles_by_entry, frame.tiles, frame.chunk, s.threads, *pixels, *form)
        else:

            def tiles(start: int, stop: int, *arguments: Any) -> Any:
                return backward_tiles(start, stop, kept.depths[start // frame.chunk], *arguments)

            lanes = parallel_for(tiles, frame.tiles, frame.chunk, s.threads, *pixels, kept.live, kept.found, *form)
        frame.stats.extra["backward_lanes"] = sum(lanes)
        grads, touched = np.empty((count, width), np.float32), np.empty(count, np.bool_)
        parallel_for(
            sum_rows,
            count,
            _PRIMITIVES_PER_CHUNK,
            s.threads,
            frame.lists.first,
            frame.lists.slots,
            pair_rows,
            grads,
            touched,
        )
        out = [np.zeros(t[n].shape, np.float32) for n in ("means", "log_scales", "quats", "W1", "b1", "w2")]
        g_b2 = np.zeros(count, np.float32)
        want_view = bool(ctx.needs_input_grad[8])
        g_view = np.zeros((count if want_view else 1, 3, 4), np.float64)
        parallel_for(
            prepare_backward, count, _PRIMITIVES_PER_CHUNK, s.threads, t["means"], t["log_scales"], t["quats"], t["W1"],
            frame.R, frame.t, frame.intrinsics, s.near_plane, frame.omega0 / _TURN, frame.rows, frame.order, grads, touched,
            *out, g_b2, g_view, want_view,
        )  # fmt: skip
        base = L.G_NEURONS + L.PER_NEURON * frame.neurons
        g_net = [np.zeros(t[n].shape, np.float32) for n in ("Wx", "bias", "Wout")] if frame.net else []
        if frame.net:
            parallel_for(
                net_backward, count, _PRIMITIVES_PER_CHUNK, s.threads, t["log_scales"], t["quats"], t["Wx"], frame.net.rows,
                grads, base + C, touched, out[1], out[2], *g_net,
            )  # fmt: skip
        if watched is not None:
            watched.fill(torch.from_numpy(grads[:, L.G_WEIGHT].copy()), torch.from_numpy(grads[:, L.G_ERROR].copy()))
        results = [*out, g_b2, np.ascontiguousarray(grads[:, base : base + C])]
        tensors = [torch.from_numpy(r).to(d) for r, d in zip(results, ctx.dtypes, strict=True)]
        view = None
        if want_view:
            full = torch.zeros(4, 4, dtype=torch.float64)
            full[:3] = torch.from_numpy(g_view.sum(0))
            view = full.to(ctx.view_dtype)
        g_background = None
        if ctx.needs_input_grad[9]:
            g_background = (g_rgb * torch.from_numpy(ctx.T)[..., None]).sum((0, 1)).to(ctx.background_dtype)
        nets = (torch.from_numpy(r).to(d) for r, d in zip(g_net, ctx.net_dtypes, strict=True))
        return (*tensors, view, g_background, None, None, None, None, None, None, *nets)


def render(lowered: Lowered, camera: Camera, background: Tensor | None, settings: RenderSettings) -> RenderOutput:
    """Render a :class:`Cosine` density with :class:`Constant` or :class:`RayNet` colours; see
    ``neuprim.core.render.render``."""
    density, colour = lowered.density, lowered.colour
    assert isinstance(density, Cosine) and isinstance(colour, Constant | RayNet), (
        "the caller chooses a backend that knows the forms"
    )
    g = lowered.geometry
    stats = RenderStats("cpu", g.count)
    palette, net = (
        (colour.base, (colour.Wx, colour.bias, colour.Wout)) if isinstance(colour, RayNet) else (colour.rgb, ())
    )
    if background is None:
        background = torch.zeros(palette.shape[1])
    tensors = (
        g.means, g.log_scales, g.quats, density.W1, density.b1, density.w2, density.b2.reshape(-1), palette, camera.viewmat, background,
    )  # fmt: skip
    rgb, T, zsum = apply_autograd(
        _Rasterize, *tensors, camera, density.omega0, density.edge, settings, stats, needs_grad(*tensors, *net), *net
    )
    dtype = g.means.dtype
    alpha = 1 - T
    depth = mean_depth(zsum, alpha).to(dtype) if settings.depth else None
    return RenderOutput(rgb.to(dtype), alpha.to(dtype), depth, stats)


def render_parts(
    lowered: Lowered, parts: Tensor, count: int, camera: Camera, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Opacity and depth of parts of the primitives, each as if it were alone, prepared as one frame; see
    :func:`neuprim.core.render.parts.render_parts`."""
    g, density = lowered.geometry, lowered.density
    assert isinstance(density, Cosine), "the caller chooses a backend that knows the forms"
    values = (g.means, g.log_scales, g.quats, density.W1, density.b1, density.w2, density.b2.reshape(-1))
    tensors = _alike({name: _array(value) for name, value in zip(_NAMES, values, strict=True)})
    nothing, view = np.zeros(1, np.float32), camera.viewmat.detach().double().numpy()
    stats, images = RenderStats("cpu", g.count), (parts.numpy(), count)
    frame = _prepare(tensors, camera, view, density.omega0, density.edge, nothing, settings, stats, images)
    shape, palette, kept = (count, camera.height, camera.width), np.zeros((g.count, 1), np.float32), Kept.of(0)
    T, z = np.empty(shape, np.float32), np.empty(shape, np.float32)
    rgb, last = np.empty((*shape[1:], 1), np.float32), np.empty(shape[1:], np.int32)  # of no interest
    for part in range(count):
        starts = frame.lists.starts[part * frame.tiles : (part + 1) * frame.tiles + 1]
        parallel_for(
            composite_tiles, frame.tiles, frame.chunk, settings.threads,
            frame.rows, frame.wide, frame.slots, frame.spans, frame.kinds, frame.boxes,
            starts, frame.lists.ids, palette, frame.norms, nothing, frame.limits, True, frame.neurons,
            rgb, T[part], z[part], last, kept.live, kept.found, None, EDGE_TYPES[frame.edge],
        )  # fmt: skip
    alpha = 1 - torch.from_numpy(T)
    return alpha.to(g.means.dtype), mean_depth(torch.from_numpy(z), alpha).to(g.means.dtype)
