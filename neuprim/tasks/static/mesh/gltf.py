"""Reader of materials and triangles from glTF 2 (.gltf, .glb). Animations, lights and cameras are ignored."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray

from neuprim.core.errors import DataError, warn_once
from neuprim.tasks.static.mesh.gltf_document import (
    DRACO,
    GltfDocument,
    finite_gltf_number,
    parse_gltf_uri,
    refuse_damaged_gltf,
    to_gltf_index,
)
from neuprim.tasks.static.mesh.model import (
    MAX_FACES,
    MAX_PARTS,
    MAX_VERTICES,
    Faces,
    Material,
    MeshFolder,
    Model,
    check_mesh_limits,
    check_vertices,
)

_WRAPS = {33071: "clamp", 33648: "mirror"}
_POINTS_AND_LINES, _TRIANGLES, _STRIP, _FAN = (0, 1, 2, 3), 4, 5, 6
_MAX_DEPTH = 200
_MAX_JOINTS = 32  # per vertex
_ROWS = 50_000  # vertices that are skinned at once, which bounds the memory


class _GltfPrimitive(NamedTuple):
    """Triangles of a glTF primitive, which is a part of a mesh with one material.

    ``faces`` (F, 3) has vertex indices; the other arrays have one row per vertex. Positions and normals are in mesh
    coordinates, except in skinned meshes, where positions and normals are in scene coordinates.
    """

    material: str
    faces: NDArray[np.int64]
    positions: NDArray[np.float64]
    normals: NDArray[np.float64] | None
    colour: NDArray[np.float32] | None
    uv: NDArray[np.float32] | None
    glow_uv: NDArray[np.float32] | None


def read_gltf(folder: MeshFolder) -> Model:
    """Read the .gltf or .glb file of ``folder``.

    Raises DataError if the file is damaged, compressed or has an invalid reference.
    """

    def read() -> Model:
        reader = _GltfReader(GltfDocument(folder))
        materials = {str(i): reader.read_material(m) for i, m in enumerate(reader.document.entries("materials"))}
        materials["none"] = Material()
        faces = partial(refuse_damaged_gltf, folder.file, partial(reader.read_faces, materials))
        return Model(folder.file, faces, folder.digest, materials, reader.images, "y", True)

    return refuse_damaged_gltf(folder.file, read)


class _GltfReader:
    """Reader of the materials and triangles of one glTF document."""

    def __init__(self, document: GltfDocument) -> None:
        self.document, self.path = document, document.path
        self.images: dict[str, bytes] = {}
        self.vertices = self.triangles = self.parts = self.skipped = 0

    def read_faces(self, materials: Mapping[str, Material]) -> tuple[list[Faces], int]:
        """Return all triangles of the document's default scene, in scene coordinates, and the number of vertices."""
        nodes = self.document.entries("nodes")
        check_mesh_limits(self.path, {"nodes": (len(nodes), MAX_PARTS)})
        matrices = self._node_matrices(nodes)
        found: list[Faces] = []
        plain: dict[int, list[_GltfPrimitive]] = {}
        for i, matrix in matrices.items():
            node = nodes[i]
            if "mesh" not in node:
                continue
            number, places = to_gltf_index(node["mesh"]), [np.eye(4)]
            if "skin" in node:  # joints alone place a skinned mesh, not its node
                pose = self._joint_matrices(self.document.content["skins"][to_gltf_index(node["skin"])], matrices)
                primitives = self._read_gltf_mesh(number, node, materials, pose)
            else:
                places = self._instance_matrices(node, matrix)
                if number in plain and "weights" not in node:
                    primitives = plain[number]
                else:
                    primitives = self._read_gltf_mesh(number, node, materials)
                    if "weights" not in node:
                        plain[number] = primitives
            for place in places:
                for primitive in primitives:
                    self._count_primitive(primitive)
                    if len(primitive.faces):
                        found.append(self._place_primitive(primitive, place))
        if self.skipped:
            warn_once(f"{self.path}: {self.skipped} parts are points or lines; only triangles are drawn")
        return found, self.vertices

    def _count_primitive(self, primitive: _GltfPrimitive) -> None:
        """Add one use of a glTF primitive to the totals of vertices, triangles and parts; DataError above a limit."""
        self.vertices += len(primitive.positions)
        self.triangles += len(primitive.faces)
        self.parts += 1
        vertices, faces, parts = (self.vertices, MAX_VERTICES), (self.triangles, MAX_FACES), (self.parts, MAX_PARTS)
        check_mesh_limits(self.path, {"vertices": vertices, "faces": faces, "parts": parts})

    def _read_gltf_mesh(
        self, number: int, node: Mapping[str, Any], materials: Mapping[str, Material], pose: NDArray | None = None
    ) -> list[_GltfPrimitive]:
        """Return the triangles of mesh ``number``, which ``node`` uses.

        ``pose`` has the (J, 4, 4) joint matrices of a skinned mesh; None for other meshes.
        """
        mesh = self.document.content["meshes"][number]
        weights = [finite_gltf_number(w) for w in node.get("weights", mesh.get("weights", []))]
        found = []
        for primitive in mesh["primitives"]:
            mode = primitive.get("mode", _TRIANGLES)
            if mode in _POINTS_AND_LINES:
                self.skipped += 1
                continue
            if mode not in (_TRIANGLES, _STRIP, _FAN):
                raise ValueError(f"a primitive has the unknown mode {mode}")
            position = self.document.content["accessors"][to_gltf_index(primitive["attributes"]["POSITION"])]
            if DRACO in primitive.get("extensions", {}) and "bufferView" not in position:
                raise self.document.unsupported(DRACO)
            found.append(self._read_primitive(primitive, materials, weights, pose))
        return found

    def _read_primitive(
        self,
        primitive: Mapping[str, Any],
        materials: Mapping[str, Material],
        weights: Sequence[float],
        pose: NDArray | None,
    ) -> _GltfPrimitive:
        attributes: Mapping[str, int] = primitive["attributes"]
        positions = self.document.array(attributes["POSITION"], ["VEC3"])
        count = len(positions)
        index = np.arange(count)
        if "indices" in primitive:
            index = self.document.array(primitive["indices"], ["SCALAR"])[:, 0]
        check_mesh_limits(self.path, {"vertices": (count, MAX_VERTICES), "faces": (len(index) // 3, MAX_FACES)})
        if index.dtype.kind == "f" or (len(index) and index.max() >= count):
            raise ValueError(f"a face uses vertex {index.max()}, but there are only {count} vertices")
        name = str(to_gltf_index(primitive["material"])) if "material" in primitive else "none"
        material = materials[name]
        normals, colour, uv, glow_uv = None, None, None, None
        if "NORMAL" in attributes:
            given = self.document.array(attributes["NORMAL"], ["VEC3"], count)
            normals = self._pose_vertices(primitive, "NORMAL", given, weights, pose)
        if "COLOR_0" in attributes:
            colour = self.document.array(attributes["COLOR_0"], ["VEC3", "VEC4"], count)
            colour = (colour / np.float32(1 if colour.dtype.kind == "f" else np.iinfo(colour.dtype).max)).astype("f4")
        if material.texture is not None:
            uv = self._texture_coordinates(primitive, name, "baseColorTexture")
        if material.glow is not None and material.glow.texture is not None:
            glow_uv = self._texture_coordinates(primitive, name, "emissiveTexture")
        positions = self._pose_vertices(primitive, "POSITION", positions, weights, pose)
        faces = _index_triangles(index.astype(np.int64), primitive.get("mode", _TRIANGLES))
        return _GltfPrimitive(name, faces, positions, normals, colour, uv, glow_uv)

    def _texture_coordinates(self, primitive: Mapping[str, Any], name: str, key: str) -> NDArray[np.float32] | None:
        """Return the (V, 2) coordinates of a glTF primitive for one texture, v upward; None if they are missing.

        ``name`` is the index of the material, as text. ``key`` is the texture's glTF name, e.g. "emissiveTexture".
        """
        material = self.document.content["materials"][int(name)]
        texture = {**_gltf_base_colour(material), "emissiveTexture": material.get("emissiveTexture", {})}.get(key, {})
        moved = texture.get("extensions", {}).get("KHR_texture_transform", {})
        attribute = f"TEXCOORD_{to_gltf_index(moved.get('texCoord', texture.get('texCoord', 0)))}"
        attributes = primitive["attributes"]
        if attribute not in attributes:
            return None
        count = to_gltf_index(self.document.content["accessors"][attributes["POSITION"]]["count"])
        uv = self.document.array(attributes[attribute], ["VEC2"], count).astype(np.float32)
        uv[:, 1] = 1 - uv[:, 1]
        return uv

    def _pose_vertices(
        self, primitive: Mapping[str, Any], name: str, values: NDArray, weights: Sequence[float], pose: NDArray | None
    ) -> NDArray[np.float64]:
        """Apply morph targets, then skinning, to ``values`` (V, 3): positions or normals, as ``name`` says.

        ``name`` is "POSITION" or "NORMAL". ``weights`` are the weights of the morph targets. ``pose`` has the (J, 4, 4)
        joint matrices; None for no skinning.
        """
        count = len(values)
        for weight, target in zip(weights, primitive.get("targets", []), strict=False):
            if weight and name in target:
                values = values + weight * self.document.array(target[name], ["VEC3"], count)
        if pose is None:
            return values.astype(np.float64)
        attributes = primitive["attributes"]
        sets = [i for i in range(_MAX_JOINTS // 4) if f"JOINTS_{i}" in attributes]
        joints, shares = (
            np.concatenate([self.document.array(attributes[f"{key}_{i}"], ["VEC4"], count) for i in sets], axis=1)
            for key in ("JOINTS", "WEIGHTS")
        )
        joints = joints.astype(np.int64)
        shares = shares / np.maximum(shares.sum(axis=1, keepdims=True), 1e-9)
        # w is 0 for normals, which are not translated
        homogeneous = np.concatenate([values, np.full((count, 1), name == "POSITION")], axis=1)
        moved = np.zeros((count, 3))
        for first in range(0, count, _ROWS):
            rows = slice(first, first + _ROWS)
            for k in range(joints.shape[1]):
                at = np.einsum("nij,nj->ni", pose[joints[rows, k], :3], homogeneous[rows])
                moved[rows] += shares[rows, k, None] * at
        return moved

    def _place_primitive(self, primitive: _GltfPrimitive, matrix: NDArray[np.float64]) -> Faces:
        """Return the triangles of a glTF primitive, transformed by ``matrix`` (4, 4) to scene coordinates."""
        faces = primitive.faces
        with np.errstate(all="ignore"):
            positions = primitive.positions @ matrix[:3, :3].T + matrix[:3, 3]
            normals = None if primitive.normals is None else primitive.normals @ np.linalg.pinv(matrix[:3, :3])
        check_vertices(self.path, positions, faces)
        values: tuple[NDArray | None, ...] = (normals, primitive.colour, primitive.uv, primitive.glow_uv)
        of_corners = (None if value is None else value[faces] for value in values)
        return Faces(positions[faces], primitive.material, *of_corners)

    def _node_matrices(self, nodes: Sequence[Mapping[str, Any]]) -> dict[int, NDArray[np.float64]]:
        """Return node index -> (4, 4) scene-from-node matrix, for the nodes of the default scene."""
        children = [[to_gltf_index(child) for child in node.get("children", [])] for node in nodes]
        scenes = self.document.entries("scenes")
        if scenes:
            shown = scenes[to_gltf_index(self.document.content.get("scene", 0))]
            roots = [to_gltf_index(node) for node in shown.get("nodes", [])]
        else:
            roots = sorted(set(range(len(nodes))) - {child for below in children for child in below})
        found: dict[int, NDArray[np.float64]] = {}
        stack = [(root, np.eye(4), 1) for root in roots]
        while stack:
            node, parent, depth = stack.pop()
            if node in found:
                raise ValueError("a node is its own ancestor or has two parents")
            if depth > _MAX_DEPTH:
                raise DataError(f"{self.path}: nodes are nested deeper than {_MAX_DEPTH}; expected fewer levels")
            found[node] = parent @ _node_matrix(nodes[node], f"nodes[{node}]")
            stack += [(child, found[node], depth + 1) for child in children[node]]
        return found

    def _instance_matrices(self, node: Mapping[str, Any], matrix: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """Return (4, 4) scene-from-mesh matrices: one per instance (EXT_mesh_gpu_instancing), or the node's matrix."""
        instancing = node.get("extensions", {}).get("EXT_mesh_gpu_instancing")
        if instancing is None:
            return [matrix]
        columns = {
            name.lower(): self.document.array(instancing["attributes"][name], [kind]).astype(np.float64).tolist()
            for name, kind in (("TRANSLATION", "VEC3"), ("ROTATION", "VEC4"), ("SCALE", "VEC3"))
            if name in instancing["attributes"]
        }
        lengths = {len(values) for values in columns.values()}
        if len(lengths) != 1:
            raise ValueError(f"attributes of instances have different or no lengths: {sorted(lengths) or 'no'} values")
        count = lengths.pop()
        check_mesh_limits(self.path, {"instances": (count, MAX_PARTS)})
        places = [{name: values[k] for name, values in columns.items()} for k in range(count)]
        return [matrix @ _node_matrix(place, "an instance") for place in places]

    def _joint_matrices(self, skin: Mapping[str, Any], matrices: Mapping[int, NDArray]) -> NDArray[np.float64]:
        """Return (J, 4, 4) skinning matrices: joint transforms times inverse bind matrices."""
        joints = [to_gltf_index(joint) for joint in skin["joints"]]
        outside = [joint for joint in joints if joint not in matrices]
        if outside:
            raise ValueError(f"joint {outside[0]} is outside of the scene")
        inverse = np.broadcast_to(np.eye(4), (len(joints), 4, 4))
        if "inverseBindMatrices" in skin:
            columns = self.document.array(skin["inverseBindMatrices"], ["MAT4"]).reshape(-1, 4, 4)
            inverse = columns.transpose(0, 2, 1)[: len(joints)]
        return np.stack([matrices[joint] for joint in joints]) @ inverse

    def read_material(self, material: Mapping[str, Any]) -> Material:
        """Convert a JSON material to :class:`Material`; the bytes of its textures are added to :attr:`images`."""
        base, extensions = _gltf_base_colour(material), material.get("extensions", {})
        factor = [finite_gltf_number(x) for x in base.get("baseColorFactor", (1.0, 1.0, 1.0))]
        mode = material.get("alphaMode", "OPAQUE")
        cutoff = finite_gltf_number(material.get("alphaCutoff", 0.5)) if mode == "MASK" else 0.5
        opacity = factor[3] if len(factor) > 3 and mode != "OPAQUE" else 1.0
        strength = finite_gltf_number(
            extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
        )
        light = [strength * finite_gltf_number(x) for x in material.get("emissiveFactor", (0.0, 0.0, 0.0))]
        glow = self._textured_material(light, material.get("emissiveTexture")) if any(light) else None
        found = self._textured_material(factor, base.get("baseColorTexture"))
        unlit = "KHR_materials_unlit" in extensions
        found = replace(found, opacity=opacity, cutoff=None if mode == "OPAQUE" else cutoff)
        return replace(found, blend=mode == "BLEND", glow=glow, unlit=unlit)

    def _textured_material(self, factor: Sequence[float], texture_info: Mapping[str, Any] | None) -> Material:
        """Return a material with a colour factor and, if given, the texture that the factor multiplies."""
        colour = (factor[0], factor[1], factor[2])
        if texture_info is None:
            return Material(colour)
        texture = self.document.content["textures"][to_gltf_index(texture_info["index"])]
        source = texture.get("extensions", {}).get("EXT_texture_webp", texture).get("source")
        if source is None:
            found = ", ".join(texture.get("extensions", {})) or "no image"
            raise DataError(f"{self.path}: a texture has {found[:60]}; expected PNG, JPEG or WebP")
        sampler: Mapping[str, int] = {}
        if "sampler" in texture:
            sampler = self.document.content["samplers"][to_gltf_index(texture["sampler"])]
        wrap = _WRAPS.get(sampler.get("wrapS", 0), "repeat"), _WRAPS.get(sampler.get("wrapT", 0), "repeat")
        moved = texture_info.get("extensions", {}).get("KHR_texture_transform")
        transform = None if moved is None else _texture_transform(moved)
        return Material(colour, self._read_gltf_image(to_gltf_index(source)), wrap, transform)

    def _read_gltf_image(self, index: int) -> str | None:
        """Read an image; return its key in :attr:`images`, or None if it is missing and ``skip_missing`` is set."""
        name = f"image {index}"
        if name not in self.images:
            image = self.document.content["images"][index]
            if "uri" in image:
                data = self.document.folder.read_optional([parse_gltf_uri(image["uri"])], "texture")
            else:
                data = self.document.view(image["bufferView"])[0]
            if data is None:
                return None
            self.images[name] = data
        return name


def _gltf_base_colour(material: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the ``pbrMetallicRoughness`` values of a JSON material, among them the base colour and its texture.

    If the material has the specular-glossiness extension, the result has only the extension's diffuse colour and
    texture, renamed to ``baseColorFactor`` and ``baseColorTexture``.
    """
    glossy = material.get("extensions", {}).get("KHR_materials_pbrSpecularGlossiness")
    if glossy is None:
        return material.get("pbrMetallicRoughness", {})
    renamed = {"diffuseFactor": "baseColorFactor", "diffuseTexture": "baseColorTexture"}
    return {renamed[k]: v for k, v in glossy.items() if k in renamed}


def _node_matrix(place: Mapping[str, Any], where: str) -> NDArray[np.float64]:
    """Return the (4, 4) parent-from-node matrix of a node, from its matrix or its translation, rotation and scale."""
    matrix = np.eye(4)
    lengths = {"matrix": 16, "translation": 3, "rotation": 4, "scale": 3}
    numbers = {key: [finite_gltf_number(x) for x in place[key]] for key in lengths if key in place}
    if any(len(values) != lengths[key] for key, values in numbers.items()):
        raise ValueError(f"{where} has a transform with a wrong number of values")
    if "matrix" in numbers:
        matrix = np.reshape(numbers["matrix"], (4, 4)).T
    if "translation" in numbers:
        matrix = matrix @ trimesh.transformations.translation_matrix(numbers["translation"])
    if "rotation" in numbers:
        x, y, z, w = numbers["rotation"]
        matrix = matrix @ trimesh.transformations.quaternion_matrix([w, x, y, z])
    if "scale" in numbers:
        matrix = matrix @ np.diag([*numbers["scale"], 1.0])
    return matrix


def _index_triangles(index: NDArray[np.int64], mode: int) -> NDArray[np.int64]:
    """Convert the indices of a triangle list, strip or fan (``mode``) to (F, 3) vertex indices."""
    if mode == _TRIANGLES:
        return index[: len(index) // 3 * 3].reshape(-1, 3)
    count = max(len(index) - 2, 0)
    if mode == _FAN:
        return np.stack([np.repeat(index[:1], count), index[1:-1][:count], index[2:]], axis=1)
    strip = np.stack([index[:count], index[1 : count + 1], index[2:]], axis=1)
    strip[1::2] = strip[1::2, ::-1]  # every other triangle of a strip turns the other way
    return strip


def _texture_transform(transform: Mapping[str, Any]) -> tuple[tuple[float, ...], ...]:
    """Return the (2, 3) matrix of KHR_texture_transform: scale, then rotation, then offset."""
    (x, y), (u, v) = transform.get("offset", (0.0, 0.0)), transform.get("scale", (1.0, 1.0))
    c, s = math.cos(transform.get("rotation", 0.0)), math.sin(transform.get("rotation", 0.0))
    rows = ((c * u, s * v, x), (-s * u, c * v, y))
    return tuple(tuple(finite_gltf_number(value) for value in row) for row in rows)
