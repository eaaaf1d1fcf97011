"""Ray marching of a voxel medium, cell by cell: images, and the transmittance to a light.

A cell is the cube between eight voxel centres. Along a straight line through a cell, a trilinear field is a cubic
polynomial. Gauss quadrature with two points integrates a cubic polynomial exactly, so a ray's optical depth has no
discretisation error. For the radiance, the source at each Gauss point is weighted by the transmittance up to the point.
The weights are scaled so that a constant source is integrated exactly. The error is of fourth order in the step. Steps
with an optical depth above 0.5 are shortened.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from llvmlite import ir
from numba import types
from numba.extending import intrinsic
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.compute.kernels import inline, kernel
from neuprim.core.compute.threads import parallel_for
from neuprim.tasks.dynamic.volume.medium import Medium, find_brick, trilinear_sample

_ROWS_PER_JOB, _SLICES_PER_JOB = 4, 2
_GAUSS, _FAR = 0.5 - math.sqrt(3.0) / 6.0, 1e30
_OPAQUE = np.float32(1e-4)
_SHORTEST = 1.0 / 64.0
_LESS, _MORE = np.float32(math.sqrt(1.0 / 3.0) - 0.5), np.float32(math.sqrt(1.0 / 3.0) + 0.5)
_TINY, _DARK = np.float32(1e-30), 16.0
_HALF, _ONE, _ZERO = np.float32(0.5), np.float32(1.0), np.float32(0.0)
_C2, _C3, _C4, _C5, _C6, _C7 = (np.float32(1.0 / n) for n in range(2, 8))


def render_medium(medium: Medium, camera: Camera, samples: int = 2, subdivisions: int = 1) -> Tensor:
    """Render a medium to (H, W, 4) float32 linear premultiplied RGBA, without a background.

    Alpha is exact up to rounding; radiance has an error of fourth order in the step. A ray ends where its transmittance
    falls below 1e-4.

    Args:
        camera: pinhole, scene units.
        samples: rays per pixel along each axis of the image, on a regular grid.
        subdivisions: sub-intervals per cell; more than 1 only to verify the error.
    """
    if medium.empty or medium.skips.min() > 0:
        return torch.zeros(camera.height, camera.width, 4)
    pose = (medium.index_from_scene @ np.linalg.inv(camera.viewmat.detach().double().cpu().numpy()))[:3]
    lens = np.array([camera.fx, camera.fy, camera.cx, camera.cy], np.float64)
    image = np.zeros((camera.height, camera.width, 4), np.float32)
    bricks = medium.bricks
    voxels = (medium.values, medium.skips, bricks.table, bricks.shift, bricks.cells)
    rays = (np.ascontiguousarray(pose), lens, camera.width, samples, subdivisions)
    parallel_for(_march_image_rows, camera.height, _ROWS_PER_JOB, 0, *voxels, *rays, image)
    return torch.from_numpy(image)


def light_transmittance(medium: Medium, direction: Sequence[float]) -> np.ndarray:
    """Return (B, x, y, z) float32 transmittance exp(-∫ σ ds) from voxel centres to a directional light.

    ``direction`` points to the light, on the scene's axes, with any length > 0. The transmittance is exact up to
    rounding, except that a ray stops at an optical depth of 16. Voxels without extinction get 1, because no ray is
    traced from these voxels.
    """
    towards = np.array(direction, np.float64)
    return _transmittance_to(medium, np.append(towards / float(np.linalg.norm(towards)), 0.0))


def point_transmittance(medium: Medium, position: Sequence[float]) -> np.ndarray:
    """Return (B, x, y, z) float32 transmittance from voxel centres to a point, given in scene units.

    The transmittance is exact up to rounding, except that a ray stops at an optical depth of 16. Voxels without
    extinction get 1, because no ray is traced from these voxels.
    """
    return _transmittance_to(medium, np.append(np.array(position, np.float64), 1.0))


def _transmittance_to(medium: Medium, place: np.ndarray) -> np.ndarray:
    """Return (B, x, y, z) transmittance from voxel centres to ``place`` (4,), a homogeneous point in scene coordinates.

    The last number of ``place`` is 1 for a position and 0 for a direction.
    """
    result, bricks = np.zeros(medium.values.shape[:4], np.float32), medium.bricks
    if not medium.empty:
        sigma = np.ascontiguousarray(medium.values[..., 0])
        units = np.ascontiguousarray(medium.scene_from_index[:3, :3])
        voxels = (sigma, medium.skips, bricks.table, bricks.shift, bricks.cells, bricks.origins)
        slices = len(sigma) * bricks.without_shared(sigma).shape[1]
        target = medium.index_from_scene @ place
        parallel_for(_march_depths, slices, _SLICES_PER_JOB, 0, *voxels, target, units, bricks.without_shared(result))
        bricks.copy_shared(result)
    return np.exp(-result)


# ---------------------------------------------------------------- kernels


@inline
def _clip_march_to_slab(o, d, size, near, far):  # type: ignore[no-untyped-def]
    """Return the part of the interval [near, far] of t in which a ray's coordinate ``o + t d`` is within 0..size.

    ``o`` and ``d`` are the ray's origin and direction along one axis. The result is empty (near > far) if the ray
    misses the range 0..size.
    """
    if abs(d) < 1e-12:
        return (near, far) if 0.0 <= o <= size else (_FAR, -_FAR)
    a, b = -o / d, (size - o) / d
    return max(near, min(a, b)), min(far, max(a, b))


@inline
def _first_march_cell(o, d, t, cells):  # type: ignore[no-untyped-def]
    """Return the index, along one axis, of the cell that contains ``o + t d``; clamped to 0..``cells`` - 1."""
    return min(max(math.floor(o + t * d), 0), cells - 1)


@inline
def _inverse_march_direction(d):  # type: ignore[no-untyped-def]
    """Return 1 / d for one axis; 0 if the ray does not leave its cell along this axis."""
    return 1.0 / d if abs(d) > 1e-12 else 0.0


@inline
def _march_cell_exit(o, inverse, cell, reach):  # type: ignore[no-untyped-def]
    """Return the t at which a ray leaves the cells ``cell - reach … cell + reach`` of one axis; 1e30 for never.

    The ray's coordinate on this axis is ``o`` + t/``inverse``; ``inverse`` is 0 if the coordinate does not change.
    """
    if inverse > 0.0:
        return (cell + reach + 1 - o) * inverse
    if inverse < 0.0:
        return (cell - reach - o) * inverse
    return _FAR


@inline
def _next_march_cell(o, d, cell, reach, t, crossed):  # type: ignore[no-untyped-def]
    """Return the cell index along one axis after a ray has left the cells ``cell - reach … cell + reach`` at ``t``.

    If the ray ``crossed`` the cells' border on this axis, the index is exact, so that rounding cannot stop the ray.
    """
    if crossed:
        return cell + reach + 1 if d > 0.0 else cell - reach - 1
    if reach == 0:
        return cell
    return min(max(math.floor(o + t * d), cell - reach), cell + reach)


@inline
def _march_absorption(depth):  # type: ignore[no-untyped-def]
    """Return a step's mean transmittance (1 - exp(-depth)) / depth, and its total transmittance exp(-depth); float32.

    ``depth`` is the optical depth of the step. A series for small depths avoids cancellation.
    """
    if depth < _HALF:
        mean = _ONE - depth * _C7
        mean = _ONE - depth * _C6 * mean
        mean = _ONE - depth * _C5 * mean
        mean = _ONE - depth * _C4 * mean
        mean = _ONE - depth * _C3 * mean
        mean = _ONE - depth * _C2 * mean
        return mean, _ONE - depth * mean
    rest = math.exp(-depth)
    return (_ONE - rest) / depth, rest


@inline
def _short_march_transmittance(depth):  # type: ignore[no-untyped-def]
    """Return exp(-depth) by a polynomial, with an error of at most 3e-6 for depths of -0.05 to 0.55; float32."""
    rest = _ONE - depth * _C6
    rest = _ONE - depth * _C5 * rest
    rest = _ONE - depth * _C4 * rest
    rest = _ONE - depth * _C3 * rest
    rest = _ONE - depth * _C2 * rest
    return _ONE - depth * rest


@inline
def _march_step_gains(a, b):  # type: ignore[no-untyped-def]
    """Return the weights of the sources at the two Gauss points of a step, and the step's transmittance, float32.

    Args:
        a, b: optical depth of the first and the second half of the step, each from the extinction at its Gauss point.
    """
    depth = a + b
    if depth > _HALF:  # shortest steps in an almost opaque medium: the points one after the other, always in range
        p, rest = _march_absorption(a)
        q, last = _march_absorption(b)
        return p, rest * q, rest * last
    mean, rest = _march_absorption(depth)
    # depths up to the points if extinction is linear; the first may come out slightly below zero
    p, q = _short_march_transmittance(_HALF * a - _LESS * b), _short_march_transmittance(_MORE * a + _HALF * b)
    whole = a * p + b * q
    scale = mean * depth / whole if whole > _TINY else _ONE
    return p * scale, q * scale, rest


_FREE = ("nsz", "contract", "reassoc")  # fast-math flags of LLVM in _two_points


def _generate_two_march_points(context: Any, flat: Any, corner: Any, first: Any, second: Any) -> Any:
    """Generate LLVM vector code that interpolates the four channels of voxels trilinearly at two points of a cell.

    Return the numba signature and the generator. The generated code returns the channels at the first point, then at
    the second. Vector code is used because scalar code takes 1.4 times as long.

    Args:
        flat: float32 array of the interleaved voxels.
        corner: (o, dy, dx) uint64: offset of the cell's lowest corner, strides along y and x. The stride along z is 4.
        first, second: (x, y, z) float32 fractions within the cell, of each point.
    """
    signature = types.UniTuple(types.float32, 8)(flat, corner, first, second)
    number, vector = ir.IntType(32), ir.VectorType(ir.FloatType(), 4)
    nothing, lanes = ir.Constant(vector, ir.Undefined), ir.Constant(ir.VectorType(number, 4), [0] * 4)

    def generate(target: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = target.make_array(signature.args[0])(target, builder, args[0]).data
        low, to_y, to_x = (builder.extract_value(args[1], n) for n in range(3))
        to_z = ir.Constant(ir.IntType(64), 4)

        def load_corner(*steps: Any) -> Any:
            at = low
            for step in steps:
                at = builder.add(at, step)
            return builder.load(builder.bitcast(builder.gep(data, [at]), vector.as_pointer()), align=4)

        def spread(point: Any, axis: int) -> Any:
            value = builder.insert_element(nothing, builder.extract_value(point, axis), number(0))
            return builder.shuffle_vector(value, nothing, lanes)

        def along(a: Any, change: Any, part: Any) -> Any:
            return builder.fadd(a, builder.fmul(part, change, _FREE), _FREE)

        def between(a: Any, b: Any, part: Any) -> Any:
            return along(a, builder.fsub(b, a, _FREE), part)

        edges = []
        for steps in ((), (to_y,), (to_x,), (to_x, to_y)):
            below = load_corner(*steps)
            edges.append((below, builder.fsub(load_corner(*steps, to_z), below, _FREE)))
        channels = []
        for point in args[2:]:
            x, y, z = (spread(point, axis) for axis in range(3))
            a, b, c, d = (along(below, change, z) for below, change in edges)
            value = between(between(a, b, y), between(c, d, y), x)
            channels += [builder.extract_element(value, number(n)) for n in range(4)]
        return target.make_tuple(builder, signature.return_type, channels)

    return signature, generate


_two_points: Any = intrinsic(_generate_two_march_points)


@kernel
def _march_image_rows(  # type: ignore[no-untyped-def]
    start, stop, values, skips, table, shift, cells, pose, lens, width, samples, parts, image
):
    """Render image rows start:stop.

    Args:
        values, skips: attributes of the :class:`~neuprim.tasks.dynamic.volume.medium.Medium` to render.
        table, shift, cells: attributes of the medium's ``bricks``.
        pose: (3, 4) float64, from camera space (scene units) to indices.
        lens: (4,) float64 fx fy cx cy.
        samples: rays per pixel along each axis of the image.
        parts: sub-intervals per cell.
        image: (H, W, 4) float32, premultiplied RGBA, written.
    """
    nx, ny, nz = cells[0], cells[1], cells[2]
    mask = (1 << shift) - 1
    flat = values.reshape(-1)
    dy = np.uint64(4 * values.shape[3])
    dx = dy * np.uint64(values.shape[2])
    block = dx * np.uint64(values.shape[1])
    weight = np.float32(1.0 / (samples * samples))
    share = 1.0 / parts
    ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
    for row in range(start, stop):
        for column in range(width):
            sum_r, sum_g, sum_b, sum_a = _ZERO, _ZERO, _ZERO, _ZERO
            for sample in range(samples * samples):
                cx = (column + (sample % samples + 0.5) / samples - lens[2]) / lens[0]
                cy = (row + (sample // samples + 0.5) / samples - lens[3]) / lens[1]
                unit = 1.0 / math.sqrt(cx * cx + cy * cy + 1.0)
                rx = (pose[0, 0] * cx + pose[0, 1] * cy + pose[0, 2]) * unit
                ry = (pose[1, 0] * cx + pose[1, 1] * cy + pose[1, 2]) * unit
                rz = (pose[2, 0] * cx + pose[2, 1] * cy + pose[2, 2]) * unit
                t, end = _clip_march_to_slab(ox, rx, float(nx), 0.0, _FAR)
                t, end = _clip_march_to_slab(oy, ry, float(ny), t, end)
                t, end = _clip_march_to_slab(oz, rz, float(nz), t, end)
                if t >= end:
                    continue
                ix, iy, iz = _inverse_march_direction(rx), _inverse_march_direction(ry), _inverse_march_direction(rz)
                i = _first_march_cell(ox, rx, t, nx)
                j = _first_march_cell(oy, ry, t, ny)
                k = _first_march_cell(oz, rz, t, nz)
                through = _ONE
                r, g, b = _ZERO, _ZERO, _ZERO
                while 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                    brick = find_brick(table, shift, i, j, k)
                    ci, cj, ck = np.uint64(i & mask), np.uint64(j & mask), np.uint64(k & mask)
                    skip = int(skips[np.uint64(brick), ci, cj, ck]) if brick >= 0 else -brick
                    reach = max(skip - 1, 0)
                    tx = _march_cell_exit(ox, ix, i, reach)
                    ty = _march_cell_exit(oy, iy, j, reach)
                    tz = _march_cell_exit(oz, iz, k, reach)
                    out = min(tx, min(ty, tz))
                    if skip == 0 and out > t:
                        o = np.uint64(brick) * block + ci * dx + cj * dy + np.uint64(4) * ck
                        step = (out - t) * share
                        part = step
                        begin = t
                        while begin < out and through > _OPAQUE:
                            s = begin + part * _GAUSS
                            x1, y1 = np.float32(ox + s * rx - i), np.float32(oy + s * ry - j)
                            z1 = np.float32(oz + s * rz - k)
                            s = begin + part * (1.0 - _GAUSS)
                            x2, y2 = np.float32(ox + s * rx - i), np.float32(oy + s * ry - j)
                            z2 = np.float32(oz + s * rz - k)
                            s1, r1, g1, b1, s2, r2, g2, b2 = _two_points(flat, (o, dy, dx), (x1, y1, z1), (x2, y2, z2))
                            half = np.float32(0.5 * part)
                            s1 *= half
                            s2 *= half
                            if s1 + s2 > _HALF and part > _SHORTEST * step:
                                part *= 0.5 if s1 + s2 < _ONE else 0.25
                                continue
                            p, q, rest = _march_step_gains(s1, s2)
                            p *= through * half
                            q *= through * half
                            r += p * r1 + q * r2
                            g += p * g1 + q * g2
                            b += p * b1 + q * b2
                            through *= rest
                            begin += part
                            part = min(step, out - begin)
                        if through < _OPAQUE:
                            break
                    i = _next_march_cell(ox, rx, i, reach, out, tx == out)
                    j = _next_march_cell(oy, ry, j, reach, out, ty == out)
                    k = _next_march_cell(oz, rz, k, reach, out, tz == out)
                    t = max(t, out)
                sum_r += r
                sum_g += g
                sum_b += b
                sum_a += _ONE - through
            image[row, column, 0] = sum_r * weight
            image[row, column, 1] = sum_g * weight
            image[row, column, 2] = sum_b * weight
            image[row, column, 3] = sum_a * weight


@kernel
def _march_depths(start, stop, sigma, skips, table, shift, cells, origins, target, units, result):  # type: ignore[no-untyped-def]
    """Write the optical depth from each voxel of slices start:stop to a point, or to the box's border in a direction.

    A slice has all voxels of a block with the same index along x. Slices are numbered through all blocks. A ray stops
    at an optical depth of 16.

    Args:
        sigma: (B, x, y, z) float32 extinction of a medium.
        skips: the medium's :attr:`~neuprim.tasks.dynamic.volume.medium.Medium.skips`.
        table, shift, cells, origins: attributes of the medium's ``bricks``.
        target: (4,) float64, homogeneous: a position in indices and 1, or a direction in indices per scene unit and 0.
        units: (3, 3) float64, scene units per index.
        result: (B, x, y, z) float32, without shared voxels; written where sigma > 0.
    """
    nx, ny, nz = cells[0], cells[1], cells[2]
    mask = (1 << shift) - 1
    for number in range(start, stop):
        own, a = divmod(number, result.shape[1])
        for b in range(result.shape[2]):
            for c in range(result.shape[3]):
                if sigma[own, a, b, c] <= 0.0:
                    continue
                i, j, k = origins[own, 0] + a, origins[own, 1] + b, origins[own, 2] + c
                ox, oy, oz = float(i), float(j), float(k)
                rx, ry, rz = target[0] - target[3] * ox, target[1] - target[3] * oy, target[2] - target[3] * oz
                end = _FAR
                if target[3] > 0.0:
                    x = units[0, 0] * rx + units[0, 1] * ry + units[0, 2] * rz
                    y = units[1, 0] * rx + units[1, 1] * ry + units[1, 2] * rz
                    z = units[2, 0] * rx + units[2, 1] * ry + units[2, 2] * rz
                    end = math.sqrt(x * x + y * y + z * z)
                    length = max(end, 1.0 / _FAR)
                    rx, ry, rz = rx / length, ry / length, rz / length
                ix, iy, iz = _inverse_march_direction(rx), _inverse_march_direction(ry), _inverse_march_direction(rz)
                i, j, k = min(i, nx - 1), min(j, ny - 1), min(k, nz - 1)
                t, depth = 0.0, 0.0
                while 0 <= i < nx and 0 <= j < ny and 0 <= k < nz and t < end and depth < _DARK:
                    brick = find_brick(table, shift, i, j, k)
                    ci, cj, ck = i & mask, j & mask, k & mask
                    skip = int(skips[brick, ci, cj, ck]) if brick >= 0 else -brick
                    reach = max(skip - 1, 0)
                    tx = _march_cell_exit(ox, ix, i, reach)
                    ty = _march_cell_exit(oy, iy, j, reach)
                    tz = _march_cell_exit(oz, iz, k, reach)
                    out = min(tx, min(ty, min(tz, end)))
                    if skip == 0 and out > t:
                        for point in range(2):
                            s = t + (out - t) * (_GAUSS if point == 0 else 1.0 - _GAUSS)
                            x, y = np.float32(ox + s * rx - i), np.float32(oy + s * ry - j)
                            z = np.float32(oz + s * rz - k)
                            depth += 0.5 * (out - t) * trilinear_sample(sigma[brick], ci, cj, ck, x, y, z)
                    i = _next_march_cell(ox, rx, i, reach, out, tx == out)
                    j = _next_march_cell(oy, ry, j, reach, out, ty == out)
                    k = _next_march_cell(oz, rz, k, reach, out, tz == out)
                    t = max(t, out)
                result[own, a, b, c] = depth
