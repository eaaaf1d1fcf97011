# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""Depth images out of a light, read at points on a card: the twin of :mod:`neuprim.tasks.relight.visibility_cpu`. Warp
is imported with it."""

import functools
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import OPTIONS, array, launch, wp

__all__ = ["arriving_light"]

d, f = wp.float64, wp.float32


@functools.cache
def _kernel() -> Any:
    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def arriving(
        points: wp.array(dtype=wp.vec3d), view: wp.array2d(dtype=wp.float64), near: wp.float64, focal: wp.float64,
        alphas: wp.array3d(dtype=float), depths: wp.array3d(dtype=float), bias: wp.float64, softness: wp.float64, found: wp.array(dtype=float),
    ):  # fmt: skip
        p = wp.tid()
        q = points[p]
        half = d(0.5)
        one = d(1.0)
        x = view[0, 0] * q[0] + view[0, 1] * q[1] + view[0, 2] * q[2] + view[0, 3]
        y = view[1, 0] * q[0] + view[1, 1] * q[1] + view[1, 2] * q[2] + view[1, 3]
        z = view[2, 0] * q[0] + view[2, 1] * q[1] + view[2, 2] * q[2] + view[2, 3]
        size = alphas.shape[1]
        arrives = d(1.0)
        if z > near:  # else behind the light's camera
            u = focal * x / z + half * d(size) - half  # in pixels, 0 the middle of the first
            v = focal * y / z + half * d(size) - half
            if u > -one and u < d(size) and v > -one and v < d(size):
                i = int(wp.floor(v))
                j = int(wp.floor(u))
                down = v - d(i)
                right = u - d(j)
                for k in range(alphas.shape[0]):
                    alpha = d(0.0)
                    nearness = d(0.0)
                    for corner in range(4):
                        row = i + corner // 2
                        column = j + corner % 2
                        if row >= 0 and row < size and column >= 0 and column < size:
                            own = d(alphas[k, row, column])
                            if own > d(0.0):
                                weight = (
                                    wp.where(corner // 2 == 1, down, one - down)
                                    * wp.where(corner % 2 == 1, right, one - right)
                                    * own
                                )
                                alpha += weight
                                nearness += weight / wp.max(d(depths[k, row, column]), near)
                    behind = z - alpha / wp.max(nearness, d(1e-30))
                    s = wp.min(wp.max(half + half * (behind - bias) / softness, d(0.0)), one)
                    arrives *= one - alpha * s * s * (d(3.0) - d(2.0) * s)
        found[p] = f(arrives)

    return arriving


def arriving_light(
    points: Tensor,
    view: Tensor,
    near: float,
    focal: float,
    alphas: Tensor,
    depths: Tensor,
    bias: float,
    softness: float,
) -> Tensor:
    """(M,) float32 visibility of ``points`` (M, 3) float64, see
    :func:`~neuprim.tasks.relight.visibility_cpu.arriving_light`."""
    found = torch.empty(len(points), dtype=torch.float32, device=points.device)
    launch(
        _kernel(), len(points),
        (
            array(points, wp.vec3d), array(view.contiguous(), wp.float64), near, focal, array(alphas.float().contiguous(), wp.float32),
            array(depths.float().contiguous(), wp.float32), bias, softness, array(found, wp.float32),
        ), points.device,
    )  # fmt: skip
    return found
