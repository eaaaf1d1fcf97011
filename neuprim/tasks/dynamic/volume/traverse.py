"""The two kernels that walk rays through the cells between voxel centres, and the steps they share.

A cell is the cube between eight voxel centres. Along a straight line through it a trilinear field is a cubic polynomial, which
two Gauss points integrate exactly: the optical depth of a ray has no discretisation error at all. For the radiance, each Gauss
point stands for the half of the optical depth that it contributes, with its own source; this is exact for thin cells and for a
constant source, and second order in the step otherwise.

Both kernels are in one file because numba's cache does not notice edits of other files.
"""

from __future__ import annotations

import math

import numpy as np

from neuprim.core.render.cpu.compile import inline, kernel

__all__ = ["depths", "radiances"]

_GAUSS = 0.5 - math.sqrt(3.0) / 6.0
_FAR = 1e30
_OPAQUE = np.float32(1e-4)
_DARK = 16.0
_HALF, _ONE, _ZERO = np.float32(0.5), np.float32(1.0), np.float32(0.0)
_C2, _C3, _C4, _C5, _C6, _C7 = (np.float32(1.0 / n) for n in range(2, 8))


@inline
def _slab(o, d, size, near, far):  # type: ignore[no-untyped-def]
    """The part of [near, far] in which ``o + t d`` is within 0..size."""
    if abs(d) < 1e-12:
        return (near, far) if 0.0 <= o <= size else (_FAR, -_FAR)
    a, b = -o / d, (size - o) / d
    return max(near, min(a, b)), min(far, max(a, b))


@inline
def _first(o, d, t, cells):  # type: ignore[no-untyped-def]
    """The cell of a point, per axis."""
    return min(max(int(math.floor(o + t * d)), 0), cells - 1)


@inline
def _leave(o, d, cell, reach):  # type: ignore[no-untyped-def]
    """Where the ray leaves the cells ``cell - reach … cell + reach`` of one axis."""
    if d > 1e-12:
        return (cell + reach + 1 - o) / d
    if d < -1e-12:
        return (cell - reach - o) / d
    return _FAR


@inline
def _next(o, d, cell, reach, t, crossed):  # type: ignore[no-untyped-def]
    """The cell beyond ``t``, per axis: exact on the axis that is crossed, so that rounding never holds a ray up."""
    if crossed:
        return cell + reach + 1 if d > 0.0 else cell - reach - 1
    if reach == 0:
        return cell
    return min(max(int(math.floor(o + t * d)), cell - reach), cell + reach)


@inline
def _fading(depth):  # type: ignore[no-untyped-def]
    """(1 - exp(-depth)) / depth and exp(-depth), float32; without cancellation and mostly without an exponential."""
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
def _blend(v, o, dy, dx, x, y, z):  # type: ignore[no-untyped-def]
    """Trilinear value from the eight corners of a cell; ``o`` is the offset of its lowest one, ``dz`` is 4."""
    four = np.uint64(4)
    a = v[o] + z * (v[o + four] - v[o])
    b = v[o + dy] + z * (v[o + dy + four] - v[o + dy])
    o = o + dx
    c = v[o] + z * (v[o + four] - v[o])
    d = v[o + dy] + z * (v[o + dy + four] - v[o + dy])
    a += y * (b - a)
    c += y * (d - c)
    return a + x * (c - a)


@kernel
def radiances(start, stop, values, skips, pose, lens, width, samples, parts, image):  # type: ignore[no-untyped-def]
    """Image rows start … stop.

    Args:
        values: (X, Y, Z, 4) float32. skips: (X-1, Y-1, Z-1) uint8. See Medium.
        pose: (3, 4) float64, camera axes to indices; its lengths are scene units on the camera's side.
        lens: (4,) float64 fx fy cx cy.
        samples: rays per pixel side. parts: sub-intervals per cell.
        image: (H, W, 4) float32, premultiplied RGBA, written.
    """
    nx, ny, nz = skips.shape
    flat = values.reshape(-1)
    dy = np.uint64(4 * (nz + 1))
    dx = dy * np.uint64(ny + 1)
    weight = np.float32(1.0 / (samples * samples))
    ox, oy, oz = pose[0, 3], pose[1, 3], pose[2, 3]
    u1, u2, u3 = np.uint64(1), np.uint64(2), np.uint64(3)
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
                t, end = _slab(ox, rx, float(nx), 0.0, _FAR)
                t, end = _slab(oy, ry, float(ny), t, end)
                t, end = _slab(oz, rz, float(nz), t, end)
                if t >= end:
                    continue
                i, j, k = _first(ox, rx, t, nx), _first(oy, ry, t, ny), _first(oz, rz, t, nz)
                through = _ONE
                r, g, b = _ZERO, _ZERO, _ZERO
                while 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
                    skip = int(skips[i, j, k])
                    reach = max(skip - 1, 0)
                    tx, ty, tz = _leave(ox, rx, i, reach), _leave(oy, ry, j, reach), _leave(oz, rz, k, reach)
                    out = min(tx, min(ty, tz))
                    if skip == 0 and out > t:
                        o = np.uint64(i) * dx + np.uint64(j) * dy + np.uint64(4 * k)
                        step = (out - t) / parts
                        half = np.float32(0.5 * step)
                        for point in range(2 * parts):
                            s = t + step * (point // 2 + (_GAUSS if point % 2 == 0 else 1.0 - _GAUSS))
                            x, y, z = np.float32(ox + s * rx - i), np.float32(oy + s * ry - j), np.float32(oz + s * rz - k)
                            mean, rest = _fading(half * _blend(flat, o, dy, dx, x, y, z))
                            gain = through * half * mean
                            r += gain * _blend(flat, o + u1, dy, dx, x, y, z)
                            g += gain * _blend(flat, o + u2, dy, dx, x, y, z)
                            b += gain * _blend(flat, o + u3, dy, dx, x, y, z)
                            through *= rest
                        if through < _OPAQUE:
                            break
                    i = _next(ox, rx, i, reach, out, tx == out)
                    j = _next(oy, ry, j, reach, out, ty == out)
                    k = _next(oz, rz, k, reach, out, tz == out)
                    t = max(t, out)
                sum_r += r
                sum_g += g
                sum_b += b
                sum_a += _ONE - through
            image[row, column, 0] = sum_r * weight
            image[row, column, 1] = sum_g * weight
            image[row, column, 2] = sum_b * weight
            image[row, column, 3] = sum_a * weight


@inline
def _between(v, i, j, k, x, y, z):  # type: ignore[no-untyped-def]
    """Trilinear value of an (X, Y, Z) array at fractions of cell (i, j, k)."""
    a = v[i, j, k] + z * (v[i, j, k + 1] - v[i, j, k])
    b = v[i, j + 1, k] + z * (v[i, j + 1, k + 1] - v[i, j + 1, k])
    c = v[i + 1, j, k] + z * (v[i + 1, j, k + 1] - v[i + 1, j, k])
    d = v[i + 1, j + 1, k] + z * (v[i + 1, j + 1, k + 1] - v[i + 1, j + 1, k])
    a += y * (b - a)
    c += y * (d - c)
    return a + x * (c - a)


@kernel
def depths(start, stop, sigma, skips, rx, ry, rz, result):  # type: ignore[no-untyped-def]
    """Optical depth from the voxels of slices start … stop in one direction to the end of the grid.

    Args:
        sigma: (X, Y, Z) float32. skips: as in :func:`radiances`.
        rx, ry, rz: the direction, indices per scene unit.
        result: (X, Y, Z) float32, written where sigma > 0; a ray stops at a depth of 16.
    """
    nx, ny, nz = skips.shape
    for a in range(start, stop):
        for b in range(ny + 1):
            for c in range(nz + 1):
                if sigma[a, b, c] <= 0.0:
                    continue
                ox, oy, oz = float(a), float(b), float(c)
                i, j, k = min(a, nx - 1), min(b, ny - 1), min(c, nz - 1)
                t, depth = 0.0, 0.0
                while 0 <= i < nx and 0 <= j < ny and 0 <= k < nz and depth < _DARK:
                    skip = int(skips[i, j, k])
                    reach = max(skip - 1, 0)
                    tx, ty, tz = _leave(ox, rx, i, reach), _leave(oy, ry, j, reach), _leave(oz, rz, k, reach)
                    out = min(tx, min(ty, tz))
                    if skip == 0 and out > t:
                        for point in range(2):
                            s = t + (out - t) * (_GAUSS if point == 0 else 1.0 - _GAUSS)
                            x, y, z = np.float32(ox + s * rx - i), np.float32(oy + s * ry - j), np.float32(oz + s * rz - k)
                            depth += 0.5 * (out - t) * _between(sigma, i, j, k, x, y, z)
                    i = _next(ox, rx, i, reach, out, tx == out)
                    j = _next(oy, ry, j, reach, out, ty == out)
                    k = _next(oz, rz, k, reach, out, tz == out)
                    t = max(t, out)
                result[a, b, c] = depth
