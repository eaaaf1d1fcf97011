"""Models of other programs: what their materials, instances, poses and extensions mean is drawn, said in a line, or
refused by name."""

from __future__ import annotations

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from neuprim.core import errors
from neuprim.core.errors import DataError
from neuprim.scenes.shading import encode_scene_srgb, scene_daylight_radiance
from neuprim.tasks.static import mesh as generator
from neuprim.tasks.static.mesh.model import MeshFolder
from neuprim.tasks.static.mesh.surface import GREY, MeshSurface, SurfacePart, read_surfaces
from tests.models import BLUE, GREEN, RED, YELLOW, cube, quarters

DOWN = [[0.0, 0.0, -1.0]]


@pytest.fixture(autouse=True)
def every_note(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(errors, "_said", set())


def parts_of(path: Path) -> list[SurfacePart]:
    return read_surfaces(generator.MODEL_READERS[path.suffix](MeshFolder(path)))


def surface(path: Path, upward: str = "z") -> MeshSurface:
    model = generator.MODEL_READERS[path.suffix](MeshFolder(path))
    return MeshSurface(model, read_surfaces(model), upward, 1e-6)  # type: ignore[arg-type]


class Document:
    """A .gltf of one square, z = 0 from -1 to 1, with texture coordinates and whatever else is added."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.data = folder, b""
        self.json: dict[str, Any] = {"asset": {"version": "2.0"}, "accessors": [], "bufferViews": [], "materials": [{}]}
        corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
        uv = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
        attributes = {"POSITION": self.add(corners), "TEXCOORD_0": self.add(uv)}
        indices = self.add(np.array([[0], [1], [2], [0], [2], [3]], np.uint16))
        self.primitive: dict[str, Any] = {"attributes": attributes, "indices": indices, "material": 0}
        self.json["meshes"] = [{"primitives": [self.primitive]}]
        self.json["nodes"] = [{"mesh": 0}]
        self.material: dict[str, Any] = self.json["materials"][0]

    def add(self, values: np.ndarray, normalized: bool = False) -> int:
        """The accessor of (N, C) values."""
        component = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "f4": 5126}[values.dtype.str[1:]]
        raw = np.ascontiguousarray(values).tobytes()
        self.json["bufferViews"].append({"buffer": 0, "byteOffset": len(self.data), "byteLength": len(raw)})
        self.data += raw + bytes(-len(raw) % 4)
        kind = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}[values.shape[1]]
        view = len(self.json["bufferViews"]) - 1
        self.json["accessors"].append(
            {"bufferView": view, "componentType": component, "count": len(values), "type": kind}
        )
        if normalized:
            self.json["accessors"][-1]["normalized"] = True
        return len(self.json["accessors"]) - 1

    def texture(self, alpha: int | None = None) -> dict[str, Any]:
        """What a material says to have the quarters."""
        name = f"skin{alpha}.png"
        quarters(alpha=alpha).save(self.folder / name)
        self.json.setdefault("images", []).append({"uri": name})
        self.json.setdefault("textures", []).append({"source": len(self.json["images"]) - 1})
        return {"index": len(self.json["textures"]) - 1}

    def write(self) -> Path:
        (self.folder / "a.bin").write_bytes(self.data)
        self.json["buffers"] = [{"uri": "a.bin", "byteLength": len(self.data)}]
        path = self.folder / "a.gltf"
        path.write_text(json.dumps(self.json))
        return path


def shown(path: Path, lit: bool = False) -> list[int]:
    """The display colour of the upper left quarter, seen from above."""
    scene = surface(path)
    at = np.array([[-0.5, 0.5, 3.0]], np.float32)
    image, hit = (
        scene_daylight_radiance(scene, at, DOWN)
        if lit
        else generator.unlit_mesh_radiance(scene, at, np.array(DOWN, np.float32))
    )
    assert hit.all()
    return np.round(encode_scene_srgb(image[0]) * 255).astype(int).tolist()


def srgb(*linear: float) -> list[int]:
    return np.round(encode_scene_srgb(np.array(linear, np.float32)) * 255).astype(int).tolist()


@pytest.mark.parametrize("lit", [False, True])
def test_light_that_a_material_emits_is_added(tmp_path: Path, lit: bool) -> None:
    document = Document(tmp_path)
    document.material |= {"pbrMetallicRoughness": {"baseColorFactor": [0, 0, 0, 1]}, "emissiveFactor": [0.9, 0.5, 0.1]}
    assert shown(document.write(), lit) == srgb(0.9, 0.5, 0.1)
    document.material["extensions"] = {"KHR_materials_emissive_strength": {"emissiveStrength": 0.5}}
    assert shown(document.write(), lit) == srgb(0.45, 0.25, 0.05)
    document.material["pbrMetallicRoughness"] = {"baseColorFactor": [0, 0.2, 0, 1]}
    found = shown(document.write(), lit)
    assert found[0] == srgb(0.45, 0, 0)[0] and found[1] > srgb(0, 0.25, 0)[1]


def test_a_texture_of_light_has_coordinates_of_its_own(tmp_path: Path) -> None:
    """The second set shows the lower right quarter, and is moved to the lower left one; where the factor is 0 nothing
    is emitted."""
    document = Document(tmp_path)
    moved = {"KHR_texture_transform": {"offset": [-0.5, 0.0]}}
    document.material |= {
        "pbrMetallicRoughness": {"baseColorTexture": document.texture(), "baseColorFactor": [0.5, 0.5, 0.5, 1]},
        "emissiveTexture": {**document.texture(), "texCoord": 1, "extensions": moved},
    }
    document.primitive["attributes"]["TEXCOORD_1"] = document.add(np.full((4, 2), 191, np.uint8), normalized=True)
    assert shown(document.write()) == srgb(0.5, 0, 0)
    document.material["emissiveFactor"] = [0.2, 0.2, 0.2]
    assert shown(document.write()) == srgb(0.5, 0, 0.2)


def test_unlit_colours_are_shown_as_they_are(tmp_path: Path) -> None:
    document = Document(tmp_path)
    document.material |= {
        "pbrMetallicRoughness": {"baseColorTexture": document.texture(), "baseColorFactor": [0.5, 1, 1, 1]},
        "extensions": {"KHR_materials_unlit": {}},
    }
    document.json["extensionsRequired"] = document.json["extensionsUsed"] = ["KHR_materials_unlit"]
    assert shown(document.write(), lit=True) == shown(document.write()) == srgb(0.5, 0, 0)


def test_light_and_opacity_of_an_objs_library(tmp_path: Path) -> None:
    quarters().save(tmp_path / "glow.png")
    (tmp_path / "a.obj").write_text(
        "mtllib a.mtl\nv -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\nv -1 -1 1\nv 1 -1 1\nv 1 1 1\nv -1 1 1\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nusemtl lamp\nf 1/1 2/2 3/3 4/4\nusemtl pane\nf 5 6 7 8\n"
    )

    def look(lamp: str, pane: str) -> list[int]:
        (tmp_path / "a.mtl").write_text(f"newmtl lamp\nKd 0 0 0\n{lamp}\nnewmtl pane\nKd 0 0 1\n{pane}\n")
        return shown(tmp_path / "a.obj")

    with pytest.warns(match="2 faces are translucent; they are opaque where their opacity is at least 0.5"):
        assert look("Ke 1 0.5 0", "d 0.3") == [255, 128, 0]
    assert look("Ke 0 0 0\nmap_Ke glow.png", "Tr 0.7") == list(RED)
    assert look("Ke 1 1 1", "d 0.7") == look("Ke 1 1 1", "Tr 0.3") == list(BLUE)
    assert (
        look("Ke 1 1 1", "d 1.0\nTr 1.0") == look("Ke 1 1 1", "Tr 1.0\nd 1.0") == list(BLUE)
    )  # writers disagree about Tr
    with pytest.raises(DataError, match="material 'pane' has the opacity 'clear'; expected a number"):
        look("", "d clear")
    with pytest.raises(DataError, match=r"no face has an opacity of at least 0\.5"):
        look("d 0.1", "Tr 1")
    with pytest.warns(match="map_d of material 'pane' is not read"):
        look("", "map_d mask.png")


@pytest.mark.parametrize(
    ("options", "colour"),
    [
        ("", RED),
        ("-o 0.5 0", GREEN),
        ("-o 0 -0.5 0", BLUE),
        ("-s 3 1 1", GREEN),
        ("-s 1 1 1 -o 0.5 -0.5 0", YELLOW),
        ("-clamp on -o -3 -3", BLUE),
    ],
)
def test_textures_of_libraries_are_moved_and_in_folders_with_blanks(
    tmp_path: Path, options: str, colour: tuple[int, int, int]
) -> None:
    (tmp_path / "tex dir").mkdir()
    quarters().save(tmp_path / "tex dir" / "my tex.png")
    (tmp_path / "my lib.mtl").write_text(f"newmtl my mat\nKd 0 0 0\nmap_Kd {options} tex dir\\my tex.png\n")
    (tmp_path / "other.mtl").write_text("newmtl other\n")
    for libraries in ("my lib.mtl", "other.mtl my lib.mtl"):
        (tmp_path / "a.obj").write_text(
            f"mtllib {libraries}\nusemtl my mat\nv -1 -1 0\nv 1 -1 0\nv 1 1 0\nv -1 1 0\n"
            "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf -4/-4 -3/-3 -2/-2 -1/-1\n"
        )
        assert shown(tmp_path / "a.obj") == list(colour)


@pytest.mark.parametrize("metallic", [{}, {"baseColorFactor": [0, 0, 1, 1]}, None])
def test_specular_glossiness_wins_over_what_stands_beside_it(tmp_path: Path, metallic: dict[str, Any] | None) -> None:
    document = Document(tmp_path)
    document.material["extensions"] = {"KHR_materials_pbrSpecularGlossiness": {"diffuseFactor": [0.5, 0.25, 0.0, 1]}}
    if metallic is not None:
        document.material["pbrMetallicRoughness"] = metallic
    assert shown(document.write()) == srgb(0.5, 0.25, 0)
    document.material["extensions"]["KHR_materials_pbrSpecularGlossiness"] = {"diffuseTexture": document.texture()}
    assert shown(document.write()) == list(RED)


def test_base_colours_are_linear_and_multiply_those_of_vertices(tmp_path: Path) -> None:
    """A factor as dark as an 8-bit linear value cannot hold."""
    document = Document(tmp_path)
    document.material["pbrMetallicRoughness"] = {"baseColorFactor": [0.0013, 0.25, 1.0, 1.0]}
    document.primitive["attributes"]["COLOR_0"] = document.add(np.full((4, 4), 32768, np.uint16), normalized=True)
    (part,) = parts_of(document.write())
    np.testing.assert_allclose(part.colour, np.broadcast_to([0.00065, 0.125, 0.5], (2, 3, 3)), rtol=1e-4)


def test_texture_coordinates_of_the_materials_own_set_are_moved_and_wrapped(tmp_path: Path) -> None:
    """Half a texture to the right, from quantized coordinates; clamped along u, mirrored along v."""
    document = Document(tmp_path)
    moved = {"KHR_texture_transform": {"offset": [0.5, 0.0], "scale": [2.0, 1.0]}}
    texture = {**document.texture(), "texCoord": 1, "extensions": moved}
    document.material["pbrMetallicRoughness"] = {"baseColorTexture": texture}
    document.json["textures"][0]["sampler"] = 0
    document.json["samplers"] = [{"wrapS": 33071, "wrapT": 33648}]
    document.json["images"][0]["uri"] = "the%20skin.png"
    (tmp_path / "skinNone.png").rename(tmp_path / "the skin.png")
    document.json["extensionsRequired"] = ["KHR_texture_transform", "KHR_mesh_quantization"]
    uv = np.array([[0, 0], [0, 0], [255, 255], [0, 0]], np.uint8)
    document.primitive["attributes"]["TEXCOORD_1"] = document.add(uv, normalized=True)
    (part,) = parts_of(document.write())
    assert part.material.wrap == ("clamp", "mirror") and part.uv is not None
    # v upward: glTF's 0 is the upper edge
    np.testing.assert_allclose(part.uv[0], [[0.5, 1.0], [0.5, 1.0], [2.5, 0.0]], atol=1e-6)


@pytest.mark.parametrize("kind", ["u1", "<u2", "<f4"])
@pytest.mark.parametrize("width", [3, 4])
def test_colours_of_vertices_of_every_type(tmp_path: Path, kind: str, width: int) -> None:
    document = Document(tmp_path)
    most = 1 if kind == "<f4" else np.iinfo(kind).max
    values = np.tile(np.array([1.0, 0.2, 0.0, 0.1])[:width] * most, (4, 1)).astype(kind)
    if width == 3 and kind != "<f4":
        values = np.pad(values, ((0, 0), (0, 1)))  # strides are multiples of four
        document.primitive["attributes"]["COLOR_0"] = document.add(values, normalized=True)
        document.json["accessors"][-1]["type"] = "VEC3"
        document.json["bufferViews"][-1]["byteStride"] = values.strides[0]
    else:
        document.primitive["attributes"]["COLOR_0"] = document.add(values, normalized=kind != "<f4")
    assert shown(document.write()) == srgb(1, 0.2, 0)  # opaque: alphaMode is


BLEND, MASK = {"alphaMode": "BLEND"}, {"alphaMode": "MASK"}


@pytest.mark.parametrize(
    ("mode", "opacity", "alpha", "drawn", "said"),
    [
        (BLEND, 0.1, None, False, True),
        (BLEND, 0.8, None, True, True),
        (BLEND, 1, None, True, False),
        (BLEND, None, 0.2, False, True),
        (MASK, 0.4, None, False, False),
        ({**MASK, "alphaCutoff": 0.3}, 0.4, None, True, False),
        ({**MASK, "alphaCutoff": 0.3}, 0.4, 0.5, False, False),
        ({}, 0.1, 0.1, True, False),
    ],
)
def test_opacity_cuts_holes_and_translucency_is_said(
    tmp_path: Path, recwarn: Any, mode: Any, opacity: float | None, alpha: float | None, drawn: bool, said: bool
) -> None:
    """Of a pane before a red square."""
    document = Document(tmp_path)
    document.material |= {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}
    attributes = dict(document.primitive["attributes"])
    attributes["POSITION"] = document.add(np.array([[-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]], np.float32))
    if alpha is not None:
        attributes["COLOR_0"] = document.add(np.array([[1, 1, 1, alpha]] * 4, np.float32))
    factor = {} if opacity is None else {"baseColorFactor": [1, 1, 1, opacity]}
    document.json["materials"].append({"pbrMetallicRoughness": factor, **mode})
    document.json["meshes"][0]["primitives"].append({**document.primitive, "attributes": attributes, "material": 1})
    assert shown(document.write()) == ([255, 255, 255] if drawn else list(RED))
    assert any("2 faces are translucent" in str(w.message) for w in recwarn) == said


@pytest.mark.parametrize(
    ("used", "text"),
    [
        (
            ["KHR_materials_transmission", "KHR_materials_clearcoat"],
            "ignores the glTF extensions KHR_materials_clearcoat, KHR_materials_transmission of the file",
        ),
        (["KHR_node_visibility"], "ignores the glTF extension KHR_node_visibility of the file"),
        (["KHR_lights_punctual", "KHR_materials_variants", "EXT_meshopt_compression"], ""),
    ],
)
def test_what_changes_the_picture_and_is_not_read_is_said(
    tmp_path: Path, recwarn: pytest.WarningsRecorder, used: list[str], text: str
) -> None:
    document = Document(tmp_path)
    document.json["extensionsUsed"] = used
    document.material["pbrMetallicRoughness"] = {"baseColorTexture": document.texture()}
    if "KHR_materials_clearcoat" in used:  # or says it in the material alone
        document.json["extensionsUsed"] = ["KHR_materials_transmission"]
        document.material["extensions"] = {"KHR_materials_clearcoat": {"clearcoatFactor": 1}}
    assert shown(document.write()) == list(RED)
    said = [str(w.message) for w in recwarn if "glTF" in str(w.message)]
    assert len(said) == bool(text) and all(text in line for line in said)


@pytest.mark.parametrize(
    "name", ["KHR_texture_basisu", "KHR_meshopt_compression", "KHR_materials_transmission", "VENDOR_whatever"]
)
def test_what_a_file_requires_and_is_not_read_is_refused_by_name(tmp_path: Path, name: str) -> None:
    document = Document(tmp_path)
    document.json["extensionsRequired"] = document.json["extensionsUsed"] = [name]
    with pytest.raises(DataError, match=f"a.gltf: needs the glTF extension {name}, which is not supported"):
        parts_of(document.write())


def test_what_a_file_offers_beside_compression_is_read(tmp_path: Path) -> None:
    document = Document(tmp_path)
    place = document.texture()
    document.json["images"].append({"uri": "missing.ktx2"})
    document.json["textures"][0]["extensions"] = {"KHR_texture_basisu": {"source": 1}}
    document.primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0, "attributes": {"POSITION": 0}}}
    document.material["pbrMetallicRoughness"] = {"baseColorTexture": place}
    assert shown(document.write()) == list(RED)
    del document.json["accessors"][0]["bufferView"]
    with pytest.raises(DataError, match="needs the glTF extension KHR_draco_mesh_compression"):
        parts_of(document.write())


def placed(path: Path) -> list[np.ndarray]:
    """The corners of every part, in the order of their middles."""
    return sorted((part.corners for part in parts_of(path)), key=lambda c: c.mean(axis=(0, 1)).tolist())


def test_parts_stand_where_the_graph_puts_them(tmp_path: Path) -> None:
    """Two uses of one part, one turned and mirrored below a node that scales."""
    document, half = Document(tmp_path), math.sqrt(0.5)
    turned = {"mesh": 0, "rotation": [0, 0, half, half], "translation": [10, 0, 1]}
    document.json["nodes"] = [{"mesh": 0}, {"scale": [2, 2, -2], "children": [2]}, turned]
    document.json["scenes"] = [{"nodes": [0, 1]}]
    first, second = placed(document.write())
    np.testing.assert_allclose(first[0], [[-1, -1, 0], [1, -1, 0], [1, 1, 0]])
    np.testing.assert_allclose(second[0], [[22, -2, -2], [22, 2, -2], [18, 2, -2]], atol=1e-12)


@pytest.mark.parametrize(("mode", "indices"), [(4, [0, 1, 2, 0, 2, 3]), (5, [0, 1, 3, 2]), (6, [0, 1, 2, 3])])
def test_triangles_strips_and_fans(tmp_path: Path, mode: int, indices: list[int]) -> None:
    document = Document(tmp_path)
    document.primitive |= {"mode": mode, "indices": document.add(np.array(indices, np.uint16)[:, None])}
    (corners,) = placed(document.write())
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert len(corners) == 2 and np.allclose(across, [0, 0, 4])


@pytest.mark.parametrize("kind", ["<f4", "i1", "<i2"])
def test_instances_are_expanded_below_their_node(tmp_path: Path, kind: str) -> None:
    """Turned by a quaternion of any length, scaled along one axis, moved; then what the node does."""
    document = Document(tmp_path)
    most = 1 if kind == "<f4" else np.iinfo(kind).max
    half = math.sqrt(0.5)
    turns = np.array([[0, 0, half, half], [0, 0, 0, 1]]) * most
    attributes = {
        "TRANSLATION": document.add(np.array([[10, 0, 0], [0, 20, 0]], np.float32)),
        "ROTATION": document.add(
            (2 * turns if kind == "<f4" else np.round(turns)).astype(kind), normalized=kind != "<f4"
        ),
        "SCALE": document.add(np.array([[1, 3, 1], [1, 1, -2]], np.float32)),
    }
    extensions = {"EXT_mesh_gpu_instancing": {"attributes": attributes}}
    document.json["nodes"] = [{"mesh": 0, "translation": [0, 0, 5], "scale": [2, 2, 2], "extensions": extensions}]
    document.json["extensionsUsed"] = ["EXT_mesh_gpu_instancing"]
    second, first = placed(document.write())
    # a corner (x, y) becomes (x, 3y), turns to (-3y, x) and moves to (10 - 3y, x), which the node doubles
    np.testing.assert_allclose(
        first[0], [[20 + 6, -2, 5], [20 + 6, 2, 5], [20 - 6, 2, 5]], atol=0.05 if kind == "i1" else 1e-3
    )
    np.testing.assert_allclose(second[0], [[-2, 38, 5], [2, 38, 5], [2, 42, 5]], atol=1e-6)
    document.json["accessors"][attributes["SCALE"]]["count"] = 1
    with pytest.raises(DataError, match=r"attributes of instances have different or no lengths: \[1, 2\] values"):
        parts_of(document.write())


def test_more_instances_than_parts_are_refused(tmp_path: Path) -> None:
    document = Document(tmp_path)
    document.json["nodes"][0]["extensions"] = {
        "EXT_mesh_gpu_instancing": {"attributes": {"TRANSLATION": document.add(np.zeros((20_001, 3), np.float32))}}
    }
    with pytest.raises(DataError, match="20001 instances; expected at most 20000"):
        parts_of(document.write())


def test_morph_targets_have_their_default_weights(tmp_path: Path) -> None:
    document = Document(tmp_path)
    raised = np.array([[0, 0, 4]] * 4, np.float32)
    document.primitive["targets"] = [{"POSITION": document.add(raised)}, {"POSITION": document.add(-raised)}]
    assert placed(document.write())[0][..., 2].max() == 0
    document.json["meshes"][0]["weights"] = [0.5, 0.0]
    assert (placed(document.write())[0][..., 2] == 2).all()
    document.json["nodes"] = [{"mesh": 0}, {"mesh": 0, "weights": [0.0, 1.0]}]  # a node's own win
    below, above = sorted(placed(document.write()), key=lambda c: c[..., 2].max())
    assert (above[..., 2] == 2).all() and (below[..., 2] == -4).all()


def test_a_skin_is_where_its_joints_are(tmp_path: Path) -> None:
    """Two joints: the left corners hang on one at rest, the right ones on both alike, the other 6 further up. The
    mesh's node counts not."""
    document = Document(tmp_path)
    bound = np.eye(4, dtype=np.float32)
    bound[3, :3] = [-7, 0, 0]  # column by column: the inverse of the joint's first place
    document.json["nodes"] = [
        {"mesh": 0, "skin": 0, "translation": [100, 0, 0]},
        {"scale": [2, 2, 2], "children": [2, 3]},
        {"translation": [0, 0, 0]},
        {"translation": [7, 0, 6]},
    ]
    binds = np.stack([np.eye(4, dtype=np.float32), bound]).reshape(2, 16)
    document.json["skins"] = [{"joints": [2, 3], "inverseBindMatrices": document.add(binds)}]
    document.primitive["attributes"]["JOINTS_0"] = document.add(np.array([[0, 1, 0, 0]] * 4, np.uint8))
    shares = np.array([[255, 0, 0, 0], [127, 127, 0, 0], [127, 127, 0, 0], [255, 0, 0, 0]], np.uint8)
    document.primitive["attributes"]["WEIGHTS_0"] = document.add(shares, normalized=True)
    (found,) = placed(document.write())
    np.testing.assert_allclose(found[0], [[-2, -2, 0], [2, -2, 6], [2, 2, 6]], atol=1e-5)
    document.json["nodes"][3]["children"] = [1]
    with pytest.raises(DataError, match="joint 2 is outside of the scene"):
        parts_of(document.write())


def write_stl(path: Path, head: bytes, *attributes: int) -> Path:
    """Binary: triangles in a row along x."""
    body = b""
    for i, attribute in enumerate(attributes):
        body += struct.pack("<12fH", 0, 0, 1, i, 0, 0, i + 1, 0, 0, i, 1, 0, attribute)
    path.write_bytes(head.ljust(80) + struct.pack("<I", len(attributes)) + body)
    return path


def colours_along_x(path: Path) -> list[list[float]]:
    found = [
        (corners.mean(axis=0)[0], colour[0])
        for part in parts_of(path)
        for corners, colour in zip(part.corners, part.colour, strict=True)
    ]
    return [np.round(encode_scene_srgb(colour), 3).tolist() for _, colour in sorted(found, key=lambda f: f[0])]


def test_an_stl_that_starts_like_text_is_told_by_its_length(tmp_path: Path) -> None:
    path = write_stl(tmp_path / "a.stl", b"solid exported facet by CAD", 0, 0, 0)
    with pytest.warns(match="3 of 3 faces have no colour; drawn grey"):
        assert colours_along_x(path) == [np.round(encode_scene_srgb(GREY), 3).tolist()] * 3
    mesh = trimesh.Trimesh(*cube()[:2], process=False)
    (tmp_path / "b.stl").write_bytes(mesh.export(file_type="stl_ascii").replace("solid", "SOLID two words", 1).encode())
    assert len(parts_of(tmp_path / "b.stl")[0].corners) == 12
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(DataError, match=r"a\.stl: "):
        parts_of(path)


def test_colours_in_the_attributes_of_an_stl(tmp_path: Path) -> None:
    """Of both conventions: bit 15 says that there is one, and the reverse where the header has the whole's."""
    red, green = 31 << 10, 31 << 5
    grey = np.round(encode_scene_srgb(GREY), 3).tolist()
    plain = write_stl(tmp_path / "a.stl", b"made by a scanner", 1 << 15 | red, red, 1 << 15 | green)
    assert colours_along_x(plain) == [[1, 0, 0], grey, [0, 1, 0]]
    whole = write_stl(tmp_path / "b.stl", b"COLOR=" + bytes([0, 0, 255, 255]) + b",MATERIAL=", red, 1 << 15, green)
    assert colours_along_x(whole) == [[0, 0, 1], [0, 0, 1], [0, 1, 0]]
