"""A model's file and the files that it names, read under limits and from its own folder alone.

What a file refers to is read here, before any parser sees it: trimesh gets bytes, and has no way to the disk or the
network.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from neuprim.core.errors import DataError, nearest
from neuprim.core.notices import warn_once

__all__ = [
    "MAX_BYTES",
    "MAX_FACES",
    "MAX_PARTS",
    "MAX_TEXELS",
    "MAX_VERTICES",
    "SUFFIXES",
    "Faces",
    "Folder",
    "Material",
    "Model",
    "Up",
    "check_counts",
    "check_vertices",
    "model_file",
]

SUFFIXES = (".glb", ".gltf", ".obj", ".ply", ".stl")

MAX_BYTES = 512 * 2**20
"""Of the file and all that it names together."""

MAX_FACES = 2_000_000
"""Triangles, each use of a part counting."""

MAX_VERTICES = 3 * MAX_FACES

MAX_PARTS = 20_000
"""Pieces with a material or place of their own."""

MAX_TEXELS = 128 * 2**20
"""Pixels of all textures together; one image has at most :data:`neuprim.core.io.exr.MAX_PIXELS`."""

Up = Literal["y", "z"]

_SCHEME = re.compile(r"[A-Za-z][A-Za-z0-9+.\-]*:")


@dataclass(frozen=True)
class Material:
    """How a part of the surface is coloured.

    Attributes:
        colour: (3,) linear RGB that the texture and the vertices' colours are multiplied with; None: the file says
        none. texture: name of the image among :attr:`Model.images`.
        wrap: what happens to texture coordinates beyond 0..1 along u and v: "repeat", "clamp" or "mirror".
        transform: (2, 3) of texture coordinates whose v runs down; None leaves them.
        opacity: what the alpha of the texture and of the vertices is multiplied with.
        cutoff: alpha below which there is a hole; None: alpha means nothing.
        blend: whether the file means alpha as translucency, which is not drawn.
        glow: the light that is emitted, of any strength: its ``colour``, ``texture``, ``wrap`` and ``transform``.
        unlit: whether the colours are emitted instead of reflected.
    """

    colour: tuple[float, float, float] | None = None
    texture: str | None = None
    wrap: tuple[str, str] = ("repeat", "repeat")
    transform: tuple[tuple[float, ...], ...] | None = None
    opacity: float = 1.0
    cutoff: float | None = None
    blend: bool = False
    glow: Material | None = None
    unlit: bool = False


@dataclass(frozen=True)
class Faces:
    """Triangles of one material as a file has them.

    Attributes:
        corners: (F, 3, 3) float64 positions in the file's units and axes.
        material: its name.
        normals: (F, 3, 3) of any length, 0 where there is none; None without.
        colour: (F, 3, 3) or, with alpha, (F, 3, 4), 0..1; None without.
        uv, glow_uv: (F, 3, 2) coordinates in the texture and in that of the light emitted, v upward; None without.
    """

    corners: NDArray[np.float64]
    material: str = ""
    normals: NDArray[np.float64] | None = None
    colour: NDArray[np.float32] | None = None
    uv: NDArray[np.floating] | None = None
    glow_uv: NDArray[np.floating] | None = None


@dataclass(frozen=True)
class Model:
    """What is known of a model before its geometry is parsed.

    Attributes:
        path: for messages.
        kind: the format of ``data``, as trimesh calls it.
        data: what is parsed.
        parts: further bytes that trimesh may ask for, by name.
        materials: name -> material. "" is that of surfaces without one.
        images: name -> encoded bytes of the textures.
        upward: "y" or "z", the axis that points up by the format's custom.
        linear: whether the vertices' colours are linear light, else sRGB.
        digest: of everything that was read, and of what was missing.
    """

    path: Path
    kind: str
    data: bytes
    parts: dict[str, bytes] = field(default_factory=dict)
    materials: dict[str, Material] = field(default_factory=dict)
    images: dict[str, bytes] = field(default_factory=dict)
    upward: Up = "z"
    linear: bool = False
    digest: str = ""


def model_file(path: Path) -> Path:
    """The existing file of ``scene.path``, of a format that is read, ``~`` expanded.

    Raises:
        DataError: there is no such file, or its name ends in something else.
    """
    try:
        file = path.expanduser()
        usable, there = file.is_file(), file.exists()
    except (OSError, RuntimeError) as error:
        raise DataError(f"{path}: {error}; expected a model's file (scene.path)") from None
    if not usable:
        raise DataError(
            f"{file}: {'is no file' if there else 'does not exist'}; expected a model's file (scene.path), {_listed()}"
        )
    if file.suffix.lower() not in SUFFIXES:
        found = f"ends in {file.suffix!r}" if file.suffix else "has no suffix"
        raise DataError(
            f"{file}: {found}; expected {_listed()}" + (nearest(file.suffix, SUFFIXES) if file.suffix else "")
        )
    return file


def _listed() -> str:
    return ", ".join(SUFFIXES[:-1]) + " or " + SUFFIXES[-1]


class Folder:
    """Reads a model's file and the files beside and below it, as long as the budget lasts, and digests all that it
    reads.

    Args:
        file: the model.
        skip_missing: textures and material files that are absent or refused are warned about instead.
    """

    def __init__(self, file: Path, skip_missing: bool = False, budget: int = MAX_BYTES) -> None:
        self.file, self.skip_missing = file, skip_missing
        self._budget, self._hash = budget, hashlib.sha256()
        self._root = file.parent.resolve()

    @property
    def digest(self) -> str:
        return self._hash.hexdigest()

    def own(self) -> bytes:
        """The model's file itself."""
        data = self._read(self.file, self.file.suffix.lower())
        if not data:
            raise DataError(f"{self.file}: file is empty; expected a model, {_listed()}")
        return data

    def required(self, reference: str, what: str) -> bytes:
        """The bytes of what a model cannot do without.

        Raises:
            DataError: the reference leads out of the model's folder or nowhere, or there is too much of it.
        """
        found, fault = self._found(reference, what)
        if found is None:
            raise DataError(fault)
        return found

    def optional(self, references: Sequence[str], what: str) -> bytes | None:
        """The bytes of the first of several spellings of a name that is there; None, with a warning, where
        ``skip_missing`` allows that.

        Raises:
            DataError: as :meth:`required`.
        """
        faults = []
        for reference in references:
            found, fault = self._found(reference, what)
            if found is not None:
                return found
            faults.append(fault)
        if not self.skip_missing:
            raise DataError(f"{faults[0]} (scene.skip_missing=true draws without)")
        self._hash.update(f"missing {references[0]}".encode(errors="replace"))
        warn_once(f"{faults[0]}; drawn without it")
        return None

    def _found(self, reference: str, what: str) -> tuple[bytes | None, str]:
        """The bytes, or None and what is wrong with the reference."""
        shown = reference if len(reference) <= 80 else reference[:77] + "..."
        if reference.startswith("data:"):
            return self._embedded(reference, what), ""
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
        return self._read(target, name), ""

    def _embedded(self, uri: str, what: str) -> bytes:
        head, comma, body = uri.partition(",")
        try:
            if not comma or not head.endswith(";base64"):
                raise ValueError("no base64")
            return base64.b64decode(unquote(body), validate=True)
        except (ValueError, binascii.Error) as error:
            raise DataError(
                f"{self.file}: embedded {what} is damaged ({error}); expected data:...;base64,..."
            ) from None

    def _read(self, path: Path, name: str) -> bytes:
        try:
            with open(path, "rb") as file:
                size = os.fstat(file.fileno()).st_size
                if size > self._budget:
                    more = "" if path == self.file else f" with what it names, up to {path.name},"
                    raise DataError(
                        f"{self.file}: the model{more} is larger than {MAX_BYTES >> 20} MiB; expected a smaller one"
                    )
                data = file.read(size)
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
        self._budget -= len(data)
        self._hash.update(f"{len(name)} {name} {len(data)} ".encode(errors="replace") + data)
        return data


def check_counts(folder: Folder, found: Mapping[str, tuple[int, int]]) -> None:
    """Refuse what a file announces or holds more of than is read: what -> (count, most).

    Raises:
        DataError: naming the first of them.
    """
    for what, (count, most) in found.items():
        if count > most:
            raise DataError(f"{folder.file}: {count} {what}; expected at most {most}")


def check_vertices(path: Path, places: NDArray[np.float64], faces: NDArray[np.integer]) -> None:
    """Refuse faces, of any shape, with vertices that are not among ``places`` (V, 3), or are no finite numbers there.

    Raises:
        DataError: naming the first of them.
    """
    if not faces.size:
        return
    low, high = int(faces.min()), int(faces.max())
    if low < 0 or high >= len(places):
        raise DataError(
            f"{path}: a face has the vertex {high if low >= 0 else low} of {len(places)}; expected one that is there"
        )
    bad = np.flatnonzero(~np.isfinite(places).all(axis=1) & np.isin(np.arange(len(places)), faces))
    if len(bad):
        raise DataError(f"{path}: vertex {bad[0]} is at {places[bad[0]].tolist()}; expected finite numbers")
