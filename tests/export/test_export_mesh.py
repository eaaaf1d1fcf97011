"""`neuprim export --format mesh`: the surface lies where the balls are, in their colours, in every format's own
axes."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest

from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.export.mesh import find_export_surface_level
from neuprim.runs.export import export_run
from tests.plugins import marked


@pytest.fixture(scope="module")
def run_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return marked.static_run(tmp_path_factory.mktemp("runs") / "run", marked.static_model(neurons=2, degree=0))


pytestmark = pytest.mark.usefixtures("small_pictures")


def srgb(linear: np.ndarray) -> np.ndarray:
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("suffix", ["glb", "ply", "obj"])
def test_balls_are_in_their_places_sizes_and_colours(run_dir: Path, tmp_path: Path, suffix: str) -> None:
    pytest.importorskip("pyvista", exc_type=ImportError)
    import trimesh

    report = export_run(run_dir, "mesh", tmp_path / f"m.{suffix}", ["grid=128"])
    more = {"skip_materials": True} if suffix == "glb" else {}  # with one, trimesh loses the vertices' colours
    mesh = trimesh.load(report.files[0], force="mesh", process=False, **more)
    points, colours = np.asarray(mesh.vertices), np.asarray(mesh.visual.vertex_colors)[:, :3] / 255
    if suffix == "glb":  # glTF: y is up, colours are linear and hold light already
        data = report.files[0].read_bytes()
        tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
        assert tree["materials"][tree["meshes"][0]["primitives"][0]["material"]]["extensions"] == {
            "KHR_materials_unlit": {}
        }
        points, colours = np.stack([points[:, 0], -points[:, 2], points[:, 1]], 1), srgb(colours)
    assert report.errors["silhouette_iou"] > 0.85 and not report.lossless
    for place, radius, colour in zip(marked.PLACES.numpy(), marked.RADII.numpy(), marked.COLOURS.numpy(), strict=True):
        distance = np.linalg.norm(points - place, axis=1)
        mine = distance < radius + 0.04
        assert mine.sum() > 50
        assert abs(distance[mine].mean() - radius) < 0.02
        assert np.allclose(np.median(colours[mine], 0), colour, atol=0.02)
    assert mesh.is_watertight or suffix == "obj"
    if mesh.is_watertight:
        assert mesh.volume == pytest.approx(
            4 / 3 * np.pi * float((marked.RADII.double() ** 3).sum()), rel=0.15
        )  # and outside is outside


def test_small_pieces_can_be_kept_or_dropped(run_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyvista", exc_type=ImportError)
    import trimesh

    pieces = {}
    for keep in (0.0, 0.05):
        path = export_run(run_dir, "mesh", tmp_path / f"{keep}.ply", ["grid=128", f"keep={keep}", "level=5"]).files[0]
        pieces[keep] = len(trimesh.load(path, process=False).split(only_watertight=False))
    assert pieces == {0.0: 5, 0.05: 4}  # the smallest ball has 1/36 of the largest one's surface


def test_a_level_above_everything_is_refused(run_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyvista", exc_type=ImportError)
    with pytest.raises(ConfigError, match="no surface at this extinction; expected"):
        export_run(run_dir, "mesh", tmp_path / "m.glb", ["grid=16", "level=1e6"])
    assert not (tmp_path / "m.glb").exists()


def test_without_the_package_the_message_says_what_to_install(
    run_dir: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "pyvista", None)
    with pytest.raises(BackendUnavailable, match=r"neuprim\[mesh\]"):
        export_run(run_dir, "mesh", tmp_path / "m.glb")


def test_the_best_level_tells_opaque_columns_from_faint_ones() -> None:
    sigma = np.zeros((24, 24, 24), np.float32)
    sigma[4:20, 4:20, 4:20] = 0.5  # 16 voxels of 0.05: a depth of 0.4
    sigma[8:16, 8:16, 8:16] = 30.0
    assert 0.5 < find_export_surface_level(sigma, 0.05) < 30
    assert (
        0.5 < find_export_surface_level(np.minimum(sigma, 0.6), 0.05) < 0.6
        or find_export_surface_level(np.minimum(sigma, 0.6), 0.05) < 0.5
    )  # all faint
    assert find_export_surface_level(np.zeros((4, 4, 4), np.float32), 1.0) > 0


def test_a_dynamic_model_is_cut_at_a_time(tmp_path: Path) -> None:
    pytest.importorskip("pyvista", exc_type=ImportError)
    import trimesh

    run = marked.dynamic_run(tmp_path / "run", marked.write_sequence(tmp_path / "files"))
    with pytest.raises(ConfigError, match="--time: required"):
        export_run(run, "mesh", tmp_path / "m.ply")
    early, late = (
        trimesh.load(
            export_run(run, "mesh", tmp_path / f"{t}.ply", [f"--time={t}", "grid=48", "level=1.5"]).files[0],
            process=False,
        )
        for t in (0.2, 0.6)
    )
    corner = np.array([0.1, 0.2, 0.2])
    # the second primitive lives from 0.1 on and grows denser
    assert np.linalg.norm(late.vertices - corner, axis=1).min() < 0.25
    assert late.bounds[1][2] > early.bounds[1][2] + 0.02
