"""What surfaces look like: triangles with colours, opacity and texture coordinates, and filtered textures."""

from __future__ import annotations

import io
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from neuprim.core.errors import DataError
from neuprim.core.io.exr import MAX_PIXELS
from neuprim.core.io.images import srgb_to_linear
from neuprim.core.notices import warn_once
from neuprim.scenes.shapes import parse_srgb
from neuprim.tasks.static.mesh.model import (
    MAX_FACES,
    MAX_PARTS,
    MAX_TEXELS,
    MAX_VERTICES,
    Faces,
    Material,
    Model,
    check_limits,
)

GREY = parse_srgb("#b4b4b4")  # of what the file says no colour of

_FARTHEST_UV = 1e6  # single precision has no fraction left there; coordinates beyond, or no numbers, are taken for 0


@dataclass(frozen=True)
class SurfacePart:
    """One piece of the surface."""

    corners: NDArray[np.float64]  # (F, 3, 3) positions in the units and axes of the file, finite
    normals: NDArray[np.float64] | None  # (F, 3, 3) of the file, if any
    colour: NDArray[np.float32]  # (F, 3, 3) linear RGB
    uv: NDArray[np.float32] | None  # (F, 3, 2), v upward, if there is a texture
    material: Material  # provides the texture
    bare: bool  # whether the file has no colour for it
    alpha: NDArray[np.float32] | None = None  # (F, 3) 0..1; None for opaque
    glow: SurfacePart | None = None  # emitted light: colour, uv and material of another part


def read_surfaces(model: Model) -> list[SurfacePart]:
    """Parse the geometry of a model and resolve its colours.

    Raises:
        DataError: damaged geometry, no triangles, or more than the limits allow.
    """
    faces, vertices = model.read_faces()
    count = sum(len(part.corners) for part in faces)
    if not count:
        found = f"{vertices} points and no faces" if vertices else "no faces"
        raise DataError(f"{model.path}: has {found}; expected a mesh with triangles")
    parts = (len(faces), MAX_PARTS)
    check_limits(model.path, {"faces": (count, MAX_FACES), "vertices": (vertices, MAX_VERTICES), "parts": parts})
    surfaces = [_make_surface(model, part) for part in faces]
    bare = sum(len(part.colour) for part in surfaces if part.bare)
    if bare:
        warn_once(f"{model.path}: {bare} of {count} faces have no colour; drawn grey")
    return surfaces


def _make_surface(model: Model, faces: Faces) -> SurfacePart:
    material = model.materials.get(faces.material, model.materials.get("", Material()))
    uv = _coordinates(model, faces.uv, material, len(faces.corners))
    shape, own = faces.corners.shape, faces.colour
    bare = own is None and material.colour is None
    colour = np.broadcast_to(GREY if bare else np.array(material.colour or (1.0, 1.0, 1.0), np.float32), shape)
    alpha = np.full(shape[:2], material.opacity, np.float32) if material.opacity < 1 else None
    if own is not None:
        rgb = np.clip(np.nan_to_num(own[..., :3]), 0, 1)
        # exporters of formats other than glTF write some colour of a material beside those of the vertices
        colour = rgb * colour if model.linear else srgb_to_linear(torch.from_numpy(rgb)).numpy()
        if own.shape[2] == 4:
            alpha = (np.float32(material.opacity) * np.clip(np.nan_to_num(own[..., 3]), 0, 1)).astype(np.float32)
    glow = None
    if material.unlit:
        glow, colour = SurfacePart(faces.corners, None, colour, uv, material, False), np.zeros(shape, np.float32)
    elif material.glow is not None:
        light = np.broadcast_to(np.array(material.glow.colour or (0.0, 0.0, 0.0), np.float32), shape)
        places = _coordinates(model, faces.glow_uv, material.glow, len(faces.corners))
        glow = SurfacePart(faces.corners, None, light, places, material.glow, False)
    return SurfacePart(faces.corners, faces.normals, colour, uv, material, bare, alpha, glow)


def _coordinates(
    model: Model, uv: NDArray[np.floating] | None, material: Material, faces: int
) -> NDArray[np.float32] | None:
    """(F, 3, 2) coordinates of the corners in the material's texture; None without."""
    if material.texture is None:
        return None
    if uv is None:
        found = f"texture {material.texture[:80]!r} has no coordinates on a part of {faces} faces"
        warn_once(f"{model.path}: {found}; drawn without it")
        return None
    with np.errstate(all="ignore"):
        moved = _moved(np.asarray(uv, np.float32), material)
    return np.where(np.abs(moved) < _FARTHEST_UV, moved, np.float32(0))


def _moved(uv: NDArray[np.float32], material: Material) -> NDArray[np.float32]:
    """Apply the material's texture transform, which is written for a v that points down."""
    if material.transform is None:
        return uv
    matrix = np.array(material.transform, np.float32)
    down = np.stack([uv[..., 0], 1 - uv[..., 1]], axis=-1) @ matrix[:, :2].T + matrix[:, 2]
    return np.stack([down[..., 0], 1 - down[..., 1]], axis=-1)


FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "TGA", "TIFF")  # what Pillow may decode: others run programs

_LINEAR: NDArray[np.float32] = srgb_to_linear(torch.arange(256) / 255.0).numpy()
_ROWS = 256


class Texture:
    """An image, (H, W, 4) uint8 sRGB with straight alpha, with its copies of half, a quarter, ... of the size."""

    def __init__(self, pixels: NDArray[np.uint8], wrap: tuple[str, str] = ("repeat", "repeat")) -> None:
        self.wrap = wrap
        self.levels: list[NDArray] = [pixels]
        while max(self.levels[-1].shape[:2]) > 1:
            self.levels.append(_halved(self.levels[-1]))

    @property
    def texels(self) -> int:
        return self.levels[0].shape[0] * self.levels[0].shape[1]

    @property
    def alpha(self) -> NDArray:
        return self.levels[0][..., 3]

    def look_up(self, uv: NDArray[np.float32], blur: NDArray[np.float32]) -> NDArray[np.float32]:
        """(M, 4) linear RGB and alpha at (M, 2) ``uv``, v upward from the lower left corner.

        ``blur`` (M,) is the number of texels along an axis that one ray stands for.
        """
        level = np.clip(np.round(np.log2(np.maximum(blur, 1.0))), 0, len(self.levels) - 1).astype(np.intp)
        found = np.empty((len(uv), 4), dtype=np.float32)
        for index in np.unique(level):
            mine = np.flatnonzero(level == index)
            found[mine] = self._bilinear(self.levels[index], uv[mine])
        return found

    def _bilinear(self, image: NDArray, uv: NDArray[np.float32]) -> NDArray[np.float32]:
        height, width = image.shape[:2]
        x, y = uv[:, 0].astype(np.float64) * width - 0.5, (1.0 - uv[:, 1].astype(np.float64)) * height - 0.5
        left, top = np.floor(x), np.floor(y)
        across, down = (x - left).astype(np.float32)[:, None], (y - top).astype(np.float32)[:, None]
        x0, x1 = (_wrapped(left + i, width, self.wrap[0]) for i in (0, 1))
        y0, y1 = (_wrapped(top + i, height, self.wrap[1]) for i in (0, 1))
        upper = (1 - across) * _linear(image[y0, x0]) + across * _linear(image[y0, x1])
        lower = (1 - across) * _linear(image[y1, x0]) + across * _linear(image[y1, x1])
        mixed: NDArray[np.float32] = (1 - down) * upper + down * lower
        return mixed


def _wrapped(index: NDArray[np.float64], size: int, wrap: str) -> NDArray[np.intp]:
    if wrap == "clamp":
        return np.clip(index, 0, size - 1).astype(np.intp)
    if wrap == "mirror":
        folded = np.mod(index, 2 * size)
        return np.minimum(folded, 2 * size - 1 - folded).astype(np.intp)
    return np.minimum(np.mod(index, size), size - 1).astype(np.intp)


def _linear(pixels: NDArray) -> NDArray[np.float32]:
    """(..., 4) float32 linear values of uint8 sRGB ones; floats are linear already."""
    if pixels.dtype != np.uint8:
        return pixels.astype(np.float32)
    values = np.empty(pixels.shape, np.float32)
    values[..., :3] = _LINEAR[pixels[..., :3]]
    values[..., 3] = pixels[..., 3] / np.float32(255)
    return values


def _halved(image: NDArray) -> NDArray[np.float16]:
    """Average 2 x 2 pixels in linear light; the last row or column of an odd size counts twice."""
    height, width = image.shape[:2]
    half = np.empty(((height + 1) // 2, (width + 1) // 2, 4), np.float16)
    for top in range(0, len(half), _ROWS):
        rows = np.minimum(np.arange(2 * top, min(2 * (top + _ROWS), 2 * len(half))), height - 1)
        columns = np.minimum(np.arange(2 * half.shape[1]), width - 1)
        part = _linear(image[rows][:, columns])
        half[top : top + _ROWS] = part.reshape(len(rows) // 2, 2, half.shape[1], 2, 4).mean(axis=(1, 3))
    return half


def decode_texture(path: Path, name: str, data: bytes, left: int = MAX_TEXELS) -> NDArray[np.uint8]:
    """Decode an image to (H, W, 4) uint8, sRGB with straight alpha, of at most ``left`` pixels.

    Raises DataError naming model and image if it is damaged, of another format, or too large.
    """
    where = f"{path}: texture {name[:80]!r}"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=FORMATS) as image:
                size = image.width * image.height
                if size > min(MAX_PIXELS, left):
                    most = f"{MAX_PIXELS}" if size > MAX_PIXELS else f"{MAX_TEXELS} of all textures"
                    raise DataError(f"{where} has {image.width}x{image.height} pixels; at most {most} are accepted")
                if image.mode.startswith("I"):  # 16 bits of grey, which Pillow would cut off at 255
                    grey = (np.asarray(image, np.int64) >> 8).clip(0, 255).astype(np.uint8)
                    return np.array(Image.fromarray(grey).convert("RGBA"))
                return np.array(image.convert("RGBA"))
    except (DataError, MemoryError):
        raise
    except (Image.DecompressionBombError, Image.DecompressionBombWarning):
        raise DataError(f"{where} claims more than {MAX_PIXELS} pixels; expected fewer") from None
    except Exception as error:  # Pillow's decoders raise OSError, SyntaxError, ValueError, struct.error, ...
        reason, expected = " ".join(str(error).split())[:120], f"{', '.join(FORMATS[:-1])} or {FORMATS[-1]}"
        raise DataError(f"{where} cannot be decoded ({reason}); expected {expected}") from None
