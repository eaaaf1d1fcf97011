"""Models of users as files: whatever is wrong with one is one clear line, and nothing outside its folder is read."""

from __future__ import annotations

import base64
import io
import json
import struct
import tracemalloc
import warnings
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from PIL import Image

from neuprim.core import errors
from neuprim.core.errors import DataError, NeuprimWarning
from neuprim.tasks.static.mesh import MeshSettings, generate_mesh_images
from neuprim.tasks.static.mesh import gltf as gltf_reader
from neuprim.tasks.static.mesh import surface as materials
from tests.models import cube, gltf, quarters, write_gltf, write_obj, write_ply

SMALL: dict[str, Any] = {"size": 16, "train_views": 1, "test_views": 1, "supersampling": 1}


@pytest.fixture(autouse=True)
def every_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(errors, "_said", set())


def refusal(path: Path, **settings: Any) -> str:
    """The error's one line, which names the file."""
    cache = path.parent / "cache"
    before = sorted(cache.iterdir()) if cache.exists() else []
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NeuprimWarning)
        with pytest.raises(DataError) as caught:
            generate_mesh_images(MeshSettings(path=path, **SMALL, **settings), cache)
    text = str(caught.value)
    assert "\n" not in text and path.name in text and len(text) < 500, text
    assert (sorted(cache.iterdir()) if cache.exists() else []) == before
    return text


def notes(path: Path, **settings: Any) -> list[str]:
    """What is said while the model is drawn."""
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        generate_mesh_images(MeshSettings(path=path, **SMALL, **settings), path.parent / "cache")
    return [str(warning.message) for warning in caught if issubclass(warning.category, NeuprimWarning)]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_vertices_that_are_no_numbers(tmp_path: Path, value: float) -> None:
    vertices, faces, _ = cube()
    vertices[5, 1] = value
    assert "vertex 5 is at [" in refusal(write_ply(tmp_path / "a.ply", vertices, faces))
    unused = np.concatenate([cube()[0], [[value, 0, 0]]])
    assert all("no colour" in note for note in notes(write_ply(tmp_path / "b.ply", unused, faces)))


@pytest.mark.parametrize(
    ("where", "text"),
    [(-1, "a face uses vertex -1, but the file has only 24"), (24, "a face uses vertex 24, but the file has only 24")],
)
def test_faces_of_vertices_that_are_not_there(tmp_path: Path, where: int, text: str) -> None:
    vertices, faces, _ = cube()
    faces[3, 1] = where
    assert text in refusal(write_ply(tmp_path / "a.ply", vertices, faces))


def test_sizes_from_atoms_to_galaxies(tmp_path: Path) -> None:
    for i, scale in enumerate((1e-30, 1e30)):
        vertices, faces, _ = cube()
        assert len(notes(write_ply(tmp_path / f"{i}.ply", scale * vertices, faces))) == 1  # no colours
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1e308 0 0\nv 0 -1e308 0\nf 1 2 3\n")
    assert "a single point or too large" in refusal(tmp_path / "a.obj")


def test_a_header_that_says_a_billion_takes_no_memory(tmp_path: Path) -> None:
    billion = 10**9
    head = "ply\nformat {} 1.0\nelement vertex {}\nproperty float x\nproperty float y\nproperty float z\n"
    head += "element face {}\nproperty list uchar int vertex_indices\nend_header\n"
    (tmp_path / "a.ply").write_text(head.format("ascii", billion, 1))
    (tmp_path / "b.ply").write_text(head.format("binary_little_endian", 3, billion))
    (tmp_path / "c.ply").write_text(
        head.format("binary_little_endian", 5 * 10**6, 10**6)
    )  # within the limits, but not there
    (tmp_path / "d.stl").write_bytes(bytes(80) + struct.pack("<I", billion) + bytes(500))
    document, _ = gltf()
    claims = [{**a, "count": billion} for a in document["accessors"]]
    write_gltf(tmp_path / "e.gltf", accessors=claims)
    bare = [{k: v for k, v in a.items() if k != "bufferView"} for a in claims]
    write_gltf(tmp_path / "f.gltf", accessors=bare)
    write_gltf(tmp_path / "g.gltf", buffers=[{"uri": "triangle.bin", "byteLength": billion}])
    (tmp_path / "h.glb").write_bytes(struct.pack("<5I", 0x46546C67, 2, 2**32 - 1, 2**32 - 100, 0x4E4F534A) + b"{}  ")
    expected = {
        "a.ply": "1000000000 vertices; expected at most 6000000",
        "b.ply": "1000000000 faces; expected at most 2000000",
        "c.ply": "expected a complete file",
        "d.stl": "the header states 1000000000 faces; expected 50000000084 bytes for them, but the file has 584",
        "e.gltf": "bytes, but its view has 36",
        "f.gltf": "accessors[0] is sparse or compressed",
        "g.gltf": "buffers[0] has 44 bytes, but its byteLength is 1000000000",
        "h.glb": "the file has 24 bytes, but its header states 4294967295",
    }
    tracemalloc.start()
    for name, text in expected.items():
        assert text in refusal(tmp_path / name)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50 * 2**20


def test_every_use_of_a_part_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_gltf(tmp_path / "a.gltf", nodes=[{"mesh": 0}] * 50, scenes=[{"nodes": list(range(50))}])
    monkeypatch.setattr(gltf_reader, "MAX_FACES", 49)
    assert "50 faces; expected at most 49" in refusal(path)


@pytest.mark.parametrize(
    ("limit", "text"),
    [("MAX_VERTICES", "24 vertices; expected at most 11"), ("MAX_FACES", "12 faces; expected at most 11")],
)
@pytest.mark.parametrize("suffix", [".glb", ".ply", ".stl", ".obj"])
def test_more_than_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str, limit: str, text: str) -> None:
    path = tmp_path / f"a{suffix}"
    if suffix == ".ply":
        write_ply(path, *cube()[:2])
    else:
        data = trimesh.Scene(trimesh.Trimesh(*cube()[:2], process=False)).export(file_type=suffix[1:])
        path.write_bytes(data.encode() if isinstance(data, str) else data)
    for module in ("gltf", "obj_ply_stl", "surface"):
        monkeypatch.setattr(f"neuprim.tasks.static.mesh.{module}.{limit}", 11)
    found = refusal(path)
    assert text in found or (suffix == ".stl" and "36 vertices; expected at most 11" in found)


def test_nodes_in_circles_and_nested_without_end(tmp_path: Path) -> None:
    circle = write_gltf(tmp_path / "a.gltf", nodes=[{"children": [1]}, {"children": [0], "mesh": 0}])
    assert "a node is its own ancestor or has two parents" in refusal(circle)
    shared = write_gltf(tmp_path / "b.gltf", nodes=[{"children": [1, 2]}, {"children": [2]}, {"mesh": 0}])
    assert "a node is its own ancestor or has two parents" in refusal(shared)
    chain = [{"children": [i + 1]} for i in range(300)] + [{"mesh": 0}]
    assert "nested deeper than 200" in refusal(write_gltf(tmp_path / "c.gltf", nodes=chain))
    many = write_gltf(tmp_path / "d.gltf", nodes=[{}] * 20_001)
    assert "20001 nodes; expected at most 20000" in refusal(many)
    (tmp_path / "e.gltf").write_text('{"asset": ' + "[" * 100_000)
    assert "damaged glTF" in refusal(tmp_path / "e.gltf")


def test_textures_of_floats_are_refused(tmp_path: Path) -> None:
    data = io.BytesIO()
    Image.fromarray(np.full((2, 2), 0.5, np.float32)).save(data, "TIFF")
    with pytest.raises(DataError, match=r"a\.obj: texture 't\.tif' has float pixels; expected 8 or 16 bits"):
        materials.decode_texture(tmp_path / "a.obj", "t.tif", data.getvalue())


def test_textures_are_bounded_before_they_are_decoded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_obj(tmp_path / "a.obj")
    monkeypatch.setattr(materials, "MAX_PIXELS", 16 * 16 - 1)
    assert "texture 'skin.png' has 16x16 pixels; at most 255 are accepted" in refusal(path)
    monkeypatch.undo()
    header = struct.pack(">4sIIBBBBB", b"IHDR", 60_000, 60_000, 8, 2, 0, 0, 0)
    data = zlib.compress(bytes(100))
    chunk = struct.pack(">I4s", len(data), b"IDAT") + data + struct.pack(">I", zlib.crc32(b"IDAT" + data))
    (tmp_path / "skin.png").write_bytes(
        b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header)) + chunk
    )
    assert "texture 'skin.png' claims more than 67108864 pixels" in refusal(path)


@pytest.fixture
def secret(tmp_path: Path) -> Path:
    """A folder for a model, below one with an image that is not its own."""
    quarters().save(tmp_path / "secret.png")
    (tmp_path / "model" / "sub").mkdir(parents=True)
    return tmp_path / "model"


OUTSIDE = {
    "../secret.png": "is outside of the model's folder",
    "sub/../../secret.png": "is outside of the model's folder",
    "..\\secret.png": "is outside of the model's folder",
    "{absolute}": "is an absolute path, which is refused",
    "C:\\textures\\secret.png": "is an absolute path, which is refused",
    "file:///etc/passwd": "is an absolute path, which is refused",
    "http://example.org/secret.png": "is a network address, which is refused",
    "link.png": "is outside of the model's folder",
    "sub": "not found; expected it in the model's folder",
    "absent.png": "not found; expected it in the model's folder",
    "a" * 5000: "is not a file name",
}


@pytest.mark.parametrize("name", OUTSIDE)
@pytest.mark.parametrize("suffix", [".obj", ".gltf", ".ply"])
def test_textures_outside_the_folder_are_refused_by_name(secret: Path, name: str, suffix: str) -> None:
    reference, expected = name.replace("{absolute}", str(secret.parent / "secret.png")), OUTSIDE[name]
    try:
        (secret / "link.png").symlink_to(secret.parent / "secret.png")
    except OSError:
        pytest.skip("no symbolic links here")
    path = secret / f"a{suffix}"
    if suffix == ".obj":
        write_obj(path, reference)
    elif suffix == ".gltf":
        document, data = gltf(images=[{"uri": reference}], textures=[{"source": 0}])
        document["materials"] = [
            {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 0, 0, 1]}}
        ]
        document["meshes"][0]["primitives"][0]["material"] = 0
        (secret / "triangle.bin").write_bytes(data)
        path.write_text(json.dumps(document))
    else:
        write_ply(path, *cube()[:2])
        path.write_bytes(
            path.read_bytes().replace(b"element vertex", f"comment TextureFile {reference}\nelement vertex".encode(), 1)
        )
    text = refusal(path)
    assert expected in text and "scene.skip_missing=true draws the mesh without it" in text
    assert repr(reference[:20])[:-1] in text
    assert any(expected in note and "drawn without it" in note for note in notes(path, skip_missing=True))


def test_buffers_outside_the_folder_are_refused(secret: Path) -> None:
    path = write_gltf(secret / "a.gltf")
    (secret / "triangle.bin").rename(secret.parent / "triangle.bin")
    assert "buffer 'triangle.bin' not found" in refusal(path)
    write_gltf(path, buffers=[{"uri": "../triangle.bin", "byteLength": 44}])
    text = refusal(path, skip_missing=True)
    assert "buffer '../triangle.bin' is outside of the model's folder" in text


def test_a_library_outside_the_folder_is_refused_but_one_beside_the_model_is_taken_for_it(secret: Path) -> None:
    """Exporters write the path of another machine; what lies beside the model under that name is meant."""
    path = write_obj(secret / "a.obj")
    path.write_text(path.read_text().replace("mtllib a.mtl", "mtllib C:\\work\\a.mtl"))
    assert notes(path) == []
    path.with_suffix(".mtl").unlink()
    assert "material file 'C:\\\\work\\\\a.mtl' is an absolute path" in refusal(path)


def test_data_uris_are_read_and_damaged_ones_refused(tmp_path: Path) -> None:
    data = gltf()[1]
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    path = write_gltf(tmp_path / "a.gltf", buffers=[{"uri": uri, "byteLength": len(data)}])
    (tmp_path / "triangle.bin").unlink()
    assert len(notes(path)) == 1  # no colours
    for broken in ("data:application/octet-stream;base64,@@@@", "data:text/plain,hello"):
        write_gltf(path, buffers=[{"uri": broken, "byteLength": 1}])
        assert "embedded buffer is damaged" in refusal(path)


def test_images_of_formats_that_run_programs_are_not_opened(tmp_path: Path) -> None:
    """Pillow would hand PostScript to Ghostscript."""
    path = write_obj(tmp_path / "a.obj")
    Image.new("RGB", (8, 8)).save(tmp_path / "skin.eps")
    (tmp_path / "skin.eps").rename(tmp_path / "skin.png")
    assert "texture 'skin.png' cannot be decoded" in refusal(path)
    (tmp_path / "skin.png").write_bytes(b"")
    assert "cannot be decoded" in refusal(path, skip_missing=True)  # what is there is damaged, not missing


def test_texture_coordinates_beyond_all_measure(tmp_path: Path) -> None:
    path = write_obj(tmp_path / "a.obj")
    path.write_text(path.read_text().replace("vt 0 0", "vt 1e300 nan").replace("vt 1 1", "vt -1e20 inf"))
    assert notes(path) == []


def one_mesh(**primitive: Any) -> dict[str, Any]:
    return {"meshes": [{"primitives": [primitive]}]}


DAMAGED: dict[str, dict[str, Any]] = {
    "version 1.0": {"asset": {"version": "1.0"}},
    "key 'version' is missing": {"asset": {}},
    "needs the glTF extension KHR_draco_mesh_compression": {"extensionsRequired": ["KHR_draco_mesh_compression"]},
    "bufferViews[0] ends at byte 100, but its buffer has 44 bytes": {"bufferViews": [{"buffer": 0, "byteLength": 100}]},
    "list index out of range": {"bufferViews": []},
    "an index or count is -1": {"nodes": [{"mesh": -1}]},
    "nodes[0] has a transform with a wrong number of values": {"nodes": [{"mesh": 0, "matrix": [1, 2, 3]}]},
    "could not convert": {"nodes": [{"mesh": 0, "scale": [1, 2, "x"]}]},
    "a number is inf": {"nodes": [{"mesh": 0, "scale": [1, 2, 1e999]}]},
    "index out of range": {"scenes": [{"nodes": [7]}]},
    "not subscriptable": {"meshes": 5},
    "key 'POSITION' is missing": one_mesh(attributes={}),
    "accessors[1] is SCALAR, not VEC3": one_mesh(attributes={"POSITION": 1}),
    "a primitive has the unknown mode 9": one_mesh(attributes={"POSITION": 0}, mode=9),
}


@pytest.mark.parametrize("text", DAMAGED)
def test_damaged_documents(tmp_path: Path, text: str) -> None:
    assert text in refusal(write_gltf(tmp_path / "a.gltf", **DAMAGED[text]))
