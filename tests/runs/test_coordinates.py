"""Files that go in and out of a run are in the coordinates of its data, wherever its scene lies inside."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import OpenEXR
import pytest
import torch
import trimesh
from pxr import Usd, UsdVol

from neuprim.core import checkpoint
from neuprim.core.cameras import Camera, look_at
from neuprim.core.cameras.world import World
from neuprim.core.compression.quantizers import LEVELS
from neuprim.core.data.points_file import read_points
from neuprim.core.errors import CheckpointError, DataError
from neuprim.core.io.ply import read_ply
from neuprim.core.io.vdb import read_grid
from neuprim.core.volumes.density_grid import density_at
from neuprim.export.shared import ExportHarmonics, fibonacci_sphere
from neuprim.runs.export import export_run, import_run_directory
from neuprim.runs.inspect import InspectRequest, inspect_run
from neuprim.runs.open import open_run, read_metrics
from neuprim.runs.render_images import RenderRequest, render_run
from neuprim.tasks.relight import TASK as RELIGHT
from neuprim.viewer.controls import format_viewer_condition
from tests.core import tiny
from tests.plugins import marked
from tests.short_runs import fit, words

UTM = World.at([448250.0, 5411930.0, 210.0])
MESH = World(torch.tensor([[0.5, 0, 0, -5], [0, 0, -0.5, 2], [0, 0.5, 0, -1000], [0, 0, 0, 1]], dtype=torch.float64))
"""As of a mesh with y up, twice as large as its scene."""
WORLDS = pytest.mark.parametrize("world", [UTM, MESH], ids=["utm", "mesh"])
UP = torch.tensor([0.0, 0.0, 1.0])
LOOK = Camera(look_at(torch.tensor([2.0, -3, 1.5]), torch.full((3,), 0.1), UP), 60.0, 60.0, 24.0, 18.0, 48, 36)


def run_in(folder: Path, world: World) -> Path:
    return marked.write_run(folder, marked.static_model(), ["task=static", "scene=solids"], world=world.to_json())


def write_cameras(path: Path, *cameras: Camera) -> str:
    frames = []
    for camera in cameras:
        pose = torch.linalg.inv(camera.viewmat) @ torch.diag(torch.tensor([1.0, -1, -1, 1], dtype=torch.float64))
        frames.append(
            {"transform_matrix": pose.tolist(), "fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy}
        )
    path.write_text(json.dumps({"w": LOOK.width, "h": LOOK.height, "frames": frames}))
    return str(path)


@WORLDS
def test_a_files_cameras_are_in_the_world_and_so_is_what_is_written_of_them(tmp_path: Path, world: World) -> None:
    run = run_in(tmp_path / "run", world)
    there = write_cameras(tmp_path / "world.json", world.world_camera(LOOK))
    here = write_cameras(tmp_path / "scene.json", LOOK)
    (a,) = render_run(run, RenderRequest(there, format="exr", out=tmp_path / "a.exr", frames=1))
    (b,) = render_run(run, RenderRequest(here, format="exr", out=tmp_path / "b.exr", frames=1, space="scene"))
    with OpenEXR.File(str(a), separate_channels=True) as one, OpenEXR.File(str(b), separate_channels=True) as two:
        first, second = one.channels(), two.channels()
        assert np.abs(first["A"].pixels - second["A"].pixels).max() < 1e-5 and first["A"].pixels.max() > 0.9
        assert np.abs(first["depth.Z"].pixels * world.scale - second["depth.Z"].pixels).max() < 1e-4
        head = one.header()
        position = np.linalg.inv(head["neuprim:worldToCamera"])[3, :3]
        assert np.allclose(position, world.world_points(LOOK.position).numpy(), atol=1e-6)
        assert head["neuprim:near"] * world.scale == pytest.approx(two.header()["neuprim:near"])


def test_a_shot_of_empty_images_fails(tmp_path: Path) -> None:
    run = run_in(tmp_path / "run", UTM)
    away = UTM.world_camera(
        replace(LOOK, viewmat=look_at(torch.tensor([2.0, -3, 1.5]), torch.tensor([9.0, -9, 9]), UP))
    )
    cameras = write_cameras(tmp_path / "c.json", UTM.world_camera(LOOK), away)
    assert len(render_run(run, RenderRequest(cameras, format="png", out=tmp_path / "out", frames=1))) == 2
    here = write_cameras(tmp_path / "scene.json", LOOK)
    with pytest.raises(DataError, match=r"all 1 images are empty: the model is within .* towards .*--space scene"):
        render_run(run, RenderRequest(here, format="png", out=tmp_path / "none", frames=1))
    assert not list((tmp_path / "none").iterdir())


@WORLDS
def test_exported_places_are_those_of_the_world(tmp_path: Path, world: World) -> None:
    run = run_in(tmp_path / "run", world)
    centers = world.world_points(marked.PLACES.double()).numpy()
    for format in ("ply", "gaussian-ply"):
        file = tmp_path / f"{format}.ply"
        export_run(run, format, file, [] if format == "ply" else ["size=moments", "views=orbit"])
        found = read_ply(file).columns("xyz")
        assert np.abs(found - centers).max() < 1e-3 / world.scale
        back = read_points(file, 3, "srgb").within(world)
        assert torch.allclose(back.means, marked.PLACES, atol=1e-3)
    assert back.deviations is not None and torch.allclose(back.deviations[0], torch.full((3,), 0.3 / 5**0.5), rtol=0.1)
    export_run(run, "gaussian-glb", tmp_path / "g.glb", ["size=moments", "views=orbit"])
    scene = trimesh.load(tmp_path / "g.glb")
    (node,) = scene.graph.nodes_geometry
    matrix, name = scene.graph[node]
    points = trimesh.transform_points(scene.geometry[name].vertices, matrix)
    if abs(up := world.world_from_scene[:3, :3] @ world.up)[2] > abs(up)[1]:  # z is up: back from y up, as readers do
        points = points[:, [0, 2, 1]] * [1, -1, 1]
    assert np.abs(points - centers).max() < 1e-3 / world.scale
    export_run(run, "gaussian-usd", tmp_path / "g.usdc", ["size=moments", "views=orbit"])
    stage = Usd.Stage.Open(str(tmp_path / "g.usdc"))
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    places = np.array(prim.GetPositionsAttr().Get()) + np.array(prim.GetTranslateOp().Get())
    assert np.abs(places - centers).max() < 1e-3 / world.scale
    export_run(run, "vdb", tmp_path / "d.vdb", ["grid=64"])
    grid = read_grid(tmp_path / "d.vdb", "density")
    low, high = (np.array(corner) for corner in grid.world_bounds())  # type: ignore[union-attr]
    box = world.world_box(np.array([[-0.3, -0.3, -0.3], [0.9, 0.75, 0.95]]))
    assert np.abs(np.stack([low, high]) - box).max() < 0.1 / world.scale
    import_run_directory(tmp_path / "ply.ply", tmp_path / "back")
    assert torch.equal(open_run(tmp_path / "back").world.scene_from_world, world.scene_from_world)


@pytest.mark.parametrize(("suffix", "world"), [("ply", UTM), ("obj", MESH), ("glb", UTM)])
def test_meshes_are_in_the_world(tmp_path: Path, suffix: str, world: World) -> None:
    pytest.importorskip("pyvista")
    export_run(run_in(tmp_path / "run", world), "mesh", tmp_path / f"m.{suffix}", ["grid=32", "smooth=0", "keep=0"])
    scene = trimesh.load(tmp_path / f"m.{suffix}", force="scene", process=False)
    points = np.concatenate([trimesh.transform_points(scene.geometry[g].vertices, m) for m,
        g in (scene.graph[n] for n in scene.graph.nodes_geometry)])  # fmt: skip
    if suffix == "glb":  # back from y up, as readers do
        points = points[:, [0, 2, 1]] * [1, -1, 1]
    box = np.stack([points.min(0), points.max(0)])
    assert np.abs(box - world.world_box(np.array([[-0.3, -0.3, -0.3], [0.9, 0.75, 0.95]]))).max() < 0.1 / world.scale
    assert len(np.unique(points[:, 0])) > 100, "no coordinate is rounded to the others'"


def test_boxes_and_volumes_of_inspect_are_in_the_world(tmp_path: Path) -> None:
    run = run_in(tmp_path / "run", UTM)
    box = UTM.world_box(np.array([[-0.5, -0.5, -0.5], [0.5, 0.5, 0.5]]))
    inspect_run(InspectRequest(run, grid=16, box=box, out=tmp_path / "v.vdb"))
    grid = read_grid(tmp_path / "v.vdb", "extinction")
    assert np.abs(np.stack(grid.world_bounds()).mean(0) - box.mean(0)).max() < 0.1  # type: ignore[arg-type]
    dense = grid.to_dense()
    index = np.array(np.unravel_index(dense.argmax(), dense.shape)) + grid.bounds[0]  # type: ignore[index]
    point = UTM.scene_points(torch.from_numpy(grid.transform[:3, :3] @ index + grid.transform[:3, 3])[None])
    assert float(density_at(open_run(run).model, {}, point)[0]) == pytest.approx(float(dense.max()), rel=1e-4)


def test_a_light_is_read_and_written_in_the_world() -> None:
    light = RELIGHT.conditions[0]
    (value,) = light.within(UTM).parse("448251.25,5411930,214.5")
    assert value.tolist() == [1.25, 0.0, 4.5] and value.dtype == torch.float32
    assert torch.equal(light.within(UTM).parse("orbit:4:40:3")[0], light.parse("orbit:4:40:3")[0])
    assert format_viewer_condition(light, value, UTM) == "448251.25,5411930,214.5"


def test_a_page_and_a_compressed_model_say_where_they_are(tmp_path: Path) -> None:
    run = run_in(tmp_path / "run", UTM)
    (page,) = export_run(run, "html", tmp_path / "m.html", ["views=0", "level=0"]).files
    assert json.dumps(UTM.to_json())[1:-1] in page.read_text()
    model, header = open_run(run).model, open_run(run).header
    extra, config = checkpoint.read_header_extra(header), (run / "config.yaml").read_text()
    checkpoint.save_compressed(tmp_path / "m.neuprim", model, "static", extra, LEVELS[1], config)
    back = open_run(import_run_directory(tmp_path / "m.neuprim", tmp_path / "back"))
    assert torch.equal(back.world.scene_from_world, UTM.scene_from_world)


def test_colours_turn_with_the_axes() -> None:
    generator = torch.Generator().manual_seed(3)
    colours = ExportHarmonics(torch.randn(2, 3, generator=generator), torch.randn(2, 15, 3, generator=generator), 0.0)
    turn, directions, rows = MESH.rotation, fibonacci_sphere(20), torch.zeros(20, dtype=torch.int64)
    assert turn is not None
    assert torch.allclose(
        colours.rotate(turn).evaluate(rows, directions @ turn.T), colours.evaluate(rows, directions), atol=1e-9
    )


def moved(folder: Path, to: Path, offset: tuple[float, ...]) -> Path:
    """A copy of a NeRF-synthetic folder with its cameras elsewhere."""
    shutil.copytree(folder, to, dirs_exist_ok=True)
    for split in ("train", "test"):
        document = json.loads((folder / f"transforms_{split}.json").read_text())
        for frame in document["frames"]:
            for row, x in zip(frame["transform_matrix"], offset, strict=False):
                row[3] += x
        (to / f"transforms_{split}.json").write_text(json.dumps(document))
    return to


def test_a_scene_in_utm_trains_as_at_the_origin_and_stays_where_it_was(tmp_path: Path) -> None:
    near = tiny.write_blender(tmp_path / "near")
    far = moved(near, tmp_path / "far", (448250.0, 5411930.0, 210.0))
    runs = [fit(words(scene, tmp_path / f"run_{scene.name}", 60)) for scene in (near, far)]
    a, b = (read_metrics(run)["psnr"] for run in runs)
    assert b > a - 1 and "world" not in open_run(runs[0]).header
    world = open_run(runs[1]).world
    assert torch.equal(open_run(runs[1]).dataset().world.scene_from_world, world.scene_from_world)
    assert checkpoint.read_header(runs[1] / "checkpoint.safetensors", "checkpoint")["world"] == world.to_json()
    moved(near, far, (448250.0, 5400000.0, 210.0))
    with pytest.raises(
        CheckpointError,
        match=r"origin was \[448250.0, 5411930.0, 210.0\] in the coordinates of the data's files and is \[448250.0, 54",
    ):
        fit([*words(far, runs[1], 80), "resume=true"])
