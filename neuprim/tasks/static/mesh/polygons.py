"""Polygons as triangles that cover the same surface: fans, else ears; polygons that cross themselves are refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from neuprim.core.errors import DataError

_FANS = 8  # corners that fans of all polygons are tried from, before ears of one are looked for
_MOST_TESTS = 500_000  # of ears, in a model: about 20 seconds
_COSTLY = 500  # corners of a polygon that make a test as long again
_FLAT = 1e-10  # twice an area, over the square of the polygon's size, that counts as none


def triangulate_polygons(
    path: Path, corners: NDArray[np.float64], sizes: NDArray[np.integer]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangles of polygons: (T, 3) rows of ``corners``, and (T,) which polygon each is of, ascending.

    ``corners`` (C, 3) are finite, those of all polygons one after the other, and each of the (P,) ``sizes`` says how
    many a polygon has. Raises DataError for polygons that cross themselves.
    """
    first = np.cumsum(sizes) - sizes
    found, owners, crossed = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int64)], []
    tests = _MOST_TESTS
    for size in np.unique(sizes[sizes >= 3]).tolist():
        rows = np.flatnonzero(sizes == size)
        index = first[rows, None] + np.arange(size)
        if size == 3:
            found.append(index)
            owners.append(rows)
            continue
        points = corners[index] - corners[index[:, :1]]
        with np.errstate(all="ignore"):
            extent = np.abs(points).max(axis=(1, 2), keepdims=True)
            points = np.nan_to_num(points / extent)  # of a point
            normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
            length = np.linalg.norm(normal, axis=1, keepdims=True)
            normal = np.where(length > _FLAT, normal / length, 0.0)
        left = np.arange(len(rows))
        for start in range(min(size, _FANS)):
            fan = _polygon_triangle_fan(size, start)
            a, b, c = (points[left][:, fan[:, i]] for i in range(3))
            across = np.cross(b - a, c - a)
            areas = np.einsum("mtc,mc->mt", across, normal[left])  # twice; negative where triangles turn the other way
            line = np.linalg.norm(across, axis=2).max(axis=1) <= _FLAT if start == 0 else np.False_
            good = ((areas >= -_FLAT).all(axis=1) & (length[left, 0] > _FLAT)) | line
            # triangles without area are no faces of the file
            shown = good[:, None] & ((areas > _FLAT) | np.reshape(line, (-1, 1)))
            found.append(index[left][:, fan][shown])
            owners.append(np.repeat(rows[left], shown.sum(axis=1)))
            left = left[~good]
            if not len(left):
                break
        for i in left.tolist():
            ears, tests = (
                _cut_ears(_flatten_polygon(points[i], normal[i]), tests) if length[i] > _FLAT else (None, tests)
            )
            if ears is None:
                crossed.append(rows[i])
                continue
            found.append(index[i][ears])
            owners.append(np.full(len(ears), rows[i]))
    if crossed:
        first = f"face {min(crossed)} of {sizes[min(crossed)]} corners"
        raise DataError(
            f"{path}: {len(crossed)} of {len(sizes)} faces cross themselves, as {first}; expected simple polygons. "
            "Triangulate the mesh in the program that wrote it"
        )
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(found)[order], owner[order]


def _polygon_triangle_fan(size: int, start: int) -> NDArray[np.intp]:
    """(size - 2, 3) corners of the triangles around the corner ``start``."""
    around = (start + np.arange(1, size)) % size
    return np.stack([np.full(size - 2, start), around[:-1], around[1:]], axis=1)


def _flatten_polygon(points: NDArray, normal: NDArray) -> NDArray[np.float64]:
    """(size, 2) as seen along the normal, counterclockwise."""
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    side /= np.linalg.norm(side)
    return np.stack([points @ side, points @ np.cross(normal, side)], axis=1)


def _cut_ears(points: NDArray[np.float64], tests: int) -> tuple[NDArray[np.int64] | None, int]:
    """Cut triangles off a polygon (Meisters 1975): None where that ends too soon; and how many tests are left."""
    left, found = list(range(len(points))), []
    place, strict, failed = 0, True, 0
    while len(left) >= 3:
        if failed > len(left):
            if not strict:
                return None, tests
            strict, failed = False, 0
        tests -= 1 + len(left) // _COSTLY
        if tests < 0:
            return None, tests
        i = place % len(left)
        a, b, c = left[i - 1], left[i], left[(i + 1) % len(left)]
        area = _polygon_cross_product(points[b] - points[a], points[c] - points[a])
        ear = bool(area > _FLAT)
        if ear:
            others = points[left]
            weights = np.stack(
                [_polygon_cross_product(points[q] - points[p], others - points[p]) for p, q in ((a, b), (b, c), (c, a))]
            )
            own = np.any([(np.abs(others - points[p]) <= _FLAT).all(axis=1) for p in (a, b, c)], axis=0)
            ear = not bool(np.any((weights >= -_FLAT if strict else weights > _FLAT).all(axis=0) & ~own))
        if ear:
            found.append((a, b, c))
        if ear or abs(area) <= _FLAT:
            del left[i]
            strict, failed = True, 0
            place = i + 1  # not where it was cut, which makes slivers
        else:
            place, failed = i + 1, failed + 1
    return np.array(found, np.int64).reshape(-1, 3), tests


def _polygon_cross_product(p: NDArray, q: NDArray) -> NDArray[np.float64]:
    product: NDArray[np.float64] = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    return product
