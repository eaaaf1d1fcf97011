"""A frame on the device, ready for the pixel kernels: what forward and backward pass of one view share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.warp import array, launch_kernel, wp
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.binning import TileLists, bin_primitives, count_tiles
from neuprim.core.render.cuda.prepare import project_primitives_kernel, wide_kernel
from neuprim.core.render.cuda.projection import PER_BLOCK
from neuprim.core.render.layout import SPAN_WIDTH, min_visible_depth
from neuprim.core.render.rasterize import RasterRequest


class NotFinitePrimitive(ValueError):
    """Primitive ``row`` is not finite, or outside float32; the caller says which of its numbers."""

    def __init__(self, row: int) -> None:
        super().__init__(f"primitive {row} is not finite")
        self.row = row


@dataclass(frozen=True)
class Projection:
    """A view as the kernels take it."""

    matrix: Tensor  # (16,) float64 on the device, world to camera
    camera: Camera  # focal lengths and centre in pixels, size
    near: float  # of the near plane, in scene units
    turns: float  # omega0 / 2 pi

    @property
    def intrinsics(self) -> Any:
        return wp.vec4d(self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy)


@dataclass(frozen=True)
class Frame:
    """Device arrays of one view; :mod:`neuprim.core.render.cuda.layout` names the columns."""

    projection: Projection  # the view
    parameters: tuple[Tensor, ...]  # tensors of PARAMETERS, contiguous, all float32 or all float64
    rows: Tensor  # (N, columns(K, C), 4) float32
    wide: Tensor  # (M, wide_width(K)) float64, rows of the primitives in float64, columns of layout
    slots: Tensor  # (N,) int32, row in wide, or -1
    which: Tensor  # (M,) int32, primitive of each row of wide, rising
    spans: Tensor  # (N, 8) float32, silhouettes
    boxes: Tensor  # (N, 4) int32, pixel boxes x0, y0, x1, y1
    depth: Tensor  # (N,) float64, camera z of the centres
    status: Tensor  # (N,) uint8, VISIBLE or CULLED
    lists: TileLists  # which primitives reach which tile

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
        """The parameters as Warp arrays."""
        return rasterizer_parameter_arrays(self.parameters)


def rasterizer_parameter_arrays(parameters: Sequence[Tensor]) -> tuple[Any, ...]:
    """Return parameters, or their gradients, as Warp arrays of numbers and vectors."""
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
    """Return everything that the pixel kernels read of one view; the host waits for the device once.

    Args:
        palette: (N, C) colours.
        tensors: those of :data:`~neuprim.core.render.rasterize.PARAMETERS`, all on one device.
        forced: (N,) bool, primitives to draw in float64 whatever this stage finds.
        images: (N,) int32, the image of each primitive, and their number; None for one.

    Raises NotFinite, or BackendUnavailable where primitives reach 2^31 tiles or more.
    """
    # float64 where any is, else float32; the kernels compute in float64 in any case
    dtype = torch.float64 if any(x.dtype == torch.float64 for x in tensors) else torch.float32
    parameters = tuple(x.detach().to(dtype).contiguous() for x in tensors)
    device, (N, K, _), C = parameters[0].device, parameters[3].shape, palette.shape[1]
    double, camera, settings = dtype == torch.float64, request.camera, request.settings
    # a plain copy would wait
    matrix = viewmat.detach().to(device, torch.float64, non_blocking=device.type == "cuda").reshape(16).contiguous()
    projection = Projection(matrix, camera, settings.near_plane, request.turns)

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=device)

    rows, spans, boxes = (
        empty(N, L.rasterizer_row_columns(K, C), 4),
        empty(N, SPAN_WIDTH),
        empty(N, 4, dtype=torch.int32),
    )
    depth, status, counts = empty(N, dtype=torch.float64), empty(N, dtype=torch.uint8), empty(2, N, dtype=torch.int32)
    bad = torch.full((1,), N, dtype=torch.int32, device=device)
    inputs, colours = rasterizer_parameter_arrays(parameters), array(palette.detach().float().contiguous(), wp.float32)
    view = (array(matrix, wp.float64), projection.intrinsics)
    least = min_visible_depth(settings.alpha_min)
    size = (camera.width, camera.height, projection.near, projection.turns, request.edge, least, K, C)
    filled = (
        array(rows, wp.vec4),
        array(spans.view(N, 2, 4), wp.vec4),
        array(boxes, wp.vec4i),
        array(depth, wp.float64),
        array(status, wp.uint8),
        array(counts, wp.int32),
        array(bad, wp.int32),
    )
    asked = None if forced is None else array(forced.contiguous(), wp.bool)
    launch_kernel(
        project_primitives_kernel(double), N, (*inputs, colours, asked, *view, *size, *filled), device, PER_BLOCK
    )
    counted = count_tiles(counts, bad)
    if counted.bad >= 0:
        raise NotFinitePrimitive(counted.bad)
    lists, slots, which = bin_primitives(rows, spans, boxes, depth, counts, counted, camera, images)
    wide = empty(counted.in_float64, L.wide_width(K), dtype=torch.float64)
    wanted = (
        array(which, wp.int32),
        *inputs,
        *view,
        projection.near,
        projection.turns,
        K,
        array(wide, wp.float64),
    )
    launch_kernel(wide_kernel(double), counted.in_float64, wanted, device, PER_BLOCK)
    return Frame(projection, parameters, rows, wide, slots, which, spans, boxes, depth, status, lists)
