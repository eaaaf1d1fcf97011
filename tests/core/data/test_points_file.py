"""Starting points from PLY files: points, colours, and the Gaussians of 3D Gaussian splatting."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.data.points_file import read_points
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.ply import write_ply
from neuprim.core.model.colours import sh
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.train.settings import ModelSettings
from neuprim.core.train.trainer import initial_model
from neuprim.tasks.static.fields import SphericalHarmonics
from tests.core import tiny


def fresh(path: Path | str, primitives: int = 50, **init: object) -> Primitives:
    settings = ModelSettings(primitives=primitives, init={"points": str(path), **init})
    return initial_model(CosineDensity(4), SphericalHarmonics(1), tiny.two_primitives(), settings, 0)


def splats(path: Path, **changes: float) -> Path:
    names = [*"xyz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", *(f"scale_{i}" for i in range(3)), *(f"rot_{i}" for i in range(4))]
    rows = np.zeros(3, [(n, "<f4") for n in names])
    rows["x"], rows["y"], rows["z"] = [0.0, 1.0, 2.0], [0.5, 0.6, 0.7], [-1.0, 0.0, 1.0]
    rows["f_dc_0"], rows["opacity"] = 1.0, [0.0, 20.0, -20.0]
    rows["scale_0"], rows["scale_1"], rows["scale_2"] = math.log(0.1), math.log(0.2), math.log(0.3)
    rows["rot_0"] = rows["rot_3"] = 2.0  # a quarter turn about z
    for name, value in changes.items():
        rows[name][1] = value
    write_ply(path, rows)
    return path


def test_gaussians_give_places_colours_shapes_and_opacities(tmp_path: Path) -> None:
    model = fresh(splats(tmp_path / "g.ply"))
    assert torch.equal(model.params["means"], torch.tensor([[0.0, 0.5, -1.0], [1.0, 0.6, 0.0], [2.0, 0.7, 1.0]]))
    assert torch.allclose(model.params["sh_dc"][:, 0], torch.tensor(1.0), atol=1e-5) and not bool(model.params["sh_rest"].any())
    geometry: Geometry = model.geometry
    spread = geometry.rotations * geometry.scales[:, None] / math.sqrt(5)
    covariance = spread @ spread.transpose(1, 2)
    assert torch.allclose(covariance, torch.diag(torch.tensor([0.04, 0.01, 0.09])).expand(3, 3, 3), atol=1e-6)
    alpha = 1 - torch.exp(-2 * model.params["b2"][:, 0])
    assert torch.allclose(alpha, torch.tensor([0.5, 0.98, 0.02]), atol=1e-5)


def test_sizes_can_be_scaled_and_the_count_is_kept(tmp_path: Path) -> None:
    path = splats(tmp_path / "g.ply")
    assert torch.allclose(fresh(path, scale=2.0).params["log_scales"], fresh(path).params["log_scales"] + math.log(2), atol=1e-5)
    assert fresh(path, primitives=2).count == 2


@pytest.mark.parametrize("form", ["bytes", "floats", "ascii", "none"])
def test_plain_clouds(tmp_path: Path, form: str) -> None:
    path = tmp_path / "p.ply"
    if form == "ascii":
        head = "property float x\nproperty float y\nproperty float z\nproperty uchar red\nproperty uchar green\nproperty uchar blue\n"
        path.write_text(f"ply\nformat ascii 1.0\nelement vertex 2\n{head}end_header\n0 0 0 51 102 255\n1 2 3 51 102 255\n")
    else:
        kind = {"bytes": [("red", "u1"), ("green", "u1"), ("blue", "u1")], "floats": [(c, "<f4") for c in ("red", "green", "blue")]}
        rows = np.zeros(2, [("x", "<f8"), ("y", "<f8"), ("z", "<f8"), *kind.get(form, [])])
        rows["x"], rows["y"], rows["z"] = [0, 1], [0, 2], [0, 3]
        for name, value in zip(("red", "green", "blue"), (51, 102, 255), strict=True):
            if form in kind:
                rows[name] = value if form == "bytes" else value / 255
        write_ply(path, rows)
    cloud = read_points(path, 3, "srgb")
    assert cloud.means.tolist() == [[0, 0, 0], [1, 2, 3]] and cloud.axes is None and cloud.alphas is None
    expected = [0.5, 0.5, 0.5] if form == "none" else [0.2, 0.4, 1.0]
    assert torch.allclose(cloud.colors, torch.tensor(expected), atol=1e-6)
    linear = read_points(path, 3, "linear").colors
    assert torch.allclose(linear[:, 1], torch.tensor(0.214041 if form == "none" else 0.132868), atol=1e-4)
    model = fresh(path)
    assert torch.allclose(model.params["sh_dc"] * sh.C0 + 0.5, torch.tensor(expected), atol=1e-3)
    assert model.count == 2 and torch.allclose(model.params["log_scales"].exp(), torch.tensor(math.sqrt(14.0)), rtol=1e-5)


@pytest.mark.parametrize(("name", "value"), [("x", math.nan), ("f_dc_1", math.inf), ("scale_0", 1e5), ("opacity", math.nan), ("y", 1e9)])
def test_impossible_numbers_are_named(tmp_path: Path, name: str, value: float) -> None:
    with pytest.raises(DataError, match=r"g\.ply: (scale or rot|" + name + ")"):
        fresh(splats(tmp_path / "g.ply", **{name: value}))


def test_quaternions_of_no_length_points_without_places_and_empty_files_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="rot"):
        read_points(splats(tmp_path / "g.ply", rot_0=0.0, rot_3=0.0), 3, "srgb")
    write_ply(tmp_path / "n.ply", np.zeros(1, [("a", "<f4")]))
    with pytest.raises(DataError, match="x, y, z"):
        fresh(tmp_path / "n.ply")
    write_ply(tmp_path / "e.ply", np.zeros(0, [(n, "<f4") for n in "xyz"]))
    with pytest.raises(DataError, match="no vertices"):
        fresh(tmp_path / "e.ply")
    with pytest.raises(DataError, match=r"none\.ply"):
        fresh(tmp_path / "none.ply")
    with pytest.raises(ConfigError, match=r"matter, box or a \.ply"):
        fresh("bx")
