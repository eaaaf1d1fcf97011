"""Path traced images for relighting: solids of plastic, gold, copper and sheen on a checkered slab, by Mitsuba 3.

    pip install -e '.[path-tracing]'
    python benchmarks/path_traced.py DIR [--size 160] [--train 240] [--test 32] [--samples 64]
    python benchmarks/quality.py DIR/path_traced-KEY --seconds 120

writes a data set in the layout of `scene=olat`, unless it is there: meshes, cameras and lights are those of
`lit_solids`, materials and light are not: light arrives from other surfaces too, metals reflect them. It is generated
data, as its files say. Mitsuba's variant `scalar_rgb` needs no other libraries; 272 images of 160x160 take five
minutes of one core. Images depend on settings, the version of Mitsuba and GENERATOR_VERSION alone.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import mitsuba
import numpy as np
import torch
import trimesh
from rich.progress import track
from shared.arguments import make_parser

from neuprim.core.io.exr import write_exr
from neuprim.scenes.image_set import hash_scene_settings, scene_camera_pose, write_scene_folder
from neuprim.scenes.lit import FIELD_OF_VIEW, INTENSITY, LitView, build_lit_solids, place_cameras_and_lights
from neuprim.scenes.shapes import Solid, solid_corner_normals

mitsuba.set_variant("scalar_rgb")

GENERATOR_VERSION = 1
_CHECK = 0.12  # edge of a check, scene units
_DEPTH = 8  # most surfaces that light meets on its way
_MATERIALS: dict[str, dict[str, Any]] = {
    "glossy ring": {"type": "roughconductor", "material": "Au", "alpha": 0.2},
    "chuck": {"type": "roughconductor", "material": "Cu", "alpha": 0.3},
    "grip": {"type": "principled", "roughness": 0.8, "sheen": 1.0, "sheen_tint": 0.5},
    "banana": {"type": "principled", "roughness": 0.7, "sheen": 1.0},
}
"""Of solids that are not of plastic."""


@dataclass(frozen=True)
class PathTracedSettings:
    """Pixels a side, images of each split, and paths per pixel."""

    size: int
    train: int
    test: int
    samples: int
    mitsuba: str = mitsuba.__version__


def colour_of(solid: Solid) -> dict[str, Any]:
    """Its colour at the middle of its faces; checks on the slab."""
    red, green, blue = solid.albedo(solid.mesh.triangles_center.astype(np.float32)).mean(0).tolist()
    found: dict[str, Any] = {"type": "rgb", "value": [red, green, blue]}
    dark = {"type": "rgb", "value": [0.12, 0.14, 0.2]}
    if solid.name == "slab":
        return {"type": "checkerboard", "color0": found, "color1": dark}
    return found


def material_of(solid: Solid) -> dict[str, Any]:
    found = dict(_MATERIALS.get(solid.name, {"type": "roughplastic", "alpha": 0.08 + 0.35 * (1 - solid.gloss)}))
    if found["type"] == "principled":
        found["base_color"] = colour_of(solid)
    elif found["type"] == "roughplastic":
        found["diffuse_reflectance"] = colour_of(solid)
    return found


def write_solid(solid: Solid, path: Path) -> None:
    """A PLY file whose corners have normals and texture coordinates: their place on the floor in pairs of checks."""
    points = solid.mesh.triangles.reshape(-1, 3)
    normals = solid_corner_normals(solid.mesh) if solid.normals is None else solid.normals
    mesh = trimesh.Trimesh(
        points, np.arange(len(points)).reshape(-1, 3), vertex_normals=normals.reshape(-1, 3), process=False
    )
    for name, axis in (("u", 0), ("v", 1)):
        mesh.vertex_attributes[name] = (points[:, axis] / (2 * _CHECK)).astype(np.float32)
    path.write_bytes(trimesh.exchange.ply.export_ply(mesh, vertex_normal=True, include_attributes=True))


def load_solids(folder: Path) -> dict[str, Any]:
    """Mitsuba's shapes of all solids."""
    shapes = {}
    for number, solid in enumerate(build_lit_solids()):
        path = folder / f"{number}.ply"
        write_solid(solid, path)
        shapes[f"solid_{number}"] = mitsuba.load_dict(
            {"type": "ply", "filename": str(path), "bsdf": {"type": "twosided", "bsdf": material_of(solid)}}
        )
    return shapes


def trace_view(shapes: dict[str, Any], view: LitView, size: int, samples: int) -> torch.Tensor:
    """(size, size, 4) linear radiance, premultiplied, and coverage."""
    pose = mitsuba.ScalarTransform4f((scene_camera_pose(view.camera) @ np.diag([-1.0, 1.0, -1.0, 1.0])).tolist())
    film = {"type": "hdrfilm", "width": size, "height": size, "pixel_format": "rgba", "filter": {"type": "box"}}
    scene = mitsuba.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": _DEPTH},
            "camera": {
                "type": "perspective",
                "fov": float(np.degrees(FIELD_OF_VIEW)),
                "to_world": pose,
                "film": film,
                "sampler": {"type": "independent", "sample_count": samples},
            },
            "light": {
                "type": "point",
                "position": view.light.tolist(),
                "intensity": {"type": "rgb", "value": INTENSITY},
            },
            **shapes,
        }
    )
    traced: Any = mitsuba.render(scene)
    return torch.from_numpy(np.array(traced, np.float32))


def write_images(folder: Path, settings: PathTracedSettings) -> None:
    splits = place_cameras_and_lights(settings.train, settings.test)
    with TemporaryDirectory() as work:
        shapes = load_solids(Path(work))
    for split in ("train", "test"):
        (folder / split).mkdir()
        frames = []
        for view in track(splits[split], description=f"{split} images"):
            image = trace_view(shapes, view, settings.size, settings.samples)
            write_exr(folder / split / f"{view.name}.exr", image, half=True)
            light = {"pl_pos": view.light.tolist(), "pl_intensity": [INTENSITY] * 3}
            pose = scene_camera_pose(view.camera).tolist()
            place = {"file_path": f"./{split}/{view.name}", "file_ext": ".exr"}
            frames.append({**place, "transform_matrix": pose, **light})
        how = f"path traced by Mitsuba {settings.mitsuba}, {settings.samples} paths a pixel"
        document = {"generated": how, "camera_angle_x": FIELD_OF_VIEW, "frames": frames}
        (folder / f"transforms_{split}.json").write_text(json.dumps(document, indent=1), encoding="utf-8")


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("folder", type=Path, metavar="DIR")
    for name, default in (("size", 160), ("train", 240), ("test", 32), ("samples", 64)):
        parser.add_argument(f"--{name}", type=int, default=default)
    args = parser.parse_args()
    settings = PathTracedSettings(args.size, args.train, args.test, args.samples)
    folder = args.folder / f"path_traced-{hash_scene_settings(settings, GENERATOR_VERSION)}"
    files = [f"transforms_{split}.json" for split in ("train", "test")]
    print(write_scene_folder(folder, files, lambda draft: write_images(draft, settings), "cannot write the images"))


if __name__ == "__main__":
    main()
