"""`neuprim export --format gaussian-glb`: the Gaussians of `gaussian-ply` as KHR_gaussian_splatting, with y up."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuprim.core.io.ply import read_ply
from neuprim.core.model import sh
from neuprim.export import shared
from neuprim.runs.export import export_run
from tests.plugins import marked

pytestmark = pytest.mark.usefixtures("small_pictures")


def read_glb(path: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The JSON of a file, and the values of its primitive's attributes."""
    data = path.read_bytes()
    assert struct.unpack("<4sII", data[:12]) == (b"glTF", 2, len(data))
    size, kind = struct.unpack("<I4s", data[12:20])
    assert kind == b"JSON" and size % 4 == 0
    found, body = json.loads(data[20 : 20 + size]), data[28 + size :]
    assert struct.unpack("<I4s", data[20 + size : 28 + size]) == (len(body), b"BIN\0") and len(body) % 4 == 0
    values = {}
    for name, number in found["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = found["accessors"][number]
        view = found["bufferViews"][accessor["bufferView"]]
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}[accessor["type"]]
        own = np.frombuffer(body, "<f4", accessor["count"] * width, view["byteOffset"])
        assert own.nbytes == view["byteLength"] and accessor["componentType"] == 5126
        values[name.removeprefix("KHR_gaussian_splatting:")] = own.reshape(-1, width)
    return found, values


def test_the_gaussians_of_the_ply_turned_to_y_up(tmp_path: Path) -> None:
    run = marked.static_run(tmp_path / "run", marked.static_model(neurons=2, degree=3))
    options = ["views=orbit", "size=moments"]
    report = export_run(run, "gaussian-glb", tmp_path / "g.glb", options)
    rows = read_ply(export_run(run, "gaussian-ply", tmp_path / "g.ply", options).files[0])
    described, found = read_glb(report.files[0])
    primitive = described["meshes"][0]["primitives"][0]
    assert described["extensionsUsed"] == ["KHR_gaussian_splatting"] and primitive["mode"] == 0
    assert primitive["extensions"]["KHR_gaussian_splatting"] == {
        "kernel": "ellipse",
        "colorSpace": "srgb_rec709_display",
    }
    x, y, z = rows.columns(["x", "y", "z"]).T
    np.testing.assert_allclose(found["POSITION"], np.stack([x, z, -y], 1), atol=1e-6)
    np.testing.assert_allclose(found["OPACITY"][:, 0], 1 / (1 + np.exp(-rows.rows["opacity"])), atol=1e-5)
    sizes = np.exp(rows.columns([f"scale_{i}" for i in range(3)]))
    np.testing.assert_allclose(np.sort(found["SCALE"]), np.sort(sizes), rtol=1e-4)
    directions = torch.nn.functional.normalize(
        torch.randn(20, 3, dtype=torch.float64, generator=torch.Generator()), dim=-1
    )
    names = [f"SH_DEGREE_{d}_COEF_{n}" for d in range(4) for n in range(2 * d + 1)]
    turned = directions @ torch.from_numpy(shared.AXES_TO_GLTF["z"][:3, :3].T)
    got = torch.einsum(
        "pk,knc->pnc", sh.sh_basis(turned, 3), torch.from_numpy(np.stack([found[n] for n in names])).double()
    )
    rest = rows.columns([f"f_rest_{i}" for i in range(45)]).reshape(-1, 3, 15).transpose(2, 0, 1)
    dc = rows.columns([f"f_dc_{i}" for i in range(3)])[None]
    wanted = torch.einsum(
        "pk,knc->pnc", sh.sh_basis(directions, 3), torch.from_numpy(np.concatenate([dc, rest])).double()
    )
    assert torch.allclose(got, wanted, atol=1e-4) and float(wanted.std()) > 0.01
    assert report.errors["psnr"] > 15


def test_rotations_and_sizes_are_those_of_the_covariances(tmp_path: Path) -> None:
    run = marked.dynamic_run(tmp_path / "run", marked.write_sequence(tmp_path / "files"))
    report = export_run(run, "gaussian-glb", tmp_path / "g.glb", ["--time=0.5", "size=moments"])
    ply = read_ply(export_run(run, "gaussian-ply", tmp_path / "g.ply", ["--time=0.5", "size=moments"]).files[0])
    described, found = read_glb(report.files[0])
    assert np.linalg.norm(found["ROTATION"], axis=1) == pytest.approx(1, abs=1e-5)

    def covariances(quats: np.ndarray, sizes: np.ndarray) -> np.ndarray:
        """Of quaternions wxyz."""
        w, x, y, z = quats.T.astype(np.float64)
        R = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        ).transpose(2, 0, 1)
        return R @ (sizes[:, :, None].astype(np.float64) ** 2 * R.transpose(0, 2, 1))

    turn = shared.AXES_TO_GLTF["z"][:3, :3]
    own = covariances(found["ROTATION"][:, [3, 0, 1, 2]], found["SCALE"])
    sizes = np.exp(ply.columns([f"scale_{i}" for i in range(3)]))
    wanted = turn @ covariances(ply.columns([f"rot_{i}" for i in range(4)]), sizes) @ turn.T
    np.testing.assert_allclose(own, wanted, atol=1e-5 * float(np.abs(wanted).max()))
    space = described["meshes"][0]["primitives"][0]["extensions"]["KHR_gaussian_splatting"]["colorSpace"]
    assert space == "lin_rec709_display"


def test_another_reader_opens_it(tmp_path: Path) -> None:
    trimesh = pytest.importorskip("trimesh", reason="needs trimesh: pip install 'neuprim[mesh]'")
    run = marked.static_run(tmp_path / "run")
    path = export_run(run, "gaussian-glb", tmp_path / "g.glb", ["views=orbit"]).files[0]
    scene = trimesh.load(path)
    (points,) = scene.geometry.values()
    _, found = read_glb(path)
    np.testing.assert_allclose(points.vertices, found["POSITION"], atol=1e-6)


@pytest.mark.parametrize("up", [(0.0, 0.0, 1.0), (0.1, 1.0, 0.0), (0.0, -1.0, 0.1), (0.0, 0.2, -1.0)])
def test_whatever_is_up_is_y_in_gltf_and_stated_in_usd(up: tuple[float, float, float], tmp_path: Path) -> None:
    """COLMAP's scenes often have -y up, which USD cannot state."""
    config = ["task=static", "scene=solids"]
    run = marked.write_run(tmp_path / "run", marked.static_model(), config, data={"up": list(up)})
    report = export_run(run, "gaussian-glb", tmp_path / "g.glb", ["size=moments", "views=orbit"])
    _, found = read_glb(report.files[0])
    turn = np.linalg.lstsq(marked.PLACES.numpy(), found["POSITION"], rcond=None)[0].T
    assert (turn @ up)[1] > 0.98 and np.linalg.det(turn) == pytest.approx(1, abs=1e-2)
    assert ("turned from" in " ".join(report.notes)) == (up[1] < 0.5)
    pytest.importorskip("pxr", reason="needs usd-core: pip install 'neuprim[usd]'")
    from pxr import Usd, UsdGeom

    report = export_run(run, "gaussian-usd", tmp_path / "g.usda", ["size=moments", "views=orbit"])
    stage = Usd.Stage.Open(str(report.files[0]))
    assert UsdGeom.GetStageUpAxis(stage) == ("Y" if abs(up[1]) > abs(up[2]) else "Z")
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1 and UsdGeom.StageHasAuthoredMetersPerUnit(stage)
    assert ("180 degrees" in " ".join(report.notes)) == (min(up[1:]) < -0.5)
