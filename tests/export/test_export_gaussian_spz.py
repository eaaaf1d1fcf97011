"""`neuprim export --format gaussian-spz`: the Gaussians of `gaussian-ply`, as gsply reads them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.data.points_file import read_points
from neuprim.core.errors import ConfigError
from neuprim.core.io.ply import read_ply
from neuprim.core.io.spz import encode_spz
from neuprim.core.model import sh
from neuprim.export import gaussian_spz
from neuprim.runs.export import export_run
from tests.plugins import marked

gsply = pytest.importorskip("gsply", reason="needs gsply: pip install gsply")


pytestmark = pytest.mark.usefixtures("small_pictures")


def test_the_gaussians_of_the_ply_after_a_half_turn(tmp_path: Path) -> None:
    run = marked.static_run(tmp_path / "run", marked.static_model(neurons=2, degree=3))
    options = ["views=orbit", "size=moments"]
    report = export_run(run, "gaussian-spz", tmp_path / "g.spz", options)
    plain = export_run(run, "gaussian-ply", tmp_path / "g.ply", options)
    ply, spz = read_ply(plain.files[0]), gsply.spz.read_spz(report.files[0])
    np.testing.assert_allclose(spz.means, ply.columns("xyz") * [1, -1, -1], atol=1e-6)
    np.testing.assert_allclose(spz.sh0, ply.columns([f"f_dc_{i}" for i in range(3)]), atol=0.014)
    wanted_sizes = np.sort(ply.columns([f"scale_{i}" for i in range(3)]))
    np.testing.assert_allclose(np.sort(spz.scales), wanted_sizes, atol=0.032)
    directions = torch.nn.functional.normalize(torch.randn(20, 3, dtype=torch.float64), dim=-1)
    turned = directions * torch.tensor([1.0, -1.0, -1.0])
    rest = ply.columns([f"f_rest_{i}" for i in range(45)]).reshape(-1, 3, 15).transpose(2, 0, 1)
    wanted = torch.einsum("pk,knc->pnc", sh.sh_basis(directions, 3)[:, 1:], torch.from_numpy(rest.copy()))
    stored = torch.from_numpy(spz.shN.transpose(1, 0, 2).astype(np.float64))
    found = torch.einsum("pk,knc->pnc", sh.sh_basis(turned, 3)[:, 1:], stored)
    assert torch.allclose(found, wanted, atol=0.02) and float(wanted.std()) > 0.02
    assert 0 < abs(report.errors["psnr"] - plain.errors["psnr"]) < 0.1
    assert f"rounding to SPZ changes this PSNR from {plain.errors['psnr']:.2f} dB" in report.notes
    points = read_points(report.files[0], 3, "srgb")
    np.testing.assert_allclose(points.means, ply.columns("xyz"), atol=1e-6)  # back in the data's coordinates


def test_the_reported_error_is_that_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = marked.static_run(tmp_path / "run")
    options = ["views=orbit", "size=moments"]
    right = export_run(run, "gaussian-spz", tmp_path / "right.spz", options).errors["psnr"]
    monkeypatch.setattr(
        gaussian_spz, "encode_spz", lambda found: encode_spz(replace(found, opacities=found.opacities / 4))
    )
    assert export_run(run, "gaussian-spz", tmp_path / "wrong.spz", options).errors["psnr"] < right - 1


def test_several_times_are_several_files(tmp_path: Path) -> None:
    run = marked.dynamic_run(tmp_path / "run", marked.write_sequence(tmp_path / "files"))
    report = export_run(run, "gaussian-spz", tmp_path / "frames", ["--time=0,1", "size=moments"])
    assert [path.name for path in report.files] == ["gaussians.0000.spz", "gaussians.0001.spz"]
    ply = export_run(run, "gaussian-ply", tmp_path / "g.ply", ["--time=1", "size=moments"]).files[0]
    found = gsply.spz.read_spz(report.files[1])
    np.testing.assert_allclose(found.means, read_ply(ply).columns("xyz") * [1, -1, -1], atol=1e-5)
    assert any("colours are linear" in note for note in report.notes)


def test_coordinates_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    world = np.eye(4)
    world[:3, 3] = [-6e5, 0, 0]
    world = {"world": {"scene_from_world": world.tolist(), "up": [0, 0, 1]}}
    run = marked.write_run(tmp_path / "run", marked.static_model(), ["task=static", "scene=solids"], **world)
    with pytest.raises(ConfigError, match=r"a coordinate is 600000\.\d+; expected at most 524287\.9 in an SPZ file"):
        export_run(run, "gaussian-spz", tmp_path / "g.spz", ["views=orbit", "size=moments"])
    assert not (tmp_path / "g.spz").exists()
