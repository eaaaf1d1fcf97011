"""Models of users as scenes: what is seen of them is what their geometry, colours and textures say."""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from neuprim.core.cameras import Camera
from neuprim.core.data import Dataset
from neuprim.core.task import SceneContext
from neuprim.scenes.shading import encode_scene_srgb
from neuprim.tasks.static import mesh as generator
from neuprim.tasks.static.mesh import MeshSettings, generate_mesh_images, load_mesh
from neuprim.tasks.static.mesh.model import MeshFolder
from neuprim.tasks.static.mesh.obj_ply_stl import read_obj
from neuprim.tasks.static.mesh.surface import FARTHEST, MeshSurface, MeshTexture, read_surfaces
from tests.models import BLUE, GREEN, RED, YELLOW, quarters, textured, write_glb, write_obj

SMALL = {"size": 48, "train_views": 4, "test_views": 2, "supersampling": 2}


def read(path: Path, cache: Path, **settings: object) -> Dataset:
    return load_mesh({"path": path, **SMALL, **settings}, SceneContext(seed=0, cache_dir=cache))


def surface(path: Path, upward: str | None = None) -> MeshSurface:
    """The model as rays meet it, sharp."""
    model = generator.MODEL_READERS[path.suffix](MeshFolder(path))
    return MeshSurface(model, read_surfaces(model), upward or model.upward, 1e-6)


def colours(scene: MeshSurface, points: list[list[float]], directions: list[list[float]]) -> np.ndarray:
    """(N, 3) display colours 0..255 of what rays meet; every ray must meet something."""
    hits = scene.intersect(np.array(points, np.float32), np.array(directions, np.float32))
    assert hits.hit.all()
    return np.round(encode_scene_srgb(hits.albedo) * 255).astype(int)


def pixel(camera: Camera, point: list[float]) -> tuple[int, int]:
    """Row and column of a point of the scene."""
    p = camera.viewmat[:3, :3] @ torch.tensor(point, dtype=torch.float64) + camera.viewmat[:3, 3]
    assert p[2] > 0
    return int(camera.fy * p[1] / p[2] + camera.cy), int(camera.fx * p[0] / p[2] + camera.cx)


def test_a_textured_cube_shows_its_quarters_where_geometry_says(tmp_path: Path) -> None:
    """glTF's y is the scene's z, its x stays, its z comes forward as -y: the +z side is the one at y = -s."""
    dataset = read(write_glb(tmp_path / "cube.glb"), tmp_path, size=96, shading="flat", train_views=12)
    s = FARTHEST / math.sqrt(3)
    h = s / 2
    spots = {RED: [-h, -s, h], GREEN: [h, -s, h], BLUE: [-h, -s, -h], YELLOW: [h, -s, -h]}
    seen = 0
    for index in range(12):
        view, pixels = dataset.train.view(index), dataset.train.pixels(index)
        eye = view.camera.position
        if eye[1] > -2:  # does not look at that side
            continue
        seen += 1
        for colour, spot in spots.items():
            row, column = pixel(view.camera, spot)
            assert pixels.alpha is not None and pixels.alpha[row, column] == 1
            np.testing.assert_array_equal(torch.round(pixels.rgb[row, column] * 255).int().numpy(), colour)
        assert pixels.alpha is not None and not pixels.alpha[0].any() and not pixels.alpha[:, 0].any()
    assert seen >= 3


def test_the_back_of_a_surface_is_lit_and_coloured_as_its_front(tmp_path: Path) -> None:
    scene = surface(write_obj(tmp_path / "square.obj"), "z")
    for height, down in ((3.0, -1.0), (-3.0, 1.0)):
        at, towards = [[0.5, -0.5, height]], [[0, 0, down]]
        np.testing.assert_array_equal(colours(scene, at, towards), [YELLOW])
        hits = scene.intersect(at, towards)
        np.testing.assert_allclose(hits.face, [[0, 0, -down]], atol=1e-6)
        np.testing.assert_allclose(hits.normal, [[0, 0, -down]], atol=1e-6)


@pytest.mark.parametrize(
    ("options", "name"),
    [
        ("", "two words.png"),
        ("-clamp on -o 0.5 0.5 ", "a.png"),
        ("-bm 2 -s 1 1 1 ", "sub\\a b.png"),
        ("-o 1 ", "12.png"),
    ],
)
def test_names_of_textures_in_libraries(tmp_path: Path, options: str, name: str) -> None:
    (tmp_path / "sub").mkdir()
    quarters().save(tmp_path / name.replace("\\", "/"))
    (tmp_path / "m.mtl").write_text(f"newmtl m\nmap_Kd {options}{name}\n")
    (tmp_path / "m.obj").write_text("mtllib m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl m\nf 1 2 3\n")
    model = read_obj(MeshFolder(tmp_path / "m.obj"))
    assert list(model.images) == [name] and model.materials["m"].texture == name


def test_the_texture_that_a_ply_names(tmp_path: Path) -> None:
    quarters().save(tmp_path / "skin.png")
    (tmp_path / "square.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile skin.png\nelement vertex 4\n"
        "property float x\nproperty float y\nproperty float z\n"
        "property float s\nproperty float t\nelement face 2\nproperty list uchar int vertex_indices\nend_header\n"
        "-1 -1 0 0 0\n1 -1 0 1 0\n1 1 0 1 1\n-1 1 0 0 1\n3 0 1 2\n3 0 2 3\n"
    )
    found = colours(surface(tmp_path / "square.ply"), [[-0.5, 0.5, 3], [0.5, -0.5, 3]], [[0, 0, -1.0]] * 2)
    np.testing.assert_array_equal(found, [RED, YELLOW])


@pytest.mark.parametrize(
    ("mode", "alpha", "hole"), [("OPAQUE", 0, False), ("MASK", 100, True), ("MASK", 200, False), ("BLEND", 100, True)]
)
def test_where_the_texture_is_clear_there_is_a_hole(tmp_path: Path, mode: str, alpha: int, hole: bool) -> None:
    """Seen through the red quarter of the front there is the back, mirrored: its green quarter; and the light comes
    through."""
    more = {"alphaCutoff": 0.6} if mode == "MASK" else {}
    scene = surface(
        write_glb(tmp_path / "cube.glb", (textured(quarters(alpha=alpha), alphaMode=mode, **more), np.eye(4)))
    )
    s = FARTHEST / math.sqrt(3)
    at, towards = np.array([[-s / 2, -3.0, s / 2]], np.float32), np.array([[0.0, 2.0, 0.0]], np.float32)
    hits = scene.intersect(at, towards)
    np.testing.assert_allclose(hits.distance, [(3 + s) / 2 if hole else (3 - s) / 2], atol=1e-5)
    np.testing.assert_allclose(hits.position, [[-s / 2, s if hole else -s, s / 2]], atol=1e-5)
    assert encode_scene_srgb(hits.albedo).round(3).tolist() == ([[0, 1, 0]] if hole else [[1, 0, 0]])
    assert scene.occluded(at, towards, 1.4).tolist() == [not hole] and scene.occluded(at, towards).all()


def test_texels_are_mixed_in_linear_light_about_their_middles() -> None:
    pixels = np.array([[[0, 0, 0, 255], [255, 255, 255, 255]]], np.uint8)
    texture = MeshTexture(pixels, ("clamp", "clamp"))
    sharp = np.zeros(3, np.float32)
    found = texture.look_up(np.array([[0.25, 0.5], [0.5, 0.5], [0.75, 0.5]], np.float32), sharp)
    np.testing.assert_allclose(found[:, 0], [0, 0.5, 1], atol=1e-6)
    np.testing.assert_allclose(texture.look_up(np.array([[0.0, 0.5]], np.float32), sharp[:1])[0, 0], 0)
    np.testing.assert_allclose(
        MeshTexture(pixels).look_up(np.array([[0.0, 0.5]], np.float32), sharp[:1])[0, 0], 0.5
    )  # wraps around


def test_a_ray_that_covers_many_texels_sees_their_mean() -> None:
    pixels = np.zeros((33, 64, 4), np.uint8)
    pixels[:, ::2] = 255
    texture = MeshTexture(pixels)
    uv = np.random.default_rng(1).random((50, 2)).astype(np.float32)
    assert np.ptp(texture.look_up(uv, np.zeros(50, np.float32))[:, 0]) > 0.5
    np.testing.assert_allclose(texture.look_up(uv, np.full(50, 16, np.float32)), 0.5, atol=1e-3)
    assert texture.levels[-1].shape[:2] == (1, 1)


@pytest.mark.parametrize("case", [".glb auto y", ".obj auto y", ".ply auto z", ".stl auto z", ".ply y y", ".glb z z"])
def test_it_stands_upright_in_the_box_and_can_be_put_back(tmp_path: Path, case: str) -> None:
    """A thin pole of height 60 along ``expected``, far from the origin."""
    suffix, up, expected = case.split()
    size = [2.0, 2, 60] if expected == "z" else [2.0, 60, 2]
    pole = trimesh.creation.box(size)
    pole.apply_translation([100, 200, 300])
    path = tmp_path / f"pole{suffix}"
    data = pole.export(file_type=suffix[1:])
    path.write_bytes(data.encode() if isinstance(data, str) else data)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # no colours
        folder = generate_mesh_images(MeshSettings(path=path, up=up, **SMALL), tmp_path / "cache")
    matrix = np.array(json.loads((folder / "transforms_test.json").read_text())["scene_from_file"])
    corners = np.c_[pole.vertices, np.ones(8)] @ matrix.T
    np.testing.assert_allclose(np.abs(corners[:, :3]), np.broadcast_to([1 / 30, 1 / 30, 1], (8, 3)), atol=1e-12)
    assert np.linalg.det(matrix[:3, :3]) > 0
    np.testing.assert_allclose((corners @ np.linalg.inv(matrix).T)[:, :3], pole.vertices)
    image = np.asarray(Image.open(folder / "train" / "r_0.png"))
    rows, columns = np.nonzero(image[..., 3])
    assert np.ptp(rows) > 5 * np.ptp(columns)


def test_normals_of_the_file_are_used_and_others_follow_from_the_angles(tmp_path: Path) -> None:
    """A ball of few faces is smooth with its normals, and has facets without."""
    rough = trimesh.creation.icosahedron()
    towards = -np.einsum("fkc,k->fc", rough.triangles, [0.6, 0.2, 0.2])
    for named, smooth in (("with", True), ("without", False)):
        text = "".join(f"v {x} {y} {z}\n" for x, y, z in rough.vertices.tolist())
        text += "".join(f"vn {x} {y} {z}\n" for x, y, z in rough.vertices.tolist())
        text += "".join(
            "f " + " ".join(f"{i + 1}//{i + 1}" if smooth else f"{i + 1}" for i in face) + "\n"
            for face in rough.faces.tolist()
        )
        (tmp_path / f"{named}.obj").write_text(text)
        scene = surface(tmp_path / f"{named}.obj", "z")
        hits = scene.intersect(-3 * towards, towards)
        turned = np.degrees(np.arccos(np.clip((hits.normal * hits.face).sum(1), -1, 1)))
        assert hits.hit.all() and (turned > 10 if smooth else turned < 0.1).all()


def test_images_are_kept_by_contents_and_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, cache = write_obj(tmp_path / "square.obj"), tmp_path / "cache"
    settings = MeshSettings(path=path, **SMALL)
    first = generate_mesh_images(settings, cache)
    monkeypatch.setattr(generator, "read_surfaces", None)  # a second time nothing is parsed
    assert generate_mesh_images(settings, cache) == first
    monkeypatch.undo()
    (tmp_path / "copy").mkdir()
    for file in (path, path.with_suffix(".mtl"), tmp_path / "skin.png"):
        (tmp_path / "copy" / file.name).write_bytes(file.read_bytes())
    assert (
        generate_mesh_images(MeshSettings(path=tmp_path / "copy" / "square.obj", **SMALL), cache) == first
    )  # wherever it lies
    folders = {first}
    changes = {"size": 40, "train_views": 3, "test_views": 1, "supersampling": 1, "up": "z", "shading": "flat"}
    for name, value in changes.items():
        folders.add(generate_mesh_images(MeshSettings(**{"path": path, **SMALL, name: value}), cache))
    quarters(alpha=255).save(tmp_path / "skin.png")
    folders.add(generate_mesh_images(settings, cache))
    path.with_suffix(".mtl").write_text("newmtl skin\nKd 1 1 1\nnewmtl back\n")
    folders.add(generate_mesh_images(settings, cache))
    assert len(folders) == 9 == len(list(cache.iterdir()))
