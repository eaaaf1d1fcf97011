"""A frame on the device, ready for the pixel kernels: what forward and backward pass of one view share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.warp import array, launch, wp
from neuprim.core.render.cpu.layout import SPAN_WIDTH
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.binning import TileLists, bin_primitives, count
from neuprim.core.render.cuda.placement import PER_BLOCK
from neuprim.core.render.cuda.prepare import prepare_kernel, wide_kernel

__all__ = ["NAMES", "Frame", "NotFinite", "Projection", "as_arrays", "prepared"]

NAMES = ("means", "log_scales", "quats", "W1", "b1", "w2", "b2")
"""Parameters of the per-primitive stage, in the order in which its kernels and :mod:`prepare_backward` take and return
them."""


class NotFinite(ValueError):
    """Primitive ``row`` is not finite, or outside float32; the caller says which of its numbers."""

    def __init__(self, row: int) -> None:
        super().__init__(f"primitive {row} is not finite")
        self.row = row


@dataclass(frozen=True)
class Projection:
    """A view as the kernels take it.

    Attributes:
        matrix: (16,) float64 on the device, world to camera.
        camera: focal lengths and centre in pixels, size.
        near: of the near plane, in scene units.
        turns: omega0 / 2 pi.
        edge: p of the density's soft edge.
    """

    matrix: Tensor
    camera: Camera
    near: float
    turns: float
    edge: int

    @property
    def intrinsics(self) -> Any:
        return wp.vec4d(self.camera.fx, self.camera.fy, self.camera.cx, self.camera.cy)


@dataclass(frozen=True)
class Frame:
    """Device arrays of one view; :mod:`neuprim.core.render.cuda.layout` names the columns.

    Attributes:
        projection: the view.
        parameters: tensors of :data:`NAMES`, contiguous, all float32 or all float64.
        neurons: K.
        channels: C of the palette.
        rows: (N, columns(K, C), 4) float32.
        wide: (M, wide_width(K)) float64, rows of the delicate primitives, columns of
        :mod:`neuprim.core.render.cpu.layout`. slots: (N,) int32, row in ``wide``, or -1.
        which: (M,) int32, primitive of each row of ``wide``, rising.
        spans: (N, 8) float32, silhouettes.
        boxes: (N, 4) int32, pixel boxes x0, y0, x1, y1.
        depth: (N,) float64, camera z of the centres.
        status: (N,) uint8, VISIBLE or CULLED.
        lists: which primitives reach which tile.
    """

    projection: Projection
    parameters: tuple[Tensor, ...]
    neurons: int
    channels: int
    rows: Tensor
    wide: Tensor
    slots: Tensor
    which: Tensor
    spans: Tensor
    boxes: Tensor
    depth: Tensor
    status: Tensor
    lists: TileLists

    @property
    def device(self) -> torch.device:
        return self.rows.device

    @property
    def double(self) -> bool:
        return self.parameters[0].dtype == torch.float64

    @property
    def inputs(self) -> tuple[Any, ...]:
        """The parameters as Warp arrays."""
        return as_arrays(self.parameters)


def as_arrays(parameters: Sequence[Tensor]) -> tuple[Any, ...]:
    """Tensors of :data:`NAMES`, or of their gradients, as Warp arrays of numbers and vectors."""
    double = parameters[0].dtype == torch.float64
    real, vec3, vec4 = (wp.float64, wp.vec3d, wp.vec4d) if double else (wp.float32, wp.vec3, wp.vec4)
    return tuple(array(x, kind) for x, kind in zip(parameters, (vec3, vec3, vec4, vec3, real, real, real), strict=True))


def _alike(tensors: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """Contiguous, and of one dtype: float64 where any is, else float32; the kernels compute in float64 in any case."""
    dtype = torch.float64 if any(x.dtype == torch.float64 for x in tensors) else torch.float32
    return tuple(x.detach().to(dtype).contiguous() for x in tensors)


def prepared(
    tensors: Mapping[str, Tensor],
    palette: Tensor,
    camera: Camera,
    view: Tensor,
    near: float,
    turns: float,
    edge: int,
    least: float,
    forced: Tensor | None = None,
    images: tuple[Tensor, int] | None = None,
) -> Frame:
    """Everything that the pixel kernels read of one view; the host waits for the device once.

    Args:
        tensors: those of :data:`NAMES`, all on one device: means (N, 3), log_scales (N, 3), quats (N, 4), W1 (N, K, 3),
        b1 (N, K), w2 (N, K),
            b2 (N,).
        palette: (N, C) colours.
        camera: focal lengths, centre and size in pixels.
        view: (4, 4) world to camera, on any device.
        near: near plane, in scene units.
        turns: omega0 / 2 pi.
        edge: p of the density's soft edge.
        least: optical depth below which nothing is drawn, see :mod:`neuprim.core.render.cpu.seen`.
        forced: (N,) bool, primitives to draw in float64 whatever this stage finds.
        images: (N,) int32, which of several images each primitive is drawn in, and how many there are; None for one.

    Raises:
        NotFinite: a primitive is not finite, or leaves the range of float32.
        BackendUnavailable: primitives reach 2^31 tiles or more, all of them together.
    """
    parameters = _alike([tensors[name] for name in NAMES])
    device, (N, K, _), C = parameters[0].device, parameters[3].shape, palette.shape[1]
    double = parameters[0].dtype == torch.float64
    matrix = (
        view.detach().to(device, torch.float64, non_blocking=device.type == "cuda").reshape(16).contiguous()
    )  # a plain copy would wait
    projection = Projection(matrix, camera, near, turns, edge)

    def empty(*shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        return torch.empty(shape, dtype=dtype, device=device)

    rows, spans, boxes = empty(N, L.columns(K, C), 4), empty(N, SPAN_WIDTH), empty(N, 4, dtype=torch.int32)
    depth, status, counts = empty(N, dtype=torch.float64), empty(N, dtype=torch.uint8), empty(2, N, dtype=torch.int32)
    bad = torch.full((1,), N, dtype=torch.int32, device=device)
    inputs, world = as_arrays(parameters), array(matrix, wp.float64)
    launch(
        prepare_kernel(double), N,
        (
            *inputs, array(palette.detach().float().contiguous(), wp.float32), None if forced is None else array(forced.contiguous(), wp.bool),
            world, projection.intrinsics, camera.width, camera.height, near, turns, edge, least, K, C,
            array(rows, wp.vec4), array(spans.view(N, 2, 4), wp.vec4), array(boxes, wp.vec4i), array(depth, wp.float64),
            array(status, wp.uint8), array(counts, wp.int32), array(bad, wp.int32),
        ), device, PER_BLOCK,
    )  # fmt: skip
    counted = count(counts, bad)
    if counted.bad >= 0:
        raise NotFinite(counted.bad)
    lists, slots, which = bin_primitives(
        rows, spans, boxes, depth, counts, counted, camera.width, camera.height, images
    )
    wide = empty(counted.delicate, L.wide_width(K), dtype=torch.float64)
    launch(
        wide_kernel(double), counted.delicate,
        (array(which, wp.int32), *inputs, world, projection.intrinsics, near, turns, K, array(wide, wp.float64)), device, PER_BLOCK,
    )  # fmt: skip
    return Frame(projection, parameters, K, C, rows, wide, slots, which, spans, boxes, depth, status, lists)
