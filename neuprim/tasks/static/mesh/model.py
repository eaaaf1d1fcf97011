"""A mesh file with its materials, read together with the files it names: under size limits, from its folder only."""

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
    """Colour of a part of the surface."""

    colour: tuple[float, float, float] | None = (
        None  # linear RGB factor of texture and vertices; None: none in the file
    )
    texture: str | None = None  # key of the image in Model.images
    wrap: tuple[str, str] = ("repeat", "repeat")  # outside 0..1 along u and v: "repeat", "clamp" or "mirror"
    transform: tuple[tuple[float, ...], ...] | None = None  # (2, 3), of coordinates whose v points down
    opacity: float = 1.0  # factor of the alpha of texture and vertices
    cutoff: float | None = None  # alpha below which there is a hole; None where alpha is ignored
    blend: bool = False  # whether the file asks for translucency, which is not drawn
    glow: Material | None = None  # emitted light: its colour, texture, wrap and transform
    unlit: bool = False  # whether colours are emitted instead of reflected


@dataclass(frozen=True)
class Faces:
    """Triangles of one material."""

    corners: NDArray[np.float64]  # (F, 3, 3) positions in the units and axes of the file
    material: str = ""
    normals: NDArray[np.float64] | None = None  # (F, 3, 3) of any length, 0 where the file has none
    colour: NDArray[np.float32] | None = None  # (F, 3, 3) or, with alpha, (F, 3, 4), values 0..1
    uv: NDArray[np.floating] | None = None  # (F, 3, 2) coordinates in the colour texture, v upward
    glow_uv: NDArray[np.floating] | None = None  # (F, 3, 2) in the emission texture


@dataclass(frozen=True)
class Model:
    """A mesh file whose references are read and whose geometry is not parsed yet."""

    path: Path
    read_faces: Callable[[], tuple[list[Faces], int]]  # all triangles, and the number of vertices; raises DataError
    digest: str  # hash of all bytes read and of the names of missing files
    materials: dict[str, Material] = field(default_factory=dict)  # "" is the material of surfaces without one
    images: dict[str, bytes] = field(default_factory=dict)  # name -> encoded bytes of a texture
    upward: Up = "z"  # the axis that points up by the convention of the format
    linear: bool = False  # whether vertex colours are linear light; sRGB otherwise


def find_model_file(path: Path) -> Path:
    """Return the existing mesh file of ``scene.path`` with ``~`` expanded; raises DataError for any other."""
    try:
        file = path.expanduser()
        usable, there = file.is_file(), file.exists()
    except (OSError, RuntimeError) as error:
        raise DataError(f"{path}: {error}; expected a model's file (scene.path)") from None
    if not usable:
        found = "is no file" if there else "does not exist"
        raise DataError(f"{file}: {found}; expected a model's file (scene.path), {_SUFFIX_LIST}")
    if file.suffix.lower() not in SUFFIXES:
        found = f"ends in {file.suffix!r}" if file.suffix else "has no suffix"
        hint = nearest(file.suffix, SUFFIXES) if file.suffix else ""
        raise DataError(f"{file}: {found}; expected {_SUFFIX_LIST}{hint}")
    return file


class MeshFolder:
    """Reads a mesh file and the files below its folder, up to a total size, and hashes all that it reads."""

    def __init__(self, file: Path, skip_missing: bool = False, budget: int = MAX_BYTES) -> None:
        self.file, self.skip_missing = file, skip_missing
        self._budget, self._hash = budget, hashlib.sha256()
        self._root = file.parent.resolve()

    @property
    def digest(self) -> str:
        return self._hash.hexdigest()

    def read_model(self) -> bytes:
        """Read the mesh file itself."""
        data = self._read_within_budget(self.file, self.file.suffix.lower())
        if not data:
            raise DataError(f"{self.file}: file is empty; expected a model, {_SUFFIX_LIST}")
        return data

    def read_required(self, reference: str, what: str) -> bytes:
        """Read a needed file; raises DataError for one that leaves the model's folder, is missing or too large."""
        found, fault = self._resolve_reference(reference, what)
        if found is None:
            raise DataError(fault)
        return found

    def read_optional(self, references: Sequence[str], what: str) -> bytes | None:
        """Read the first existing spelling of a name; None, with a warning, if ``skip_missing`` allows it."""
        faults = []
        for reference in references:
            found, fault = self._resolve_reference(reference, what)
            if found is not None:
                return found
            faults.append(fault)
        if not self.skip_missing:
            raise DataError(f"{faults[0]} (scene.skip_missing=true draws without)")
        self._hash.update(f"missing {references[0]}".encode(errors="replace"))
        warn_once(f"{faults[0]}; drawn without it")
        return None

    def _resolve_reference(self, reference: str, what: str) -> tuple[bytes | None, str]:
        """Return the bytes, or None and the reason why the reference is refused."""
        shown = reference if len(reference) <= 80 else reference[:77] + "..."
        if reference.startswith("data:"):
            return self._decode_data_uri(reference, what), ""
        where = f"{self.file}: {what} {shown!r}"
        name = reference.replace("\\", "/")
        if _SCHEME.match(name) or name.startswith("/"):
            kind = "a place on the network" if "://" in name and not name.startswith("file:") else "an absolute path"
            return None, f"{where} is {kind}, which is not read; expected a file in the model's folder"
        try:
            target = (self._root / name).resolve()
            inside, there = target.is_relative_to(self._root), target.is_file()
        except (OSError, ValueError, RuntimeError):
            return None, f"{where} is no name of a file; expected a file in the model's folder"
        if not inside:
            return None, f"{where} leads out of the model's folder, and is not read; expected a file inside"
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
                    more = "" if path == self.file else f" with what it names, up to {path.name},"
                    found = f"the model{more} is larger than {MAX_BYTES >> 20} MiB"
                    raise DataError(f"{self.file}: {found}; expected a smaller one")
                data = file.read(size)
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
        self._budget -= len(data)
        self._hash.update(f"{len(name)} {name} {len(data)} ".encode(errors="replace") + data)
        return data


def check_mesh_limits(path: Path, counts: Mapping[str, tuple[int, int]]) -> None:
    """Raise DataError for the first count above its limit, given as name -> (count, limit)."""
    for name, (count, limit) in counts.items():
        if count > limit:
            raise DataError(f"{path}: {count} {name}; expected at most {limit} (each use of a part counts)")


def check_vertices(path: Path, positions: NDArray[np.float64], faces: NDArray[np.integer]) -> None:
    """Raise DataError if ``faces`` (any shape) refers to a row of ``positions`` (V, 3) that is missing or infinite."""
    if not faces.size:
        return
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(positions):
        found = f"a face has the vertex {high if low >= 0 else low} of {len(positions)}"
        raise DataError(f"{path}: {found}; expected one that is there")
    bad = np.flatnonzero(~np.isfinite(positions).all(axis=1) & np.isin(np.arange(len(positions)), faces))
    if len(bad):
        raise DataError(f"{path}: vertex {bad[0]} is at {positions[bad[0]].tolist()}; expected finite numbers")
