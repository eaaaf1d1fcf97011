"""Export format ``mesh``: an isosurface of the density with vertex colours, as .glb, .ply or .obj; lossy.

The density is sampled on a grid of ``grid`` voxels along the longest side. The grid is blurred by ``smooth`` voxels, as
the hard edges of primitives would leave stairs. VTK's flying edges (Schroeder et al. 2015) extract the isosurface. By
default, :func:`find_export_surface_level` chooses the level. Connected components are left out if their area is less
than ``keep`` times the area of the largest component.

A vertex has the mean colour of the primitives around it, weighted by their density, seen from outside along its normal.
The colours are what the task's display shows, or red, green and blue, or grey. Other channels are refused. Colours are
sRGB in .ply and .obj, and linear in .glb, as glTF requires.

Coordinates are those of the run's data. A .glb is rotated from z up to glTF's y up, unless the data have y up. Far from
the origin, a .glb stores the offset in its node, since its vertices are float32, and a .ply has ``double x y z``.

The reported error is the intersection over union of silhouettes over an orbit: the mesh's silhouette against the
pixels where the model's alpha exceeds one half.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy import ndimage
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.cameras.world import World
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport
from neuprim.core.io import images
from neuprim.core.io.files import atomic_path
from neuprim.core.model.fields import Conditions
from neuprim.core.render import render
from neuprim.core.task import API_VERSION
from neuprim.core.volumes.density_grid import density_grid
from neuprim.export.shared import (
    AXES_TO_GLTF,
    ExportHarmonics,
    choose_export_views,
    closest_up_axis,
    find_export_box,
    find_export_rgb_channels,
    fit_export_harmonics,
    gltf_up_notes,
)

OPTIONS = {
    "grid": (192, "voxels along the longest side, 8 to 1024"),
    "level": (
        None,
        "extinction of the surface, 1/scene unit (default: the silhouettes that agree best with the opaque parts)",
    ),
    "smooth": (1.0, "standard deviation of the blur before contouring, voxels, 0 to 4"),
    "keep": (0.01, "least area of a piece, as a part of the largest one's"),
    "up": (
        "auto",
        "upward axis of the data, z, y, -z or -y; only .glb files are turned by it (auto: that of the scene)",
    ),
}
_SUFFIXES = (".glb", ".ply", ".obj")
_CHUNK = 2_000_000
_MOST_VOXELS = 2**29


def _write_mesh(job: ExportJob) -> ExportReport:
    path = job.out
    (conditions,) = job.frames()
    channels = job.run.channels
    hint = f", and task {job.run.task.name!r} has no display that makes these"
    rgb = None if channels.own is not None else find_export_rgb_channels(job.run, hint)
    try:
        import pyvista
    except ImportError as error:
        needed = f"--format mesh needs the package pyvista ({error}): pip install 'neuprim[mesh]'"
        raise BackendUnavailable(needed) from error
    import trimesh

    smooth, keep = job.number("smooth", 0, 4) or 0.0, job.number("keep", 0, 1) or 0.0
    up, world = job.choice("up", "auto", *AXES_TO_GLTF), job.run.world
    if up == "auto":
        up = closest_up_axis(world.world_from_scene[:3, :3].double() @ world.up)
    seen = fit_export_harmonics(job.run, conditions)
    job.progress("sampling the density", 0.0)
    sigma, scene_from_index = _sample_exported_density(job, conditions, job.count("grid", 8, 1024) or 192)
    step = float(scene_from_index[0, 0])
    given = job.number("level", 1e-9, 1e9)
    level = find_export_surface_level(sigma, step) if given is None else given
    notes = [f"surface at an extinction of {level:.4g} per scene unit" + ", chosen by silhouettes" * (given is None)]
    field = ndimage.gaussian_filter(sigma, smooth) if smooth else sigma
    job.progress("contouring", 0.3)
    image = pyvista.ImageData(dimensions=field.shape)
    image.point_data["sigma"] = field.ravel(order="F")
    surface = image.contour([level], scalars="sigma", method="flying_edges")
    if not surface.n_cells:
        densest = f"expected an extinction below {float(field.max()):.4g} per scene unit, the largest sampled"
        raise ConfigError(f"level={level:.4g}: no surface at this extinction; {densest}")
    points = np.asarray(surface.points, np.float64)
    faces = np.asarray(surface.faces).reshape(-1, 4)[:, 1:].astype(np.int64)
    mesh = trimesh.Trimesh(points @ scene_from_index[:3, :3].T + scene_from_index[:3, 3], faces, process=False)
    mesh, dropped = _drop_small_pieces(mesh, keep)
    if mesh.volume < 0:
        mesh.invert()
    job.progress("colouring", 0.5)
    vertices, normals = np.array(mesh.vertices), np.array(mesh.vertex_normals)
    colours = torch.from_numpy(_exported_vertex_colours(job, conditions, seen, vertices, normals)).float()
    colours = channels.display_rows(colours) if rgb is None else colours[:, list(rgb)]
    iou = _compare_exported_silhouettes(job, conditions, mesh)
    _save_mesh(mesh, colours, "srgb" if rgb is None else channels.color_space, path, up, world)
    notes.append(f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles; {dropped} small pieces left out")
    if channels.display_text:
        notes.append(f"colours: {channels.display_text}")
    if path.suffix.lower() == ".glb":
        notes += gltf_up_notes(up)
    return ExportReport((path,), False, {"silhouette_iou": iou}, tuple(notes))


# ---------------------------------------------------------------- surface


def _sample_exported_density(job: ExportJob, conditions: Conditions, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the model's extinction on a grid with an empty border, and the (4, 4) matrix scene_from_index.

    Without the border, the longest side of the grid has ``count`` voxels.
    """
    low, high = (v.numpy() for v in find_export_box(job, [conditions]))
    step = float((high - low).max()) / count
    shape = tuple(math.ceil(n) + 7 for n in (high - low) / step)
    if math.prod(shape) > _MOST_VOXELS:
        raise ConfigError(f"grid={count}: the grid has {math.prod(shape)} voxels; expected at most {_MOST_VOXELS}")
    matrix = np.diag([step, step, step, 1.0])
    matrix[:3, 3] = low - 3 * step
    size = (shape[0], shape[1], shape[2])
    grid = density_grid(job.run.model, conditions, torch.from_numpy(matrix), size, job.run.settings.threads)
    return grid.numpy(), matrix


def find_export_surface_level(sigma: np.ndarray, step: float) -> float:
    """Find the extinction whose isosurface best matches the opaque regions of a grid.

    Columns of voxels are compared along all three axes. The mesh covers a column if its highest extinction exceeds the
    level. The model covers a column if its optical depth exceeds ln 2 (alpha 1/2), or half of the largest optical
    depth if that is smaller. The result is the level at which mesh and model agree on the most columns.

    Args:
        sigma: (X, Y, Z) extinction, 1/scene unit.
        step: edge of a voxel, scene units.
    """
    depths = np.concatenate([(sigma.sum(a, dtype=np.float64) * step).ravel() for a in range(3)])
    peaks = np.concatenate([sigma.max(a).ravel() for a in range(3)]).astype(np.float64)
    opaque = depths > min(math.log(2), 0.5 * float(depths.max()))
    order = np.argsort(peaks)
    # with the level just below the i-th peak, columns i.. show matter: wrong are opaque ones before i and clear ones
    # from i on
    missed = np.concatenate([[0], np.cumsum(opaque[order])])
    false = np.concatenate([np.cumsum(~opaque[order][::-1])[::-1], [0]])
    i = int(np.argmin((missed + false)[:-1]))
    below = float(peaks[order[i - 1]]) if i else 0.0
    return max((below + float(peaks[order[i]])) / 2, 1e-9)


def _drop_small_pieces(mesh: Any, keep: float) -> tuple[Any, int]:
    """Remove components with less than ``keep`` times the largest component's area; return mesh and number removed."""
    import trimesh

    if keep <= 0:
        return mesh, 0
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    areas = np.bincount(labels, weights=mesh.area_faces)
    large = areas >= keep * areas.max()
    kept = mesh.submesh([np.flatnonzero(large[labels])], append=True, repair=False)
    return kept, int((~large).sum())


# ---------------------------------------------------------------- colour


def _exported_vertex_colours(
    job: ExportJob, conditions: Conditions, colours: ExportHarmonics, points: np.ndarray, normals: np.ndarray
) -> np.ndarray:
    """Return (V, C) colours of mesh vertices at ``points`` (V, 3), seen from outside along ``normals`` (V, 3).

    A vertex has the mean colour of the primitives that contain it, weighted by their densities there. Outside all
    primitives, it has the colour of the primitive with the nearest centre. ``colours`` has the primitives' colours.
    """
    with torch.no_grad():
        active = job.run.model.active(conditions)
        moved = active.geometry
        whiten = moved.rotations.double().transpose(1, 2) / moved.scales.double()[:, :, None]
        total = torch.zeros(len(points), colours.dc.shape[1], dtype=torch.float64)
        weight = torch.zeros(len(points), dtype=torch.float64)
        tree = cKDTree(points)
        around = tree.query_ball_point(moved.means.double().numpy(), moved.scales.double().amax(1).numpy())
        counts = np.array([len(a) for a in around])
        for part in np.split(np.arange(len(counts)), np.flatnonzero(np.diff(np.cumsum(counts) // _CHUNK)) + 1):
            prim = torch.from_numpy(np.repeat(part, counts[part]))
            vertex = torch.from_numpy(np.concatenate([np.asarray(around[i], np.int64) for i in part]))
            x = torch.from_numpy(points)[vertex]
            y = (whiten[prim] @ (x - moved.means.double()[prim])[:, :, None])[..., 0]
            inside = y.square().sum(-1) < 1
            prim, vertex, x = prim[inside], vertex[inside], x[inside]
            rho = active.sigma(prim, x.float()).double().clamp_min(0)
            seen = colours.evaluate(prim, -torch.from_numpy(normals)[vertex])
            total.index_add_(0, vertex, rho[:, None] * seen)
            weight.index_add_(0, vertex, rho)
        bare = (weight <= 0).nonzero()[:, 0]
        if len(bare):  # the blur puts a vertex a little outside
            nearest = torch.from_numpy(cKDTree(moved.means.double().numpy()).query(points[bare.numpy()])[1])
            total[bare] = colours.evaluate(nearest, -torch.from_numpy(normals)[bare])
            weight[bare] = 1.0
    return np.asarray((total / weight[:, None]).numpy())


def _save_mesh(mesh: Any, colours: Tensor, space: str, path: Path, up: str, world: World) -> None:
    """Write a mesh with vertex ``colours`` (V, 3) in colour space ``space``; ``up``: the data's upward axis."""
    import trimesh

    suffix, values = path.suffix.lower(), colours.clamp(0, 1)
    if suffix == ".glb" and space != "linear":
        values = images.srgb_to_linear(values)
    elif suffix != ".glb" and space == "linear":
        values = images.linear_to_srgb(values)
    opaque = np.concatenate([values.numpy(), np.ones((len(values), 1), np.float32)], 1)
    written = trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_normals=mesh.vertex_normals, process=False)
    written.visual = trimesh.visual.ColorVisuals(written, vertex_colors=np.round(opaque * 255).astype(np.uint8))
    matrix = world.world_from_scene.numpy()
    linear, offset = np.eye(4), matrix[:3, 3]
    linear[:3, :3] = matrix[:3, :3]
    if suffix == ".glb":
        linear, offset = AXES_TO_GLTF[up] @ linear, AXES_TO_GLTF[up][:3, :3] @ offset
    if (linear != np.eye(4)).any():
        written.apply_transform(linear)
    more: dict[str, Any] = {"tree_postprocessor": _make_unlit} if suffix == ".glb" else {}
    data: Any = (
        _export_far_mesh(written, suffix, offset) if offset.any() else written.export(file_type=suffix[1:], **more)
    )
    with atomic_path(path) as temporary:
        temporary.write_bytes(data.encode("utf-8") if isinstance(data, str) else data)


def _make_unlit(tree: dict[str, Any]) -> None:
    """Add a material to the JSON of a glTF file: the colours hold light already, and the default material is metal."""
    unlit = "KHR_materials_unlit"
    tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0}, "extensions": {unlit: {}}}]
    tree["extensionsUsed"] = [unlit]
    for mesh in tree["meshes"]:
        for primitive in mesh["primitives"]:
            primitive["material"] = 0


def _export_far_mesh(mesh: Any, suffix: str, offset: np.ndarray) -> Any:
    """Return the file content of a mesh moved by ``offset`` (3,), without rounding large coordinates to float32."""
    import trimesh

    if suffix == ".glb":
        scene = trimesh.Scene()
        scene.add_geometry(mesh, transform=trimesh.transformations.translation_matrix(offset))
        return scene.export(file_type="glb", tree_postprocessor=_make_unlit)
    points = np.asarray(mesh.vertices, np.float64) + offset
    if suffix == ".obj":
        mesh.vertices = points
        return mesh.export(file_type="obj")
    head, body = mesh.export(file_type="ply").split(b"end_header\n", 1)
    rest = f"V{4 * head.count(b'property float n') + head.count(b'property uchar')}"
    rows = np.frombuffer(body, [("place", "<f4", 3), ("rest", rest)], len(points))
    wide = np.empty(len(points), [("place", "<f8", 3), ("rest", rest)])
    wide["place"], wide["rest"] = points, rows["rest"]
    for axis in (b"x", b"y", b"z"):
        head = head.replace(b"property float %b\n" % axis, b"property double %b\n" % axis)
    return head + b"end_header\n" + wide.tobytes() + body[rows.nbytes :]


# ---------------------------------------------------------------- error


def _compare_exported_silhouettes(job: ExportJob, conditions: Conditions, mesh: Any) -> float:
    """Return the intersection over union of the mesh's and the model's silhouettes, over all images of an orbit."""
    views, _ = choose_export_views(job, "orbit", conditions)
    both = either = 0
    for i, view in enumerate(views):
        job.progress("comparing silhouettes", i / len(views))
        camera = view.camera
        with torch.no_grad():
            alpha = render(job.run.model, camera, conditions, job.run.settings).alpha.numpy()
        y, x = np.mgrid[: camera.height, : camera.width] + 0.5
        rays = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones_like(x)], -1).reshape(-1, 3)
        rays = rays @ camera.viewmat[:3, :3].double().numpy()
        origin: Tensor = camera.position.double()
        directions = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        hit = mesh.ray.intersects_any(np.broadcast_to(origin.numpy(), rays.shape), directions)
        solid = alpha.reshape(-1) > 0.5
        both, either = both + int((hit & solid).sum()), either + int((hit | solid).sum())
    return both / either if either else 0.0


EXPORTER = Exporter(
    API_VERSION,
    "mesh",
    "an isosurface of the density with vertex colours: .glb, .ply or .obj; lossy",
    _write_mesh,
    OPTIONS,
    conditions=True,
    sequence=True,
    default="mesh.glb",
    suffixes=_SUFFIXES,
)
