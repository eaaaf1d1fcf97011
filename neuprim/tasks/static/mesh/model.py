"""Data classes for the content of a mesh file, a size-limited file reader, and the triangulation of polygons.

Files that a mesh file refers to, such as textures, are read only from the mesh file's folder. Polygons are triangulated
by triangle fans, or by ear clipping where fans would change the surface. Self-intersecting polygons are refused.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import os
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from neuprim.core.errors import DataError, nearest, warn_once

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")
_SUFFIX_LIST = ", ".join(SUFFIXES[:-1]) + " or " + SUFFIXES[-1]

MAX_BYTES = 512 * 2**20  # of the file and all files it names together
MAX_FACES = 2_000_000  # triangles; each instance of a mesh counts
MAX_VERTICES = 3 * MAX_FACES
MAX_PARTS = 20_000  # pieces with a material or transform of their own
MAX_TEXELS = 128 * 2**20  # of all textures together

Up = Literal["y", "z"]  # the axis of the file that points up

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.\-]*:")


@dataclass(frozen=True)
class Material:
    """Surface material of a mesh: colour, texture, opacity and emission."""

    colour: tuple[float, float, float] | None = (
        None  # linear RGB factor on texture and vertex colours; None if the file has none
    )
    texture: str | None = None  # key of the image in Model.images
    wrap: tuple[str, str] = ("repeat", "repeat")  # outside 0..1 along u and v: "repeat", "clamp" or "mirror"
    transform: tuple[tuple[float, ...], ...] | None = None  # (2, 3) matrix, for texture coordinates whose v points down
    opacity: float = 1.0  # factor on the alpha of texture and vertices
    cutoff: float | None = None  # alpha below which there is a hole; None where alpha is ignored
    blend: bool = False  # whether the file asks for translucency, which is not drawn
    glow: Material | None = None  # emitted light: its colour, texture, wrap and transform
    unlit: bool = False  # whether colours are emitted instead of reflected


@dataclass(frozen=True)
class Faces:
    """Triangles of a mesh that have the same material."""

    corners: NDArray[np.float64]  # (F, 3, 3) positions in the units and axes of the file
    material: str = ""
    normals: NDArray[np.float64] | None = None  # (F, 3, 3) of any length, 0 where the file has none
    colour: NDArray[np.float32] | None = None  # (F, 3, 3) or, with alpha, (F, 3, 4), values 0..1
    uv: NDArray[np.floating] | None = None  # (F, 3, 2) coordinates in the colour texture, v upward
    glow_uv: NDArray[np.floating] | None = None  # (F, 3, 2) in the emission texture


@dataclass(frozen=True)
class Model:
    """A mesh file with its materials and textures in memory. ``read_faces`` parses the geometry later."""

    path: Path
    read_faces: Callable[[], tuple[list[Faces], int]]  # all triangles, and the number of vertices; raises DataError
    digest: str  # hash of all bytes read and of the names of missing files
    materials: dict[str, Material] = field(default_factory=dict)  # "" is the material of surfaces without one
    images: dict[str, bytes] = field(default_factory=dict)  # name -> encoded bytes of a texture
    upward: Up = "z"  # the axis that points up by the convention of the format
    linear: bool = False  # whether vertex colours are linear light; sRGB otherwise


def find_model_file(path: Path) -> Path:
    """Return ``path`` with ``~`` expanded; raise DataError if the file is missing or its suffix is not supported."""
    try:
        file = path.expanduser()
        usable, there = file.is_file(), file.exists()
    except (OSError, RuntimeError) as error:
        raise DataError(f"{path}: {error}; expected a mesh file (scene.path)") from None
    if not usable:
        found = "is not a file" if there else "does not exist"
        raise DataError(f"{file}: {found}; expected a mesh file (scene.path), {_SUFFIX_LIST}")
    if file.suffix.lower() not in SUFFIXES:
        found = f"ends in {file.suffix!r}" if file.suffix else "has no suffix"
        hint = nearest(file.suffix, SUFFIXES) if file.suffix else ""
        raise DataError(f"{file}: {found}; expected {_SUFFIX_LIST}{hint}")
    return file


class MeshFolder:
    """Reader of a mesh file and of other files in or below its folder, with at most ``budget`` bytes in total.

    The property ``digest`` is a hash of all bytes read. With ``skip_missing``, a missing optional file, such as a
    texture, causes a warning instead of an error.
    """

    def __init__(self, file: Path, skip_missing: bool = False, budget: int = MAX_BYTES) -> None:
        self.file, self.skip_missing = file, skip_missing
        self._budget, self._hash = budget, hashlib.sha256()
        self._root = file.parent.resolve()

    @property
    def digest(self) -> str:
        return self._hash.hexdigest()

    def read_model(self) -> bytes:
        """Return the bytes of the mesh file itself; raise DataError if the file is empty."""
        data = self._read_within_budget(self.file, self.file.suffix.lower())
        if not data:
            raise DataError(f"{self.file}: file is empty; expected a mesh, {_SUFFIX_LIST}")
        return data

    def read_required(self, reference: str, what: str) -> bytes:
        """Return the bytes of ``reference``, a file name or data URI in the mesh file; ``what`` is its name in errors.

        Raises DataError if the file is outside the folder, missing or too large.
        """
        found, fault = self._resolve_reference(reference, what)
        if found is None:
            raise DataError(fault)
        return found

    def read_optional(self, references: Sequence[str], what: str) -> bytes | None:
        """Return the bytes of the first of ``references`` that exists.

        If none exists, the result is None with ``skip_missing``; otherwise, the method raises DataError.
        """
        faults = []
        for reference in references:
            found, fault = self._resolve_reference(reference, what)
            if found is not None:
                return found
            faults.append(fault)
        if not self.skip_missing:
            raise DataError(f"{faults[0]} (scene.skip_missing=true draws the mesh without it)")
        self._hash.update(f"missing {references[0]}".encode(errors="replace"))
        warn_once(f"{faults[0]}; drawn without it")
        return None

    def _resolve_reference(self, reference: str, what: str) -> tuple[bytes | None, str]:
        """Return (bytes, "") of the file or data URI ``reference``, or (None, reason) if it is refused or missing."""
        shown = reference if len(reference) <= 80 else reference[:77] + "..."
        if reference.startswith("data:"):
            return self._decode_data_uri(reference, what), ""
        where = f"{self.file}: {what} {shown!r}"
        name = reference.replace("\\", "/")
        if _SCHEME.match(name) or name.startswith("/"):
            kind = "a network address" if "://" in name and not name.startswith("file:") else "an absolute path"
            return None, f"{where} is {kind}, which is refused; expected a file in the model's folder"
        try:
            target = (self._root / name).resolve()
            inside, there = target.is_relative_to(self._root), target.is_file()
        except (OSError, ValueError, RuntimeError):
            return None, f"{where} is not a file name; expected a file in the model's folder"
        if not inside:
            return None, f"{where} is outside of the model's folder; expected a file inside"
        if not there:
            return None, f"{where} not found; expected it in the model's folder"
        return self._read_within_budget(target, name), ""

    def _decode_data_uri(self, uri: str, what: str) -> bytes:
        head, comma, body = uri.partition(",")
        try:
            if not comma or not head.endswith(";base64"):
                raise ValueError("no base64")
            return base64.b64decode(unquote(body), validate=True)
        except (ValueError, binascii.Error) as error:
            found = f"embedded {what} is damaged ({error})"
            raise DataError(f"{self.file}: {found}; expected data:...;base64,...") from None

    def _read_within_budget(self, path: Path, name: str) -> bytes:
        try:
            with open(path, "rb") as file:
                size = os.fstat(file.fileno()).st_size
                if size > self._budget:
                    more = "" if path == self.file else f" with the files that it uses, up to {path.name},"
                    found = f"the model{more} is larger than {MAX_BYTES >> 20} MiB"
                    raise DataError(f"{self.file}: {found}; expected a smaller model")
                data = file.read(size)
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
        self._budget -= len(data)
        self._hash.update(f"{len(name)} {name} {len(data)} ".encode(errors="replace") + data)
        return data


def check_mesh_limits(path: Path, counts: Mapping[str, tuple[int, int]]) -> None:
    """Raise DataError for the first count above its limit; ``counts`` maps a name to (count, limit)."""
    for name, (count, limit) in counts.items():
        if count > limit:
            expected = f"at most {limit} (a part counts once for each use)"
            raise DataError(f"{path}: the mesh has {count} {name}; expected {expected}")


def check_vertices(path: Path, positions: NDArray[np.float64], faces: NDArray[np.integer]) -> None:
    """Raise DataError if an index in ``faces`` is out of range, or its vertex in ``positions`` (V, 3) is not finite."""
    if not faces.size:
        return
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(positions):
        found = f"a face uses vertex {high if low >= 0 else low}"
        raise DataError(f"{path}: {found}, but the file has only {len(positions)} vertices, counted from 0")
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1) & np.isin(np.arange(len(positions)), faces))
    if len(bad):
        raise DataError(f"{path}: vertex {bad[0]} is at {positions[bad[0]].tolist()}; expected finite numbers")


# ---------------------------------------------------------------- polygons

_FANS = 8  # corners tried as the centre of a fan, before ear clipping
_MOST_TESTS = 500_000  # ear tests per model: about 20 seconds
_COSTLY = 500  # per so many remaining corners, an ear test counts as one test more
_FLAT = 1e-10  # twice an area over the squared extent of the polygon, up to which the area counts as zero


def triangulate_polygons(
    path: Path, corners: NDArray[np.float64], sizes: NDArray[np.integer]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Triangulate P polygons; return (T, 3) indices into ``corners``, and the (T,) polygon index of each triangle.

    Triangles are in the order of their polygons. ``corners`` (C, 3) are the finite corners of all polygons,
    concatenated; ``sizes`` (P,) is the number of corners of each polygon. Raises DataError for self-intersecting
    polygons.
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
            points = np.nan_to_num(points / extent)  # 0 / 0 if all corners coincide
            normal = np.cross(points, np.roll(points, -1, axis=1)).sum(axis=1)
            length = np.linalg.norm(normal, axis=1, keepdims=True)
            normal = np.where(length > _FLAT, normal / length, 0.0)
        left = np.arange(len(rows))
        for start in range(min(size, _FANS)):
            fan = _polygon_triangle_fan(size, start)
            a, b, c = (points[left][:, fan[:, i]] for i in range(3))
            across = np.cross(b - a, c - a)
            areas = np.einsum("mtc,mc->mt", across, normal[left])  # twice the areas; negative if reversed
            line = np.linalg.norm(across, axis=2).max(axis=1) <= _FLAT if start == 0 else np.False_
            good = ((areas >= -_FLAT).all(axis=1) & (length[left, 0] > _FLAT)) | line
            # leave out triangles without area, unless the whole polygon is a line
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
            f"{path}: {len(crossed)} of {len(sizes)} faces cross themselves, e.g. {first}; expected simple polygons. "
            "Triangulate the mesh in the program that wrote it"
        )
    owner = np.concatenate(owners)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(found)[order], owner[order]


def _polygon_triangle_fan(size: int, start: int) -> NDArray[np.intp]:
    """Return (size - 2, 3) corner indices: the triangle fan of a ``size``-sided polygon around its corner ``start``."""
    around = (start + np.arange(1, size)) % size
    return np.stack([np.full(size - 2, start), around[:-1], around[1:]], axis=1)


def _flatten_polygon(points: NDArray, normal: NDArray) -> NDArray[np.float64]:
    """Project a polygon's corners (M, 3) along its unit ``normal``; return (M, 2) corners, counterclockwise."""
    side = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    side /= np.linalg.norm(side)
    return np.stack([points @ side, points @ np.cross(normal, side)], axis=1)


def _cut_ears(points: NDArray[np.float64], tests: int) -> tuple[NDArray[np.int64] | None, int]:
    """Triangulate a plane polygon (M, 2) by ear clipping (Meisters 1975).

    Return (T, 3) corner indices, or None on failure, and the remaining number of ``tests``. Every test whether a corner
    can be cut off reduces ``tests`` by one, or by more in large polygons. If ``tests`` falls below zero, the
    triangulation fails.
    """
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
            place = i + 1  # continue behind the cut; cutting there again makes slivers
        else:
            place, failed = i + 1, failed + 1
    return np.array(found, np.int64).reshape(-1, 3), tests


def _polygon_cross_product(p: NDArray, q: NDArray) -> NDArray[np.float64]:
    product: NDArray[np.float64] = p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]
    return product
