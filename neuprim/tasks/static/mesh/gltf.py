"""glTF 2 (.gltf, .glb): what a document says, checked and written anew with nothing in it but surfaces, for trimesh to
read.

Accessors are unpacked, quantized ones too. Materials and images are not passed on, so no decoder runs before its turn.
Morph targets have their default weights, and skins the pose of their joints' nodes; animations, lights and cameras are
left out.

Extensions: those in ``_READ`` are honoured, those in ``_HARMLESS`` change nothing that is drawn, and beside those of
``_COMPRESSION`` a file may hold what is read, or is refused. Any other is named in one line, and refused where the file
requires it.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from neuprim.core.errors import DataError
from neuprim.core.io.plain import load_json
from neuprim.core.notices import warn_once
from neuprim.tasks.static.mesh.accessors import PLAIN, Accessors, count_of, file_name, finite, index_of
from neuprim.tasks.static.mesh.files import MAX_FACES, MAX_PARTS, MAX_VERTICES, Folder, Material, Model, check_counts

__all__ = ["GLOW_UV", "read_gltf"]

_GLB, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_WRAPS = {33071: "clamp", 33648: "mirror"}
_READ = {
    "EXT_mesh_gpu_instancing",
    "EXT_texture_webp",
    "KHR_materials_emissive_strength",
    "KHR_materials_pbrSpecularGlossiness",
    "KHR_materials_unlit",
    "KHR_mesh_quantization",
    "KHR_texture_transform",
}
_HARMLESS = {
    "EXT_instance_features",
    "EXT_lights_ies",
    "EXT_lights_image_based",
    "EXT_mesh_features",
    "EXT_structural_metadata",
    "KHR_animation_pointer",
    "KHR_audio_emitter",
    "KHR_lights_punctual",
    "KHR_materials_variants",  # the default is drawn
    "KHR_xmp_json_ld",
    "MSFT_lod",  # the finest is drawn
}
_COMPRESSION = {
    "EXT_meshopt_compression",
    "EXT_texture_avif",
    "KHR_draco_mesh_compression",
    "KHR_meshopt_compression",
    "KHR_texture_basisu",
    "MSFT_texture_dds",
}
GLOW_UV = "_GLOW_UV"
"""The attribute with coordinates in the texture of emitted light."""

_POINTS_AND_LINES, _TRIANGLES, _FAN = (0, 1, 2, 3), (4, 5, 6), 6
_MAX_DEPTH = 200
_MOST_JOINTS = 32
"""That a vertex hangs on."""
_ROWS = 50_000
"""Vertices that are posed at once."""

_WHITE = (1.0, 1.0, 1.0)


def read_gltf(folder: Folder) -> Model:
    """The model of a .gltf or .glb file.

    Raises:
        DataError: damaged, of another version, compressed, or with references that lead nowhere.
    """
    path, data = folder.file, folder.own()
    try:
        text, binary = _chunks(data) if path.suffix.lower() == ".glb" else (data, None)
        document = load_json(text.decode("utf-8-sig"), infinite=True)  # said of the value that has it, below
        if not isinstance(document, dict):
            raise ValueError(f"top level is a {type(document).__name__}, no object")
        return _Document(folder, document, binary).model()
    except (
        AttributeError,
        IndexError,
        KeyError,
        OverflowError,
        RecursionError,
        TypeError,
        ValueError,
        struct.error,
    ) as error:
        said = f"nothing called {error}" if isinstance(error, KeyError) else str(error)
        raise DataError(f"{path}: damaged glTF ({' '.join(said.split())[:160]}); expected glTF 2") from None


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """The JSON and the binary chunk of a .glb file."""
    magic, version, length, size, kind = struct.unpack_from("<5I", data)
    if magic != _GLB:
        raise ValueError(f"starts with {data[:4]!r}, not with b'glTF'")
    if version != 2:
        raise ValueError(f"version {version}")
    if length > len(data) or kind != _JSON or 20 + size > len(data):
        raise ValueError(
            f"{len(data)} bytes are there, {max(length, 20 + size)} announced" if kind == _JSON else "no JSON chunk"
        )
    text, place = data[20 : 20 + size], 20 + size
    while place + 8 <= length:
        size, kind = struct.unpack_from("<2I", data, place)
        if place + 8 + size > len(data):
            raise ValueError(f"a chunk of {size} bytes is cut off")
        if kind == _BIN:
            return text, data[place + 8 : place + 8 + size]
        place += 8 + size
    return text, None


class _Document:
    """One document while it is written anew."""

    def __init__(self, folder: Folder, document: dict[str, Any], binary: bytes | None) -> None:
        self.folder, self.document, self.path = folder, document, folder.file
        version = str(document["asset"]["version"])
        if version.split(".")[0] != "2":
            raise ValueError(f"version {version[:20]}")
        required, used = set(document.get("extensionsRequired", [])), set(document.get("extensionsUsed", []))
        unread = sorted(required - _READ - _HARMLESS)
        if unread:
            raise DataError(
                f"{self.path}: needs the glTF extension {unread[0][:60]}, which is not read; {PLAIN}, not compressed"
            )
        ignored = sorted(
            used.union(*(m.get("extensions", {}) for m in document.get("materials", [])))
            - _READ
            - _HARMLESS
            - _COMPRESSION
        )
        if ignored:
            shown = ", ".join(ignored[:6]) + ", ..." * (len(ignored) > 6)
            warn_once(f"{self.path}: uses the glTF extension{'s' * (len(ignored) > 1)} {shown[:300]}; drawn without")
        self.data = Accessors(folder, document, binary)
        self.images: dict[str, bytes] = {}
        self.arrays: list[bytes] = []
        self.accessors: list[dict[str, Any]] = []
        self.vertices = self.corners = self.primitives = self.skipped = 0
        self.meshes: list[list[dict[str, Any]]] = []

    def model(self) -> Model:
        materials = {str(i): self._material(m) for i, m in enumerate(self.document.get("materials", []))}
        materials["none"] = Material()
        order = {name: i for i, name in enumerate(materials)}
        self.materials, self.order = materials, order
        self.meshes = [self._mesh(m, m.get("weights", [])) for m in self.document.get("meshes", [])]
        nodes, roots = self._nodes()
        if self.skipped:
            warn_once(f"{self.path}: {self.skipped} parts are points or lines; only triangles are drawn")
        views, offset = [], 0
        for part in self.arrays:
            views.append({"buffer": 0, "byteOffset": offset, "byteLength": len(part)})
            offset += len(part)
        plain = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": roots}],
            "nodes": nodes,
            "meshes": [{"name": f"mesh {i}", "primitives": p} for i, p in enumerate(self.meshes)],
            "accessors": self.accessors,
            "bufferViews": views,
            "buffers": [{"uri": "arrays", "byteLength": offset}],
            "materials": [{"name": name} for name in materials],
        }
        parts = {"arrays": b"".join(self.arrays)}
        text = json.dumps(plain, allow_nan=False).encode()
        return Model(self.path, "gltf", text, parts, materials, self.images, "y", True, self.folder.digest)

    def _kept(self, values: NDArray, kind: str) -> int:
        """The index of an accessor with these values in the new document."""
        dtype = "<f4" if kind != "SCALAR" else "<u4"
        view = len(self.arrays)
        self.arrays.append(np.ascontiguousarray(values, dtype=dtype).tobytes())
        component = 5126 if kind != "SCALAR" else 5125
        self.accessors.append({"bufferView": view, "componentType": component, "count": len(values), "type": kind})
        return view

    # ------------------------------------------------------------ surfaces

    def _mesh(
        self, mesh: Mapping[str, Any], weights: Sequence[float], pose: NDArray | None = None
    ) -> list[dict[str, Any]]:
        """The primitives of a mesh.

        Args:
            weights: of its morph targets.
            pose: (J, 4, 4) of the joints that its vertices hang on; None: of none.
        """
        found = []
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", 4)
            if mode in _POINTS_AND_LINES:
                self.skipped += 1
                continue
            if mode not in _TRIANGLES:
                raise ValueError(f"a primitive of mode {mode}")
            position = self.document["accessors"][index_of(primitive["attributes"]["POSITION"])]
            draco = "KHR_draco_mesh_compression"
            if draco in primitive.get("extensions", {}) and "bufferView" not in position:
                raise DataError(f"{self.path}: needs the glTF extension {draco}, which is not read; {PLAIN}")
            found.append(self._primitive(primitive, mode, [finite(w) for w in weights], pose))
            self.primitives += 1
            check_counts(self.folder, {"parts": (self.primitives, MAX_PARTS)})
        return found

    def _primitive(
        self, primitive: Mapping[str, Any], mode: int, weights: Sequence[float], pose: NDArray | None
    ) -> dict[str, Any]:
        attributes: Mapping[str, int] = primitive["attributes"]
        positions = self.data.array(attributes["POSITION"], ["VEC3"])
        flat = (
            self.data.array(primitive["indices"], ["SCALAR"])[:, 0]
            if "indices" in primitive
            else np.arange(len(positions))
        )
        self.vertices, self.corners = self.vertices + len(positions), self.corners + len(flat)
        check_counts(self.folder, {"vertices": (self.vertices, MAX_VERTICES), "faces": (self.corners // 3, MAX_FACES)})
        if flat.dtype.kind == "f" or (len(flat) and flat.max() >= len(positions)):
            raise ValueError(f"an index of {flat.max()}, with {len(positions)} vertices")
        if mode == _FAN:
            flat = np.stack([np.repeat(flat[:1], max(len(flat) - 2, 0)), flat[1:-1], flat[2:]], axis=1).ravel()
            mode = 4
        flat = flat if mode != 4 else flat[: len(flat) // 3 * 3]
        name = str(index_of(primitive["material"])) if "material" in primitive else "none"
        kept = {"POSITION": self._kept(self._posed(primitive, "POSITION", positions, weights, pose), "VEC3")}
        for attribute, source, kinds in (
            ("NORMAL", "NORMAL", ["VEC3"]),
            ("TEXCOORD_0", f"TEXCOORD_{self._texcoord(name, 'baseColorTexture')}", ["VEC2"]),
            (GLOW_UV, f"TEXCOORD_{self._texcoord(name, 'emissiveTexture')}", ["VEC2"]),
            ("COLOR_0", "COLOR_0", ["VEC3", "VEC4"]),
        ):
            glow = self.materials[name].glow
            if source not in attributes or (attribute == GLOW_UV and (glow is None or glow.texture is None)):
                continue
            values = self.data.array(attributes[source], kinds)
            if len(values) != len(positions):
                raise ValueError(f"{len(values)} values of {source}, {len(positions)} vertices")
            if attribute == "COLOR_0" and values.dtype.kind != "f":
                values = values / np.float32(np.iinfo(values.dtype).max)
            if attribute == "NORMAL":
                values = self._posed(primitive, "NORMAL", values, weights, pose)
            kept[attribute] = self._kept(values, kinds[values.shape[1] == 4])
        return {
            "attributes": kept,
            "indices": self._kept(flat[:, None], "SCALAR"),
            "mode": mode,
            "material": self.order[name],
        }

    def _posed(
        self, primitive: Mapping[str, Any], name: str, values: NDArray, weights: Sequence[float], pose: NDArray | None
    ) -> NDArray:
        """(N, 3) positions or normals with morph targets added, and where the joints of the vertices are."""
        for weight, target in zip(weights, primitive.get("targets", []), strict=False):
            if weight and name in target:
                values = values + weight * self._per_vertex(target[name], ["VEC3"], len(values))
        if pose is None:
            return values
        attributes, count = primitive["attributes"], len(values)
        pairs = [i for i in range(_MOST_JOINTS // 4) if f"JOINTS_{i}" in attributes]
        joints = np.concatenate(
            [self._per_vertex(attributes[f"JOINTS_{i}"], ["VEC4"], count) for i in pairs], axis=1
        ).astype(np.int64)
        shares = np.concatenate([self._per_vertex(attributes[f"WEIGHTS_{i}"], ["VEC4"], count) for i in pairs], axis=1)
        moved, total = np.zeros((count, 3)), np.maximum(shares.sum(axis=1, keepdims=True), 1e-9)
        whole = np.concatenate([values, np.full((count, 1), name == "POSITION")], axis=1)  # normals do not move
        for first in range(0, count, _ROWS):
            rows = slice(first, first + _ROWS)
            for k in range(joints.shape[1]):
                at = np.einsum("nij,nj->ni", pose[joints[rows, k], :3], whole[rows])
                moved[rows] += shares[rows, k, None] / total[rows] * at
        return moved

    def _per_vertex(self, index: int, kinds: Sequence[str], count: int) -> NDArray:
        values = self.data.array(index, kinds)
        if len(values) != count:
            raise ValueError(f"accessors[{index}] has {len(values)} values, {count} vertices")
        return values

    def _texcoord(self, name: str, key: str) -> int:
        """Which set of texture coordinates a material reads for its ``baseColorTexture`` or ``emissiveTexture``."""
        if name == "none":
            return 0
        material = self.document["materials"][int(name)]
        texture = {**_base(material), "emissiveTexture": material.get("emissiveTexture", {})}.get(key, {})
        return count_of(
            texture.get("extensions", {}).get("KHR_texture_transform", {}).get("texCoord", texture.get("texCoord", 0))
        )

    def _nodes(self) -> tuple[list[dict[str, Any]], list[int]]:
        """Nodes with nothing but places and meshes, and the roots of the scene that is shown."""
        given = self.document.get("nodes", [])
        check_counts(self.folder, {"nodes": (len(given), MAX_PARTS)})
        below = [[index_of(child) for child in node.get("children", [])] for node in given]
        scenes = self.document.get("scenes", [])
        if scenes:
            roots = [index_of(node) for node in scenes[index_of(self.document.get("scene", 0))].get("nodes", [])]
        else:
            roots = sorted(set(range(len(given))) - {child for children in below for child in children})
        seen, level, depth = set[int](), roots, 0
        while level:
            if seen & set(level) or len(set(level)) < len(level):
                raise ValueError("a node is its own ancestor or has two parents")
            if depth >= _MAX_DEPTH:
                raise DataError(f"{self.path}: nodes are nested deeper than {_MAX_DEPTH}; expected fewer levels")
            seen |= set(level)
            level, depth = [child for node in level for child in below[node]], depth + 1
        nodes = []
        for i, node in enumerate(given):
            plain: dict[str, Any] = {
                k: [finite(x) for x in node[k]] for k in ("matrix", "translation", "rotation", "scale") if k in node
            }
            if [len(plain[k]) for k in plain] != [{"matrix": 16, "rotation": 4}.get(k, 3) for k in plain]:
                raise ValueError(f"nodes[{i}] has a transform of another length")
            plain |= {"name": f"node {i}", "children": below[i]}
            nodes.append(plain)
        parents = {child: node for node, children in enumerate(below) for child in children}
        for i, node in enumerate(given):
            if "mesh" not in node or i not in seen:
                continue
            mesh, pose = index_of(node["mesh"]), None
            if "skin" in node:
                pose = self._pose(self.document["skins"][index_of(node["skin"])], nodes, parents)
            if pose is not None or "weights" in node:
                one = self.document["meshes"][mesh]
                self.meshes.append(self._mesh(one, node.get("weights", one.get("weights", [])), pose))
                mesh = len(self.meshes) - 1
            if not self.meshes[mesh]:
                continue
            copies = self._instances(node.get("extensions", {}).get("EXT_mesh_gpu_instancing"))
            if pose is not None:  # a skin is where its joints are
                roots, copies = [*roots, len(nodes)], []
                nodes.append({"name": f"skin {i}", "mesh": mesh})
            elif copies is None:
                nodes[i]["mesh"] = mesh
            else:
                check_counts(self.folder, {"nodes": (len(nodes) + len(copies), MAX_PARTS)})
                nodes[i]["children"] = [*below[i], *range(len(nodes), len(nodes) + len(copies))]
                nodes += [{**copy, "name": f"node {i} instance {k}", "mesh": mesh} for k, copy in enumerate(copies)]
        return nodes, roots

    def _instances(self, instancing: Mapping[str, Any] | None) -> list[dict[str, list[float]]] | None:
        """The places of the copies of a mesh below its node; None for the mesh itself."""
        if instancing is None:
            return None
        found: dict[str, NDArray] = {}
        for name, kind in (("TRANSLATION", "VEC3"), ("ROTATION", "VEC4"), ("SCALE", "VEC3")):
            if name in instancing["attributes"]:
                values = self.data.array(instancing["attributes"][name], [kind]).astype(np.float64)
                if not np.isfinite(values).all():
                    raise ValueError(f"{name} of an instance is no number")
                found[name.lower()] = values
        lengths = {len(values) for values in found.values()}
        if len(lengths) != 1:
            raise ValueError(f"instances have {sorted(lengths) or 'no'} places")
        return [{name: values[k].tolist() for name, values in found.items()} for k in range(lengths.pop())]

    def _pose(
        self, skin: Mapping[str, Any], nodes: Sequence[Mapping[str, Any]], parents: Mapping[int, int]
    ) -> NDArray[np.float64]:
        """(J, 4, 4) from the place where a vertex was bound to each joint to where the joint is."""
        joints = [index_of(joint) for joint in skin["joints"]]
        inverse = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
        if "inverseBindMatrices" in skin:
            inverse = (
                self.data.array(skin["inverseBindMatrices"], ["MAT4"])
                .reshape(-1, 4, 4)
                .transpose(0, 2, 1)[: len(joints)]
            )
        return np.stack([_world(joint, nodes, parents) for joint in joints]) @ inverse

    # ------------------------------------------------------------ colours

    def _material(self, material: Mapping[str, Any]) -> Material:
        base, extensions = _base(material), material.get("extensions", {})
        factor = [finite(x) for x in base.get("baseColorFactor", _WHITE)]
        mode = material.get("alphaMode", "OPAQUE")
        cutoff = None if mode == "OPAQUE" else finite(material.get("alphaCutoff", 0.5)) if mode == "MASK" else 0.5
        opacity = factor[3] if len(factor) > 3 and mode != "OPAQUE" else 1.0
        strength = finite(extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0))
        light = [strength * finite(x) for x in material.get("emissiveFactor", (0.0, 0.0, 0.0))]
        glow = self._textured(light, material.get("emissiveTexture")) if any(light) else None
        look = self._textured(factor, base.get("baseColorTexture"))
        unlit = "KHR_materials_unlit" in extensions
        return replace(look, opacity=opacity, cutoff=cutoff, blend=mode == "BLEND", glow=glow, unlit=unlit)

    def _textured(self, factor: Sequence[float], place: Mapping[str, Any] | None) -> Material:
        """A colour and the texture that it goes with."""
        colour = (factor[0], factor[1], factor[2])
        if place is None:
            return Material(colour)
        texture = self.document["textures"][index_of(place["index"])]
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
        if source is None:
            found = ", ".join(texture.get("extensions", {})) or "no image"
            raise DataError(f"{self.path}: a texture has {found[:60]}, which is not read; expected PNG, JPEG or WebP")
        name = self._image(index_of(source))
        sampler: Mapping[str, int] = (
            self.document["samplers"][index_of(texture["sampler"])] if "sampler" in texture else {}
        )
        wrap = _WRAPS.get(sampler.get("wrapS", 0), "repeat"), _WRAPS.get(sampler.get("wrapT", 0), "repeat")
        moved = place.get("extensions", {}).get("KHR_texture_transform")
        return Material(colour, name, wrap, None if moved is None else _moved(moved))

    def _image(self, index: int) -> str | None:
        """The image's name among the model's; None where it is missing and that is allowed."""
        name = f"image {index}"
        if name not in self.images:
            image = self.document["images"][index]
            data = (
                self.folder.optional([file_name(image["uri"])], "texture")
                if "uri" in image
                else self.data.view(image["bufferView"])[0]
            )
            if data is None:
                return None
            self.images[name] = data
        return name


def _base(material: Mapping[str, Any]) -> Mapping[str, Any]:
    """Base colour and its texture, of either of the two ways to say it; where a material has both, the extension
    wins."""
    glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if glossy is None:
        return material.get("pbrMetallicRoughness", {})
    renamed = {"diffuseFactor": "baseColorFactor", "diffuseTexture": "baseColorTexture"}
    return {renamed[k]: v for k, v in glossy.items() if k in renamed}


def _world(node: int, nodes: Sequence[Mapping[str, Any]], parents: Mapping[int, int]) -> NDArray[np.float64]:
    """(4, 4) of a node in the scene."""
    found = np.eye(4)
    for _ in range(_MAX_DEPTH):
        place, own = nodes[node], np.eye(4)
        x, y, z, w = place.get("rotation", (0.0, 0.0, 0.0, 1.0))
        own[:3, :3] = trimesh.transformations.quaternion_matrix([w, x, y, z])[:3, :3] * place.get(
            "scale", (1.0, 1.0, 1.0)
        )
        own[:3, 3] = place.get("translation", (0.0, 0.0, 0.0))
        found = np.reshape(place.get("matrix", np.eye(4)), (4, 4)).T @ own @ found
        if node not in parents:
            return found
        node = parents[node]
    raise ValueError("a joint is its own ancestor")


def _moved(transform: Mapping[str, Any]) -> tuple[tuple[float, ...], ...]:
    """(2, 3) of KHR_texture_transform: scale, then rotation, then offset."""
    (x, y), (u, v) = transform.get("offset", (0.0, 0.0)), transform.get("scale", (1.0, 1.0))
    c, s = math.cos(transform.get("rotation", 0.0)), math.sin(transform.get("rotation", 0.0))
    rows = ((c * u, s * v, x), (-s * u, c * v, y))
    return tuple(tuple(finite(value) for value in row) for row in rows)
