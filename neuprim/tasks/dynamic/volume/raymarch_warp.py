# mypy: disable-error-code="valid-type, no-untyped-def, index, empty-body"
"""March rays on a GPU, one thread per pixel or voxel: the twin of :mod:`~neuprim.tasks.dynamic.volume.raymarch`.

Positions along a ray are float64, accumulated values float32, as there. Warp is imported with this module.
"""

from __future__ import annotations

import functools
import math
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute.warp import OPTIONS, array, launch_kernel, wp

d, f = wp.float64, wp.float32
_LOW, _HIGH = 0.5 - math.sqrt(3.0) / 6.0, 0.5 + math.sqrt(3.0) / 6.0
_LESS, _MORE = math.sqrt(1.0 / 3.0) - 0.5, math.sqrt(1.0 / 3.0) + 0.5
_FAR, _OPAQUE, _SHORTEST, _DARK = 1e30, 1e-4, 1.0 / 64.0, 16.0


@wp.func
def _clip_march_to_slab(o: wp.float64, way: wp.float64, size: wp.float64, range: wp.vec2d):
    """The part of ``range`` in which ``o + t way`` is within 0..size."""
    if wp.abs(way) < d(1e-12):
        if o >= d(0.0) and o <= size:
            return range
        return wp.vec2d(d(_FAR), -d(_FAR))
    a = -o / way
    b = (size - o) / way
    return wp.vec2d(wp.max(range[0], wp.min(a, b)), wp.min(range[1], wp.max(a, b)))


@wp.func
def _inverse_march_direction(way: wp.float64):
    """1 / way; 0 where the ray runs along the cells."""
    if wp.abs(way) > d(1e-12):
        return d(1.0) / way
    return d(0.0)


@wp.func
def _first_march_cell(o: wp.float64, way: wp.float64, t: wp.float64, cells: int):
    """The cell of a point, per axis."""
    return wp.min(wp.max(int(wp.floor(o + t * way)), 0), cells - 1)


@wp.func
def _march_cell_exit(o: wp.float64, inverse: wp.float64, cell: int, reach: int):
    """Where the ray leaves the cells ``cell - reach … cell + reach`` of one axis."""
    if inverse > d(0.0):
        return (d(cell + reach + 1) - o) * inverse
    if inverse < d(0.0):
        return (d(cell - reach) - o) * inverse
    return d(_FAR)


@wp.func
def _next_march_cell(o: wp.float64, way: wp.float64, cell: int, reach: int, t: wp.float64, crossed: bool):
    """The cell beyond ``t``, per axis: exact on the axis that is crossed, so that rounding never holds a ray up."""
    if crossed:
        if way > d(0.0):
            return cell + reach + 1
        return cell - reach - 1
    if reach == 0:
        return cell
    return wp.min(wp.max(int(wp.floor(o + t * way)), cell - reach), cell + reach)


@wp.func
def _march_absorption(depth: float):
    """((1 - exp(-depth)) / depth, exp(-depth)), without cancellation and mostly without an exponential."""
    if depth < 0.5:
        mean = 1.0 - depth / 7.0
        mean = 1.0 - depth / 6.0 * mean
        mean = 1.0 - depth / 5.0 * mean
        mean = 1.0 - depth / 4.0 * mean
        mean = 1.0 - depth / 3.0 * mean
        mean = 1.0 - depth / 2.0 * mean
        return wp.vec2(mean, 1.0 - depth * mean)
    rest = wp.exp(-depth)
    return wp.vec2((1.0 - rest) / depth, rest)


@wp.func
def _march_step_gains(a: float, b: float):
    """How much of the sources of two Gauss points leaves a step, and its transmittance; a, b: optical depth that each
    point stands for."""
    depth = a + b
    if depth > 0.5:
        one = _march_absorption(a)
        two = _march_absorption(b)
        return wp.vec3(one[0], one[1] * two[0], one[1] * two[1])
    mean = _march_absorption(depth)
    p = wp.exp(_LESS * b - 0.5 * a)
    q = wp.exp(-_MORE * a - 0.5 * b)
    whole = a * p + b * q
    scale = float(1.0)
    if whole > 1e-30:
        scale = mean[0] * depth / whole
    return wp.vec3(p * scale, q * scale, mean[1])


@wp.func
def _trilinear_march_sample(v: Any, i: int, j: int, k: int, x: float, y: float, z: float):
    """Trilinear value of an (X, Y, Z) array at fractions of cell (i, j, k)."""
    a = v[i, j, k] + z * (v[i, j, k + 1] - v[i, j, k])
    b = v[i, j + 1, k] + z * (v[i, j + 1, k + 1] - v[i, j + 1, k])
    c = v[i + 1, j, k] + z * (v[i + 1, j, k + 1] - v[i + 1, j, k])
    e = v[i + 1, j + 1, k] + z * (v[i + 1, j + 1, k + 1] - v[i + 1, j + 1, k])
    a = a + y * (b - a)
    c = c + y * (e - c)
    return a + x * (c - a)


@functools.cache
def _march_image_kernel() -> Any:
    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def radiances(
        values: wp.array3d(dtype=wp.vec4), skips: wp.array3d(dtype=wp.uint8), pose: wp.array2d(dtype=wp.float64),
        lens: wp.array(dtype=wp.float64), size: wp.vec2i, samples: int, parts: int, image: wp.array(dtype=wp.vec4),
    ):  # fmt: skip
        pixel = wp.tid()
        column, row = pixel % size[0], pixel // size[0]
        nx, ny, nz = skips.shape[0], skips.shape[1], skips.shape[2]
        origin = wp.vec3d(pose[0, 3], pose[1, 3], pose[2, 3])
        total = wp.vec4()
        for sample in range(samples * samples):
            cx = (d(column) + (d(sample % samples) + d(0.5)) / d(samples) - lens[2]) / lens[0]
            cy = (d(row) + (d(sample // samples) + d(0.5)) / d(samples) - lens[3]) / lens[1]
            unit = d(1.0) / wp.sqrt(cx * cx + cy * cy + d(1.0))
            rx = (pose[0, 0] * cx + pose[0, 1] * cy + pose[0, 2]) * unit
            ry = (pose[1, 0] * cx + pose[1, 1] * cy + pose[1, 2]) * unit
            rz = (pose[2, 0] * cx + pose[2, 1] * cy + pose[2, 2]) * unit
            inside = _clip_march_to_slab(origin[0], rx, d(nx), wp.vec2d(d(0.0), d(_FAR)))
            inside = _clip_march_to_slab(origin[1], ry, d(ny), inside)
            inside = _clip_march_to_slab(origin[2], rz, d(nz), inside)
            t = d(inside[0])
            if t < inside[1]:
                ix, iy, iz = _inverse_march_direction(rx), _inverse_march_direction(ry), _inverse_march_direction(rz)
                i = int(_first_march_cell(origin[0], rx, t, nx))
                j = int(_first_march_cell(origin[1], ry, t, ny))
                k = int(_first_march_cell(origin[2], rz, t, nz))
                through = float(1.0)
                light = wp.vec3()
                while through >= _OPAQUE and i >= 0 and i < nx and j >= 0 and j < ny and k >= 0 and k < nz:
                    skip = int(skips[i, j, k])
                    reach = wp.max(skip - 1, 0)
                    tx = _march_cell_exit(origin[0], ix, i, reach)
                    ty = _march_cell_exit(origin[1], iy, j, reach)
                    tz = _march_cell_exit(origin[2], iz, k, reach)
                    out = wp.min(tx, wp.min(ty, tz))
                    if skip == 0 and out > t:
                        step = (out - t) / d(parts)
                        part = d(step)
                        begin = d(t)
                        while begin < out and through > _OPAQUE:
                            s = begin + part * d(_LOW)
                            x1, y1 = f(origin[0] + s * rx - d(i)), f(origin[1] + s * ry - d(j))
                            z1 = f(origin[2] + s * rz - d(k))
                            s = begin + part * d(_HIGH)
                            x2, y2 = f(origin[0] + s * rx - d(i)), f(origin[1] + s * ry - d(j))
                            z2 = f(origin[2] + s * rz - d(k))
                            one = _trilinear_march_sample(values, i, j, k, x1, y1, z1)
                            two = _trilinear_march_sample(values, i, j, k, x2, y2, z2)
                            half = f(d(0.5) * part)
                            s1 = one[0] * half
                            s2 = two[0] * half
                            if s1 + s2 > 0.5 and part > d(_SHORTEST) * step:
                                if s1 + s2 < 1.0:
                                    part = d(0.5) * part
                                else:
                                    part = d(0.25) * part
                            else:
                                gains = _march_step_gains(s1, s2)
                                p = gains[0] * through * half
                                q = gains[1] * through * half
                                light += p * wp.vec3(one[1], one[2], one[3]) + q * wp.vec3(two[1], two[2], two[3])
                                through *= gains[2]
                                begin += part
                                part = wp.min(step, out - begin)
                    i = _next_march_cell(origin[0], rx, i, reach, out, tx == out)
                    j = _next_march_cell(origin[1], ry, j, reach, out, ty == out)
                    k = _next_march_cell(origin[2], rz, k, reach, out, tz == out)
                    t = wp.max(t, out)
                total += wp.vec4(light[0], light[1], light[2], 1.0 - through)
        image[pixel] = total * (1.0 / float(samples * samples))

    return radiances


@functools.cache
def _march_depth_kernel() -> Any:
    @wp.kernel(enable_backward=False, module="unique", module_options=OPTIONS, grid_stride=False)
    def depths(
        sigma: wp.array3d(dtype=float), skips: wp.array3d(dtype=wp.uint8), way: wp.array(dtype=wp.float64),
        result: wp.array3d(dtype=float),
    ):  # fmt: skip
        a, b, c = wp.tid()
        if sigma[a, b, c] > 0.0:
            nx, ny, nz = skips.shape[0], skips.shape[1], skips.shape[2]
            ix, iy, iz = (
                _inverse_march_direction(way[0]),
                _inverse_march_direction(way[1]),
                _inverse_march_direction(way[2]),
            )
            ox, oy, oz = d(a), d(b), d(c)
            i = int(wp.min(a, nx - 1))
            j = int(wp.min(b, ny - 1))
            k = int(wp.min(c, nz - 1))
            t = d(0.0)
            depth = d(0.0)
            while i >= 0 and i < nx and j >= 0 and j < ny and k >= 0 and k < nz and depth < d(_DARK):
                skip = int(skips[i, j, k])
                reach = wp.max(skip - 1, 0)
                tx = _march_cell_exit(ox, ix, i, reach)
                ty = _march_cell_exit(oy, iy, j, reach)
                tz = _march_cell_exit(oz, iz, k, reach)
                out = wp.min(tx, wp.min(ty, tz))
                if skip == 0 and out > t:
                    for point in range(2):
                        s = t + (out - t) * wp.where(point == 0, d(_LOW), d(_HIGH))
                        x, y, z = f(ox + s * way[0] - d(i)), f(oy + s * way[1] - d(j)), f(oz + s * way[2] - d(k))
                        depth += d(0.5) * (out - t) * d(_trilinear_march_sample(sigma, i, j, k, x, y, z))
                i = _next_march_cell(ox, way[0], i, reach, out, tx == out)
                j = _next_march_cell(oy, way[1], j, reach, out, ty == out)
                k = _next_march_cell(oz, way[2], k, reach, out, tz == out)
                t = wp.max(t, out)
            result[a, b, c] = f(depth)

    return depths


def march_images(
    values: Tensor, skips: Tensor, pose: Tensor, lens: Tensor, size: tuple[int, int], samples: int, subdivisions: int
) -> Tensor:
    """(H, W, 4) float32 premultiplied RGBA, on the device of the voxels; arguments as of the kernel of the CPU, and
    ``size`` = (W, H)."""
    image = torch.empty(size[1] * size[0], 4, dtype=torch.float32, device=values.device)
    arrays = (array(values, wp.vec4), array(skips, wp.uint8), array(pose, d), array(lens, d))
    inputs = (*arrays, wp.vec2i(*size), samples, subdivisions, array(image, wp.vec4))
    launch_kernel(_march_image_kernel(), size[1] * size[0], inputs, values.device)
    return image.view(size[1], size[0], 4)


def march_depths(sigma: Tensor, skips: Tensor, way: Tensor) -> Tensor:
    """(X, Y, Z) float32 optical depth from every voxel with extinction to the end of the grid, 0 from the others.

    Args:
        way: (3,) float64, the direction, indices per scene unit.
    """
    result = torch.zeros_like(sigma)
    inputs = (array(sigma, f), array(skips, wp.uint8), array(way, d), array(result, f))
    launch_kernel(_march_depth_kernel(), sigma.shape, inputs, sigma.device)
    return result
