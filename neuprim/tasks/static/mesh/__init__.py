"""The scene ``mesh``: a user's mesh file, ray-cast with the cameras and dimmed light of the scene ``solids``."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray

from neuprim.core.cameras.world import World
from neuprim.core.data import Dataset
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.task import SceneContext
from neuprim.core.validation import nonempty_text, validate_settings
from neuprim.scenes.image_set import Progress, hash_scene_settings
from neuprim.scenes.raycast import Scene
from neuprim.scenes.shading import DAYLIGHT, Daylight, scene_daylight_radiance
from neuprim.scenes.solids import FIELD_OF_VIEW, Radiance, SolidsSettings, describe_solids_images
from neuprim.tasks.static.mesh.gltf import read_gltf
from neuprim.tasks.static.mesh.model import MeshFolder, Model, Up, find_model_file
from neuprim.tasks.static.mesh.obj_ply_stl import read_obj, read_ply_mesh, read_stl
from neuprim.tasks.static.mesh.surface import MeshSurface, read_surfaces

# Part of the cache key: raise it with every change to how meshes are read, placed, lit or viewed.
GENERATOR_VERSION = 2

MODEL_READERS: dict[str, Callable[[MeshFolder], Model]] = {".glb": read_gltf, ".gltf": read_gltf, ".obj": read_obj}
MODEL_READERS |= {".ply": read_ply_mesh, ".stl": read_stl}


# the daylight of the solids, dimmed so that white in the sun stays within the display range
_COLOURS = (DAYLIGHT.sun, DAYLIGHT.sky, DAYLIGHT.ground)
LIGHT = Daylight(DAYLIGHT.direction, *((0.8 * r, 0.8 * g, 0.8 * b) for r, g, b in _COLOURS))


@dataclass(frozen=True)
class MeshSettings(SolidsSettings):
    """Settings of ``scene=mesh`` in addition to those of ``scene=solids``."""

    # the model, .glb, .gltf, .obj, .ply or .stl
    path: Annotated[Path, nonempty_text("the model's file")] = field(kw_only=True)
    # axis of the file that points up; "auto" is y for glTF and OBJ, z for PLY and STL
    up: Literal["auto", "y", "z"] = "auto"
    # "daylight" (sun with shadows and a soft sky) or "flat" (unlit colours)
    shading: Literal["daylight", "flat"] = "daylight"
    skip_missing: bool = False  # leave out missing or refused textures and material files instead of raising


def load_mesh(settings: Mapping[str, Any], context: SceneContext) -> Dataset:
    """Load ``scene=mesh``. The first use renders the images and stores them in the cache.

    Raises DataError if the mesh is damaged or refers to a required file outside its folder.
    """
    asked = validate_settings(MeshSettings, settings, "scene")
    folder = generate_mesh_images(asked, context.cache_dir, context.progress)
    from neuprim.tasks.static.datasets import load_blender

    known = JsonReader.open(folder / "transforms_train.json")
    facts = {name: known.values[name] for name in ("rendered_from", "scene_from_file")}
    world = World(torch.tensor(facts["scene_from_file"], dtype=torch.float64)).validate(f"{folder}: scene_from_file")
    dataset = load_blender({"path": str(folder)}, replace(context, world=None))  # its poses are in scene coordinates
    return replace(dataset, name=facts["rendered_from"], data_source="generated", world=world, extra=facts)


def generate_mesh_images(
    settings: MeshSettings, cache_dir: Path, progress: Progress = lambda text, fraction: None
) -> Path:
    """Render the images of ``scene=mesh`` unless they exist; return their folder, ``cache_dir/mesh-HASH``."""
    path = find_model_file(settings.path)
    progress(f"mesh: reading {path.name}", 0.0)
    model = MODEL_READERS[path.suffix.lower()](MeshFolder(path, settings.skip_missing))
    upward: Up = model.upward if settings.up == "auto" else settings.up
    key = hash_scene_settings(replace(settings, path=Path(f"{path.name} {model.digest}"), up=upward), GENERATOR_VERSION)
    spacing = 2 * math.tan(FIELD_OF_VIEW / 2) / (settings.size * settings.supersampling)

    def build() -> Scene:
        return MeshSurface(model, read_surfaces(model), upward, spacing)

    def facts(scene: MeshSurface) -> dict[str, Any]:
        return {"rendered_from": path.name, "scene_from_file": scene.scene_from_file.tolist()}

    seen: Radiance = (
        partial(scene_daylight_radiance, light=LIGHT) if settings.shading == "daylight" else unlit_mesh_radiance
    )
    return describe_solids_images("mesh", key, settings, build, seen, facts).generate(cache_dir, progress)


def unlit_mesh_radiance(
    scene: Scene, origins: NDArray[np.float64], directions: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Trace N rays without lighting: return (N, 3) linear RGB, zero without a hit, and an (N,) bool hit mask."""
    hits = scene.intersect(origins, directions)
    image = np.zeros(directions.shape, dtype=np.float32)
    image[hits.hit] = hits.albedo if hits.emission is None else hits.albedo + hits.emission
    return image, hits.hit
