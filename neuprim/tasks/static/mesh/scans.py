"""PLY, with its vertices' or faces' colours or a texture, and STL, which has none: what their headers claim is held against their bytes."""

from __future__ import annotations

import re

from neuprim.core.errors import DataError
from neuprim.tasks.static.mesh.files import MAX_FACES, MAX_PARTS, MAX_VERTICES, Folder, Material, Model, check_counts

__all__ = ["read_ply", "read_stl"]

_HEADER = 2**16


def read_ply(folder: Folder) -> Model:
    """The model of a .ply file, with the texture that a comment ``TextureFile`` names.

    Raises:
        DataError: too large, no PLY file, or with a texture that leads nowhere.
    """
    data = folder.own()
    end = data.find(b"end_header", 0, _HEADER)
    if not data.startswith(b"ply") or end < 0:
        found = f"starts with {data[:12]!r}" if not data.startswith(b"ply") else f"has no end_header in its first {_HEADER} bytes"
        raise DataError(f"{folder.file}: {found}; expected a PLY file")
    header = data[:end].decode("utf-8", "replace")
    counts = {name: int(count) for name, count in re.findall(r"(?m)^element[ \t]+(\S+)[ \t]+(\d{1,18})\s*$", header)}
    check_counts(folder, {"vertices": (counts.get("vertex", 0), MAX_VERTICES), "faces": (counts.get("face", 0), MAX_FACES)})
    lines = data.count(b"\n", end)
    if re.search(r"(?m)^format[ \t]+ascii", header) and lines > sum(counts.values()) + 1000:
        raise DataError(f"{folder.file}: {lines} lines follow the header; expected {sum(counts.values())}")
    materials: dict[str, Material] = {}
    images: dict[str, bytes] = {}
    texture = re.search(r"(?mi)^comment[ \t]+TextureFile[ \t]+(.+?)\s*$", header)
    if texture:
        image = folder.optional([texture[1]], "texture")
        if image is not None:
            images[texture[1]] = image
            materials[""] = Material((1.0, 1.0, 1.0), texture[1], cutoff=0.5)
    return Model(folder.file, "ply", data, {}, materials, images, "z", False, folder.digest)


def read_stl(folder: Folder) -> Model:
    """The model of an .stl file, which has no colours.

    Raises:
        DataError: too large, or cut off.
    """
    data = folder.own()
    text = data[:5].lower() == b"solid" and b"facet" in data[:_HEADER]
    if text:
        check_counts(folder, {"solids": (data.lower().count(b"endsolid"), MAX_PARTS)})
        count = data.lower().count(b"endfacet")
    else:
        count = int.from_bytes(data[80:84], "little")
        if len(data) != 84 + 50 * count:
            raise DataError(f"{folder.file}: {count} faces announced; expected {84 + 50 * count} bytes for them, found {len(data)}")
    check_counts(folder, {"faces": (count, MAX_FACES)})
    return Model(folder.file, "stl", data, {}, {}, {}, "z", False, folder.digest)
