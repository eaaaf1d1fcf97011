# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Arrays of a frame on the device, and the kernel that projects primitives: one thread per primitive, in float64.

This is the CUDA version of :mod:`neuprim.core.render.cpu.prepare`. Unlike there, rows consist of float4 columns and
include colours, and neurons stay in the order of the model. The kernel also counts the tiles that each primitive
reaches.
"""

import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.warp import (
    Bools,
    Bytes,
    Doubles,
    Doubles2d,
    Floats2d,
    Ints,
    Ints2d,
    Vec4is,
    Vec4s2d,
    array,
    launch_kernel,
    wp,
)
from neuprim.core.render import layout as W
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.binning import (
    SilhouetteSpans,
    TileLists,
    bin_primitives,
    count_tiles,
    is_too_faint_to_draw,
    longest_half_chord,
    projected_covariance,
    silhouette_ellipse,
    silhouette_screen_extent,
    silhouette_spans,
    tile_range,
    visible_square,
)
from neuprim.core.render.cuda.projection import (
    EXACT,
    PER_BLOCK,
    ProjectedPrimitive,
    load_projection_view,
    project_primitive,
    whiten_rays,
)
from neuprim.core.render.layout import SPAN_WIDTH, min_visible_depth
from neuprim.core.render.rasterize import RasterRequest

d, f = wp.float64, wp.float32
_VISIBLE = wp.constant(wp.uint8(W.VISIBLE))
_CULLED = wp.constant(wp.uint8(W.CULLED))
_NON_FINITE = wp.constant(wp.uint8(W.NON_FINITE))
_FLOAT32_MAX, _CUT = wp.constant(d(W.FLOAT32_MAX)), wp.constant(d(W.CUT))
_TURNS = wp.constant(d(W.FLOAT64_TURNS))
_ANCHOR, _PIXELS = wp.constant(d(W.FLOAT64_ANCHOR**2)), wp.constant(d(W.FLOAT64_PIXELS))
_RATIO, _RATIO_NEAR = wp.constant(d(W.FLOAT64_RATIO)), wp.constant(d(W.FLOAT64_RATIO_NEAR))
_UNBOUNDED = wp.constant(d(W.UNBOUNDED))
_E0, _EX, _EY, _XA, _XU, _XV, _REST, _NEURONS = L.E0, L.EX, L.EY, L.XA, L.XU, L.XV, L.REST, L.NEURONS
_TILE = L.TILE

_STORE = """
#if defined(__CUDA_ARCH__)
    *reinterpret_cast<float4*>(wp::address(rows, i, j)) = make_float4(x, y, z, w);
#else
    *wp::address(rows, i, j) = wp::vec_t<4, float>(x, y, z, w);
#endif
"""


@wp.func_native(_STORE)
def store_float4(rows: Vec4s2d, i: int, j: int, x: float, y: float, z: float, w: float): ...


@wp.func
def _store_vector(rows: Vec4s2d, i: int, j: int, v: wp.vec3d, scalar: wp.float64):
    """Store a vector and a scalar as one float4, in one instruction; a store of a Warp vector takes four."""
    store_float4(rows, i, j, f(v[0]), f(v[1]), f(v[2]), f(scalar))


@wp.func
def _largest_ray_component(v: wp.vec3d):
    return wp.max(wp.max(wp.abs(v[0]), wp.abs(v[1])), wp.abs(v[2]))


@wp.func
def _projected_frequency(w: wp.vec3d, p: ProjectedPrimitive, turns: wp.float64):
    """Return a neuron's frequencies ``w`` converted to the ellipsoid's axes, in turns per semi-axis.

    ``turns`` is omega0 / 2 pi.
    """
    t = wp.transpose(p.local) * w
    return wp.vec3d(turns * p.axes[0] * t[0], turns * p.axes[1] * t[1], turns * p.axes[2] * t[2])


@functools.cache
def project_primitives_kernel(double: bool) -> Any:
    """Return a kernel that fills rows, spans, boxes, depth, status and counts of every primitive; launch size (N,).

    The arrays are those of :class:`Frame`. Row 0 of ``counts`` (2, N) is the number of tiles that each primitive
    reaches; row 1 is 1 for visible primitives that need float64. ``bad`` (1,) is the first primitive that has
    parameters or colours that are not finite. A primitive is not drawn where its optical depth cannot reach ``least``.
    Primitives marked in ``forced`` always need float64.
    """
    real, vec3, vec4 = (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def prepare(
        means: wp.array(dtype=vec3), log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4),
        W1: wp.array2d(dtype=vec3), b1: wp.array2d(dtype=real), w2: wp.array2d(dtype=real), b2: wp.array(dtype=real),
        palette: Floats2d, forced: Bools, matrix: Doubles, intrinsics: wp.vec4d, width: int, height: int,
        near: wp.float64, turns: wp.float64, edge: int, least: wp.float64, neurons: int, channels: int,
        rows: Vec4s2d, spans: Vec4s2d, boxes: Vec4is, depth: Doubles, status: Bytes, counts: Ints2d, bad: Ints,
    ):  # fmt: skip
        i = wp.tid()
        most = d(b2[i])
        for k in range(neurons):
            most += d(wp.abs(w2[i, k]))
        if is_too_faint_to_draw(most, edge, least):  # wherever it is
            state = int(_CULLED)
            given, turn = wp.vec3d(means[i]) + wp.vec3d(log_scales[i]), wp.vec4d(quats[i])
            given_sum = most + given[0] + given[1] + given[2] + d(1.0) / wp.dot(turn, turn)
            for k in range(neurons):
                given_sum += d(W1[i, k][0]) + d(W1[i, k][1]) + d(W1[i, k][2]) + d(b1[i, k])
            for c in range(channels):
                given_sum += d(palette[i, c])
            if not wp.isfinite(given_sum):
                state = int(_NON_FINITE)
                wp.atomic_min(bad, 0, i)
            boxes[i] = wp.vec4i()
            depth[i] = d(0.0)
            status[i] = wp.uint8(state)
            counts[0, i] = 0
            counts[1, i] = 0
            return
        v = load_projection_view(matrix, intrinsics, near)
        p = project_primitive(wp.vec3d(means[i]), wp.vec3d(log_scales[i]), wp.vec4d(quats[i]), v)
        r = whiten_rays(p, v)
        m, z, ux, uy = p.m, p.centre[2], p.anchor[1], p.anchor[2]
        offset = d(b2[i])
        biggest = wp.max(
            wp.max(_largest_ray_component(r.xa), _largest_ray_component(r.e0)),
            wp.max(wp.max(r.tc, wp.abs(r.near)), wp.max(m, wp.abs(offset))),
        )
        total = r.tc + r.near + m + offset
        for a in range(3):
            total += r.e0[a] + r.ex[a] + r.ey[a] + r.xa[a]
        fastest = d(0.0)
        for k in range(neurons):
            wave = _projected_frequency(wp.vec3d(W1[i, k]), p, turns)
            phase, amplitude = turns * d(b1[i, k]), d(w2[i, k])
            speed = wp.sqrt(wp.dot(wave, wave))
            fastest = wp.max(fastest, speed)
            biggest = wp.max(biggest, wp.max(speed, wp.abs(amplitude)))
            total += speed + phase + amplitude
            _store_vector(rows, i, _NEURONS + k, wave, phase - wp.rint(phase))
        column = _NEURONS + neurons
        for q in range((neurons + 3) // 4):
            four = wp.vec4()
            for j in range(4):
                if 4 * q + j < neurons:
                    four[j] = f(w2[i, 4 * q + j])
            store_float4(rows, i, column + q, four[0], four[1], four[2], four[3])
        column += (neurons + 3) // 4
        for q in range((channels + 3) // 4):
            four = wp.vec4()
            for j in range(4):
                if 4 * q + j < channels:
                    four[j] = palette[i, 4 * q + j]
                    total += d(four[j])
            store_float4(rows, i, column + q, four[0], four[1], four[2], four[3])

        in_float64 = wp.int32(0)
        thinnest, ratio = wp.min(wp.min(p.axes[0], p.axes[1]), p.axes[2]), _RATIO
        if r.tc == d(0.0):
            ratio = _RATIO_NEAR
        # the third: the centre is far from the anchor, in the thinnest axis
        if (
            fastest > _TURNS
            or wp.max(wp.abs(ux), wp.abs(uy)) > _PIXELS
            or wp.dot(r.xa, r.xa) > _ANCHOR
            or thinnest * ratio < d(1.0)
        ):
            in_float64 = 1
        if forced:
            if forced[i]:
                in_float64 = 1
        s22 = projected_covariance(p, 2, 2)
        reach = wp.sqrt(m * m * s22)
        if edge > 0 and z - reach < near + _CUT * reach:  # only float64 integrates cut chords with a soft edge
            in_float64 = 1

        state, box, tiles = int(_CULLED), wp.vec4i(), wp.int32(0)
        o = SilhouetteSpans()
        if not wp.isfinite(total):
            state = int(_NON_FINITE)
        elif z + reach > near:
            if biggest > _FLOAT32_MAX:
                # too small for its distance to hit a pixel centre, or, if m > 1, a scale or weight beyond float32
                if m > d(1.0):
                    state = int(_NON_FINITE)
            else:
                x0, x1, y0, y1 = d(0.0), d(width), d(0.0), d(height)
                o.hx = _UNBOUNDED
                o.hy = _UNBOUNDED
                if z - reach > d(1e-3) * reach:  # wholly in front of the camera plane: the silhouette is an ellipse
                    half = d(0.5)
                    one = d(1.0)
                    square = visible_square(most, longest_half_chord(p, r, v, reach), edge, least)
                    if square == d(0.0):
                        x1 = x0  # invisible
                    else:
                        across = silhouette_screen_extent(p, v, 0, s22, square)
                        down = silhouette_screen_extent(p, v, 1, s22, square)
                        x0, x1 = wp.max(x0, wp.ceil(across[0] - half)), wp.min(x1, wp.floor(across[1] - half) + one)
                        y0, y1 = wp.max(y0, wp.ceil(down[0] - half)), wp.min(y1, wp.floor(down[1] - half) + one)
                        o = silhouette_spans(p, r, width, height, square)
                        if o.in_float64 > 0:
                            in_float64 = 1
                if x1 > x0 and y1 > y0:
                    box = wp.vec4i(int(x0), int(y0), int(x1), int(y1))
                    state = int(_VISIBLE)

        xu, xv, tu, tv = r.tc * r.ex, r.tc * r.ey, d(0.0), d(0.0)
        if in_float64 == 0:  # float64 does not slide
            xu, xv, tu, tv = xu + r.tu * r.e0, xv + r.tv * r.e0, d(r.tu), d(r.tv)
        if state != int(_VISIBLE):
            in_float64 = 0
        _store_vector(rows, i, _E0, r.e0, ux)
        _store_vector(rows, i, _EX, r.ex, uy)
        _store_vector(rows, i, _EY, r.ey, r.near)
        _store_vector(rows, i, _XA, r.xa, offset)
        _store_vector(rows, i, _XU, xu, tu)
        _store_vector(rows, i, _XV, xv, tv)
        store_float4(rows, i, _REST, f(r.tc), f(m), f(p.anchor[0]), f(in_float64))
        store_float4(spans, i, 0, f(o.skew), f(o.xc), f(o.yc), f(o.hx))
        store_float4(spans, i, 1, f(o.hy), f(0.0), f(0.0), f(0.0))
        boxes[i] = box
        depth[i] = z
        status[i] = wp.uint8(state)
        if state == int(_VISIBLE):
            e = silhouette_ellipse(spans[i, 0], spans[i, 1][0], f(ux), f(uy), box)
            for ty in range(box[1] // _TILE, (box[3] - 1) // _TILE + 1):
                lo_hi = tile_range(e, ty)
                tiles += wp.max(lo_hi[1] - lo_hi[0], 0)
        if state == int(_NON_FINITE):
            wp.atomic_min(bad, 0, i)
        counts[0, i] = tiles
        counts[1, i] = in_float64

    return prepare


@wp.func
def _store_wide_vector(wide: Doubles2d, n: int, column: int, v: wp.vec3d):
    for a in range(3):
        wide[n, column + a] = v[a]


@functools.cache
def wide_kernel(double: bool) -> Any:
    """Return a kernel that fills ``wide``, the float64 rows of primitives ``which`` (M,); launch size (M,)."""
    real, vec3, vec4 = (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT, grid_stride=False)
    def prepare_wide(
        which: Ints, means: wp.array(dtype=vec3), log_scales: wp.array(dtype=vec3), quats: wp.array(dtype=vec4),
        W1: wp.array2d(dtype=vec3), b1: wp.array2d(dtype=real), w2: wp.array2d(dtype=real), b2: wp.array(dtype=real),
        matrix: Doubles, intrinsics: wp.vec4d, near: wp.float64, turns: wp.float64, neurons: int, wide: Doubles2d,
    ):  # fmt: skip
        n = wp.tid()
        i = which[n]
        v = load_projection_view(matrix, intrinsics, near)
        p = project_primitive(wp.vec3d(means[i]), wp.vec3d(log_scales[i]), wp.vec4d(quats[i]), v)
        r = whiten_rays(p, v)
        _store_wide_vector(wide, n, W.E0, r.e0)
        _store_wide_vector(wide, n, W.EX, r.ex)
        _store_wide_vector(wide, n, W.EY, r.ey)
        _store_wide_vector(wide, n, W.XA, r.xa)
        _store_wide_vector(wide, n, W.XU, r.tc * r.ex + r.tu * r.e0)
        _store_wide_vector(wide, n, W.XV, r.tc * r.ey + r.tv * r.e0)
        wide[n, W.TC] = r.tc
        wide[n, W.TU] = r.tu
        wide[n, W.TV] = r.tv
        wide[n, W.UX] = p.anchor[1]
        wide[n, W.UY] = p.anchor[2]
        wide[n, W.NEAR] = r.near
        wide[n, W.OFFSET] = d(b2[i])
        wide[n, W.UNIT] = p.m
        wide[n, W.ANCHOR_Z] = p.anchor[0]
        for k in range(neurons):
            column, phase = W.NEURONS + W.PER_NEURON * k, turns * d(b1[i, k])
            _store_wide_vector(wide, n, column, _projected_frequency(wp.vec3d(W1[i, k]), p, turns))
            wide[n, column + W.PHASE] = phase - wp.rint(phase)
            wide[n, column + W.AMPLITUDE] = d(w2[i, k])

    return prepare_wide


class NotFinitePrimitive(ValueError):
    """Error: primitive ``row`` has values that are NaN, infinite or outside the range of float32.

    The caller finds and reports these values.
    """

    def __init__(self, row: int) -> None:
        super().__init__(f"primitive {row} is not finite")
        self.row = row


@dataclass(frozen=True)
class Projection:
    """A camera view, in the form that the kernels take as arguments."""

    matrix: Tensor  # (16,) float64 on the device, world to camera
    camera: Camera  # focal lengths and centre in pixels, size
    near: float  # depth of the near plane, in scene units
    turns: float  # omega0 / 2 pi

    @property
    def intrinsics(self) -> Any:
        return wp.vec4d(self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy)


@dataclass(frozen=True)
class Frame:
    """Arrays of one view on the device; :mod:`neuprim.core.render.cuda.layout` names their columns."""

    projection: Projection  # the view
    parameters: tuple[Tensor, ...]  # tensors of PARAMETERS, contiguous, all float32 or all float64
    rows: Tensor  # (N, rasterizer_row_columns(K, C), 4) float32
    # (M, wide_width(K)) float64, rows of the primitives that are drawn in float64; columns as in
    # neuprim.core.render.layout
    wide: Tensor
    slots: Tensor  # (N,) int32, each primitive's row in wide, or -1
    which: Tensor  # (M,) int32, primitive of each row of wide, in order
    spans: Tensor  # (N, 8) float32, silhouettes
    boxes: Tensor  # (N, 4) int32, pixel boxes x0, y0, x1, y1
    depth: Tensor  # (N,) float64, camera z of the centres
    status: Tensor  # (N,) uint8, VISIBLE or CULLED
    lists: TileLists  # which primitives reach which tile
    ends: Tensor  # (2, N) int64, running sums of the tiles reached and of the primitives in float64
    bad: Tensor  # (1,) int32, the first primitive that is not finite, or N

    @property
    def device(self) -> torch.device:
        return self.rows.device

    @property
    def neurons(self) -> int:
        return int(self.parameters[3].shape[1])

    @property
    def double(self) -> bool:
        return self.parameters[0].dtype == torch.float64

    @property
    def inputs(self) -> tuple[Any, ...]:
        """The parameters of the frame's primitives as Warp arrays."""
        return rasterizer_parameter_arrays(self.parameters)


def rasterizer_parameter_arrays(parameters: Sequence[Tensor]) -> tuple[Any, ...]:
    """Return the primitives' parameters, or their gradients, as Warp arrays of numbers, 3-vectors and 4-vectors."""
    double = parameters[0].dtype == torch.float64
    real, vec3, vec4 = (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)
    return tuple(array(x, kind) for x, kind in zip(parameters, (vec3, vec3, vec4, vec3, real, real, real), strict=True))


def prepare_frame(
    request: RasterRequest,
    viewmat: Tensor,
    palette: Tensor,
    tensors: Sequence[Tensor],
    forced: Tensor | None = None,
    images: tuple[Tensor, int] | None = None,
) -> Frame:
    """Return the data of one view that the pixel kernels read.

    If ``request`` has no capacity, the function waits for the device once, to read the sizes of the arrays.

    Args:
        palette: (N, C) colours.
        tensors: the tensors that :data:`~neuprim.core.render.rasterize.PARAMETERS` names, all on one device.
        forced: (N,) bool, True for primitives that are always rendered in float64.
        images: (N,) int32 index of the image of each primitive, and the number of images; None for one image.

    Raises NotFinitePrimitive for values that are not finite, and BackendUnavailable if there are 2^31 or more (tile,
    primitive) pairs.
    """
    # float64 if any tensor is, else float32; the kernels compute in float64 in any case
    dtype = torch.float64 if any(x.dtype == torch.float64 for x in tensors) else torch.float32
    parameters = tuple(x.detach().to(dtype).contiguous() for x in tensors)
    device, (N, K, _), C = parameters[0].device, parameters[3].shape, palette.shape[1]
    double, camera, settings = dtype == torch.float64, request.camera, request.settings
    # a blocking copy would synchronise
    matrix = viewmat.detach().to(device, torch.float64, non_blocking=device.type == "cuda").reshape(16).contiguous()
    projection = Projection(matrix, camera, settings.near_plane, request.turns)

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=device)

    rows, spans = empty(N, L.rasterizer_row_columns(K, C), 4), empty(N, SPAN_WIDTH)
    boxes = empty(N, 4, dtype=torch.int32)
    depth, status, counts = empty(N, dtype=torch.float64), empty(N, dtype=torch.uint8), empty(2, N, dtype=torch.int32)
    bad = torch.full((1,), N, dtype=torch.int32, device=device)
    inputs, colours = rasterizer_parameter_arrays(parameters), array(palette.detach().float().contiguous(), wp.float32)
    view = (array(matrix, wp.float64), projection.intrinsics)
    least = min_visible_depth(settings.alpha_min)
    size = (camera.width, camera.height, projection.near, projection.turns, request.edge, least, K, C)
    lists = (array(status, wp.uint8), array(counts, wp.int32), array(bad, wp.int32))
    silhouettes = (array(spans.view(N, 2, 4), wp.vec4), array(boxes, wp.vec4i))
    filled = (array(rows, wp.vec4), *silhouettes, array(depth, wp.float64), *lists)
    asked = None if forced is None else array(forced.contiguous(), wp.bool)
    arguments = (*inputs, colours, asked, *view, *size, *filled)
    launch_kernel(project_primitives_kernel(double), N, arguments, device, PER_BLOCK)
    counted = count_tiles(counts, bad, request.capacity)
    if counted.bad >= 0:
        raise NotFinitePrimitive(counted.bad)
    tile_lists, slots, which = bin_primitives(rows, spans, boxes, depth, counts, counted, camera, images)
    wide = empty(counted.in_float64, L.wide_width(K), dtype=torch.float64)
    wanted = (array(which, wp.int32), *inputs, *view, projection.near, projection.turns, K, array(wide, wp.float64))
    launch_kernel(wide_kernel(double), counted.in_float64, wanted, device, PER_BLOCK)
    made = (rows, wide, slots, which, spans, boxes, depth, status, tile_lists, counted.ends, bad)
    return Frame(projection, parameters, *made)
