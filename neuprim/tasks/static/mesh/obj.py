"""Wavefront OBJ with its material libraries (.mtl).

Of a library, colours (``Kd``) and their textures (``map_Kd``) are read; both are taken for sRGB, and a texture stands in the place of
the colour, as many exporters write a colour of 0 beside it.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import PurePosixPath

import torch

from neuprim.core.errors import DataError
from neuprim.core.io.images import srgb_to_linear
from neuprim.tasks.static.mesh.files import MAX_FACES, MAX_PARTS, MAX_VERTICES, Folder, Material, Model, check_counts

__all__ = ["read_obj"]

_NUMBERS = {"-mm": 2, "-o": 3, "-s": 3, "-t": 3}
"""Options of a texture that are followed by this many numbers, at most."""

_WORDS = {"-blendu", "-blendv", "-bm", "-boost", "-cc", "-clamp", "-imfchan", "-texres", "-type"}
"""Options that are followed by one word."""


def read_obj(folder: Folder) -> Model:
    """The model of an .obj file.

    Raises:
        DataError: too large, or with references that lead nowhere.
    """
    data = folder.own().decode("utf-8", "replace").encode()  # names of materials are compared with the library's, decoded alike
    found = {"vertices": (data.count(b"\nv "), MAX_VERTICES), "faces": (data.count(b"\nf "), MAX_FACES)}
    check_counts(folder, {**found, "changes of material": (data.count(b"usemtl "), MAX_PARTS)})
    materials: dict[str, Material] = {}
    images: dict[str, bytes] = {}
    wanted = re.findall(rb"(?m)^\s*mtllib[ \t]+(.+?)\s*$", data)
    for library in dict.fromkeys(name.decode("utf-8", "replace") for name in wanted):
        text = folder.optional([library, PurePosixPath(library.replace("\\", "/")).name], "material file")
        if text is not None:
            materials |= _library(text.decode("utf-8", "replace"), folder, images)
    names = "\n".join(f"newmtl {name}" for name in materials).encode()
    return Model(folder.file, "obj", data, {"": names}, materials, images, "y", False, folder.digest)


def _library(text: str, folder: Folder, images: dict[str, bytes]) -> dict[str, Material]:
    found: dict[str, Material] = {}
    name = ""
    for line in text.splitlines():
        key, _, rest = line.strip().partition(" ")
        words = rest.split()
        if key == "newmtl":
            name = " ".join(words)
            found[name] = Material()
        elif key.lower() == "kd" and name in found and len(words) >= 3:
            found[name] = replace(found[name], colour=_colour(words, folder, name))
        elif key.lower() == "map_kd" and name in found and words:
            image = _file_name(words, rest)
            spellings = [image, PurePosixPath(image.replace("\\", "/")).name]
            if image not in images:
                data = folder.optional(spellings[:1] if spellings[0] == spellings[1] else spellings, "texture")
                if data is None:
                    continue
                images[image] = data
            found[name] = replace(found[name], texture=image, cutoff=0.5)
    return {name: replace(m, colour=(1.0, 1.0, 1.0)) if m.texture is not None else m for name, m in found.items()}


def _file_name(words: list[str], rest: str) -> str:
    """A texture's name without the options before it; it may hold blanks."""
    place, last = 0, len(words) - 1
    while place < last and words[place] in {*_NUMBERS, *_WORDS}:
        numbers, place = _NUMBERS.get(words[place], 0), place + (words[place] in _WORDS) + 1
        while numbers and place < last and _number(words[place]):
            numbers, place = numbers - 1, place + 1
    return rest.strip() if place == 0 else " ".join(words[place:])


def _number(word: str) -> bool:
    return re.fullmatch(r"[-+0-9.eE]+", word) is not None


def _colour(words: list[str], folder: Folder, name: str) -> tuple[float, float, float]:
    try:
        values = torch.tensor([float(word) for word in words[:3]])
        if not values.isfinite().all():
            raise ValueError
    except ValueError:
        raise DataError(f"{folder.file}: material {name[:40]!r} has the colour {' '.join(words)[:40]!r}; expected three numbers") from None
    r, g, b = srgb_to_linear(values.clamp(0, 1)).tolist()
    return r, g, b
