"""Small models of other programs' making, for tests: textured, coloured, nested and bare."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image

RED, GREEN, BLUE, YELLOW = (255, 0, 0), (0, 255, 0), (0, 0, 255), (255, 255, 0)


def quarters(size: int = 16, alpha: int | None = None) -> Image.Image:
    """Red and green above, blue and yellow below; with ``alpha``, the red quarter has that one and the others are
    opaque."""
    pixels = np.zeros((size, size, 4 if alpha is not None else 3), np.uint8)
    half = size // 2
    for rows, columns, colour in (
        (slice(0, half), slice(0, half), RED),
        (slice(0, half), slice(half, size), GREEN),
        (slice(half, size), slice(0, half), BLUE),
        (slice(half, size), slice(half, size), YELLOW),
    ):
        pixels[rows, columns, :3] = colour
    if alpha is not None:
        pixels[..., 3] = 255
        pixels[:half, :half, 3] = alpha
    return Image.fromarray(pixels)


def cube() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (24, 3), faces (12, 3) and texture coordinates (24, 2) of [-1, 1]^3, outward, all of the texture on
    every side.

    Seen from +x and +z with y up, the texture is upright.
    """
    vertices, faces, uv = [], [], []
    # of each side: its normal, what is to the right and what is up for whoever looks at it
    sides = [((1, 0, 0), (0, 0, -1), (0, 1, 0)), ((-1, 0, 0), (0, 0, 1), (0, 1, 0)), ((0, 0, 1), (1, 0, 0), (0, 1, 0))]
    sides += [
        ((0, 0, -1), (-1, 0, 0), (0, 1, 0)),
        ((0, 1, 0), (1, 0, 0), (0, 0, -1)),
        ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    ]
    for normal, right, up in sides:
        first = len(vertices)
        for u, v in ((0, 0), (1, 0), (1, 1), (0, 1)):
            vertices.append(np.array(normal) + (2 * u - 1) * np.array(right) + (2 * v - 1) * np.array(up))
            uv.append((u, v))
        faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return np.array(vertices, np.float64), np.array(faces), np.array(uv, np.float64)


def textured(image: Image.Image | None = None, **material: Any) -> trimesh.Trimesh:
    """The cube with a texture."""
    vertices, faces, uv = cube()
    look = trimesh.visual.material.PBRMaterial(baseColorTexture=image or quarters(), **material)
    return trimesh.Trimesh(vertices, faces, visual=trimesh.visual.TextureVisuals(uv=uv, material=look), process=False)


def write_glb(path: Path, *parts: tuple[trimesh.Trimesh, np.ndarray]) -> Path:
    """A .glb of meshes with their places (4, 4); the textured cube alone without any."""
    scene = trimesh.Scene()
    for mesh, place in parts or ((textured(), np.eye(4)),):
        scene.add_geometry(mesh, transform=place)
    path.write_bytes(scene.export(file_type="glb"))
    return path


def write_obj(path: Path, texture: str = "skin.png") -> Path:
    """A square z = 0 with a texture and a triangle behind it without, an .mtl and a .png beside it."""
    path.with_suffix(".mtl").write_text(
        f"newmtl skin\nKd 0 0 0\nmap_Kd -s 1 1 1 {texture}\n\nnewmtl back\nKd 1.0 0.5 0.0\n"
    )
    quarters().save(path.parent / "skin.png")
    path.write_text(
        f"mtllib {path.stem}.mtl\nv -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nv 0 -1 -1\nv 0 1 -1\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl skin\nf 1/1 2/2 3/3 4/4\nusemtl back\nf 1 4 6 5\n"
    )
    return path


def gltf(**changes: Any) -> tuple[dict[str, Any], bytes]:
    """The document of one triangle and its bytes, in the shape of a .gltf file with the buffer ``triangle.bin``."""
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], np.float32)
    data = positions.tobytes() + np.array([0, 1, 2, 0], np.uint16).tobytes()
    document = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5123, "count": 3, "type": "SCALAR"},
        ],
        "bufferViews": [{"buffer": 0, "byteLength": 36}, {"buffer": 0, "byteOffset": 36, "byteLength": 8}],
        "buffers": [{"uri": "triangle.bin", "byteLength": len(data)}],
    }
    return {**document, **changes}, data


def write_gltf(path: Path, **changes: Any) -> Path:
    """The triangle of :func:`gltf` as .gltf, with other values at its top level."""
    document, data = gltf(**changes)
    (path.parent / "triangle.bin").write_bytes(data)
    path.write_text(json.dumps(document))
    return path


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray | None = None) -> Path:
    """Binary, with the colours of vertices."""
    header = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\nproperty float x\nproperty float "
        f"y\nproperty float z\n"
    )
    if colours is not None:
        header += "property uchar red\nproperty uchar green\nproperty uchar blue\n"
    header += f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    with open(path, "wb") as file:
        file.write(header.encode())
        for i, vertex in enumerate(vertices):
            file.write(struct.pack("<3f", *vertex) + (b"" if colours is None else bytes(colours[i].tolist())))
        for face in faces:
            file.write(struct.pack("<B3i", 3, *face))
    return path
