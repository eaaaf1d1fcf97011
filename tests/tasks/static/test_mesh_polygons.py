"""Polygons as triangles: the area is the polygon's own, whatever its shape, or it is refused with a count."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest

from neuprim.core.errors import DataError
from neuprim.tasks.static import mesh as generator
from neuprim.tasks.static.mesh import model as polygons
from neuprim.tasks.static.mesh.model import MeshFolder, triangulate_polygons
from neuprim.tasks.static.mesh.surface import read_surfaces

U = [(3, 3), (2, 3), (2, 1), (1, 1), (1, 3), (0, 3), (0, 0), (3, 0)]
ANGLES = 2 * np.pi * np.arange(12) / 12
STAR = (np.stack([np.cos(ANGLES), np.sin(ANGLES)], 1) * np.where(np.arange(12) % 2, 1, 0.2)[:, None]).tolist()
COMB = [(0, 0), (10, 0), *(spot for i in range(10) for spot in ((10 - i, 3), (9.5 - i, 1))), (0, 3)]
SIMPLE = {
    "u": U,
    "dart": [(0, 0), (2, 1), (0, 2), (0.5, 1)],
    "turned dart": [(2, 1), (0, 2), (0.5, 1), (0, 0)],
    "star": STAR,
    "comb": COMB,
    "with a hole": [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)],
    "touching itself": [(0, 0), (2, 2), (4, 0), (4, 4), (2, 2), (0, 4)],
    "with corners on edges": [(0, 0), (1, 0), (2, 0), (2, 1), (2, 2), (1, 2), (0, 2), (0, 1)],
    "with a corner twice": [(0, 0), (1, 0), (1, 0), (1, 1), (0.2, 0.4)],
}
PATH = Path("a.obj")


def area(corners: np.ndarray) -> float:
    """Of triangles (T, 3, 3)."""
    return float(
        np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    )


def own_area(polygon: np.ndarray) -> float:
    around = polygon - polygon[0]
    return float(np.linalg.norm(np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)) / 2)


@pytest.mark.parametrize("name", SIMPLE)
def test_a_simple_polygon_is_covered_once(name: str) -> None:
    """From either side, turned, small, large and far from the origin: what is drawn is inside, and its area is the
    polygon's."""
    flat = np.pad(np.array(SIMPLE[name], np.float64), ((0, 0), (0, 1)))
    turned = flat @ np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    for polygon in (flat, flat[::-1], np.roll(flat, 3, axis=0), turned, 1e-6 * flat, 1e9 * turned, turned + 1e5):
        triangles, owner = triangulate_polygons(PATH, np.ascontiguousarray(polygon), np.array([len(polygon)]))
        assert area(polygon[triangles]) == pytest.approx(own_area(polygon), rel=1e-9) and not owner.any()


def test_what_is_bent_is_covered_and_what_has_no_area_is_left_to_be_counted() -> None:
    bent = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0.3], [1, 1, 0], [1, 2, 0.2], [0, 2, 0]])
    triangles, _ = triangulate_polygons(PATH, bent, np.array([6]))
    assert 3 < area(bent[triangles]) < 3.3 and len(triangles) == 4
    line = np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2], [3, 3, 3], [0, 0, 0], [0, 0, 0]])
    triangles, owner = triangulate_polygons(PATH, line, np.array([4, 2]))
    assert len(triangles) == 2 and area(line[triangles]) < 1e-12 and owner.tolist() == [0, 0]


def test_polygons_that_cross_themselves_are_refused_with_a_count(monkeypatch: pytest.MonkeyPatch) -> None:
    bow, uneven = [(0, 0), (1, 1), (1, 0), (0, 1)], [(0, 0), (3, 3), (3, 0), (0, 1)]
    corners = np.pad(np.array([*U, *bow, *uneven], np.float64), ((0, 0), (0, 1)))
    with pytest.raises(
        DataError, match=r"a\.obj: 2 of 3 faces cross themselves, e.g. face 1 of 4 corners; expected simple polygons"
    ):
        triangulate_polygons(PATH, corners, np.array([8, 4, 4]))
    monkeypatch.setattr(polygons, "_MOST_TESTS", 5)
    with pytest.raises(DataError, match="1 of 1 faces"):  # no file takes more than some seconds
        triangulate_polygons(PATH, np.pad(np.array(COMB, np.float64), ((0, 0), (0, 1))), np.array([len(COMB)]))


def prism(relative: bool, texture: bool) -> str:
    """An .obj of the U, three high, with caps of eight corners; its area is 2 * 7 + 3 * 16."""
    lines, count = [], 0
    for z in (0, 3):
        lines += [f"v {x} {y} {z}" for x, y in U] + [f"vt {x / 3} {y / 3}" for x, y in U] * texture
        count += 8
        faces = [list(range(z // 3 * 8 + 8, z // 3 * 8, -1))]
        faces += [[i + 1, (i + 1) % 8 + 1, (i + 1) % 8 + 9, i + 9] for i in range(8)] if z else []
        for face in faces:  # relative ones count from what has been said so far
            words = [i - count - 1 if relative else i for i in face]
            lines.append("f " + " ".join(f"{i}/{i}" if texture else f"{i}" for i in words))
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize("texture", [False, True])
@pytest.mark.parametrize("relative", [False, True])
def test_an_obj_with_concave_faces_and_relative_indices(tmp_path: Path, relative: bool, texture: bool) -> None:
    text = prism(relative, texture).replace("f ", "f \\\n ", 1).replace("v 0 0 3", "v 0 0 3 # a corner")
    (tmp_path / "a.obj").write_text(text.replace("\n", "\r\n") if relative else text)
    parts = read_surfaces(generator.MODEL_READERS[".obj"](MeshFolder(tmp_path / "a.obj")))
    assert sum(area(part.corners) for part in parts) == pytest.approx(2 * 7 + 3 * 16)


@pytest.mark.parametrize("order", ["<", ">", ""])
@pytest.mark.parametrize("mixed", [False, True])
def test_a_ply_with_concave_faces(tmp_path: Path, order: str, mixed: bool) -> None:
    """Faces of one size, and of several, each with a colour that its triangles have."""
    faces = [list(range(8)), *([[0, 1, 2], [4, 5, 6, 7]] if mixed else [])]
    kind = {"<": "binary_little_endian", ">": "binary_big_endian", "": "ascii"}[order]
    head = (
        f"ply\nformat {kind} 1.0\nelement vertex 8\nproperty double x\nproperty double y\nproperty float "
        f"z\nelement face {len(faces)}\n"
    )
    head += (
        "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty list uchar ushort "
        "vertex_index\nend_header\n"
    )
    if order:
        body = b"".join(struct.pack(f"{order}ddf", x, y, 0) for x, y in U)
        body += b"".join(struct.pack(f"{order}4B{len(f)}H", 255, 0, 51 * i, len(f), *f) for i, f in enumerate(faces))
    else:
        body = "".join(f"{x} {y} 0\n" for x, y in U).encode()
        body += "".join(f"255 0 {51 * i} {len(f)} {' '.join(map(str, f))}\n" for i, f in enumerate(faces)).encode()
    (tmp_path / "a.ply").write_bytes(head.encode() + body)
    (part,) = read_surfaces(generator.MODEL_READERS[".ply"](MeshFolder(tmp_path / "a.ply")))
    first = part.colour[:, 0, 2] == 0
    assert area(part.corners[first]) == pytest.approx(7) and (part.colour[..., 0] == 1).all()
    if mixed:
        blue = part.colour[~first][:, 0, 2]
        assert area(part.corners[~first]) == pytest.approx(1 + 6) and len(np.unique(blue)) == 2
