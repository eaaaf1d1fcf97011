"""`neuprim export --format gaussian-usd`: the Gaussians of `gaussian-ply`, as usd-core reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from neuprim.core.errors import BackendUnavailable
from neuprim.core.io.ply import read_ply
from neuprim.runs.export import export_run
from tests.plugins import marked

pxr = pytest.importorskip("pxr", reason="needs usd-core: pip install 'neuprim[usd]'")
from pxr import Gf, Usd, UsdGeom, UsdVol  # noqa: E402 - after the check

pytestmark = pytest.mark.usefixtures("small_pictures")


def test_the_gaussians_of_the_ply(tmp_path: Path) -> None:
    run = marked.static_run(tmp_path / "run", marked.static_model(neurons=2, degree=3))
    options = ["views=orbit", "size=moments"]
    report = export_run(run, "gaussian-usd", tmp_path / "g.usda", options)
    ply = read_ply(export_run(run, "gaussian-ply", tmp_path / "g.ply", options).files[0])
    stage = Usd.Stage.Open(str(report.files[0]))
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and prim.GetRadianceSphericalHarmonicsDegreeAttr().Get() == 3
    positions = np.array(prim.GetPositionsAttr().Get())
    np.testing.assert_allclose(positions, ply.columns("xyz"), atol=1e-6)
    np.testing.assert_allclose(
        np.array(prim.GetOpacitiesAttr().Get()), 1 / (1 + np.exp(-ply.rows["opacity"])), atol=1e-5
    )
    np.testing.assert_allclose(
        np.array(prim.GetScalesAttr().Get()), np.exp(ply.columns([f"scale_{i}" for i in range(3)])), rtol=1e-4
    )
    quats = np.array([[q.GetReal(), *q.GetImaginary()] for q in prim.GetOrientationsAttr().Get()])
    np.testing.assert_allclose(quats, ply.columns([f"rot_{i}" for i in range(4)]), atol=1e-6)
    harmonics = np.array(prim.GetRadianceSphericalHarmonicsCoefficientsAttr().Get()).reshape(len(positions), 16, 3)
    np.testing.assert_allclose(harmonics[:, 0], ply.columns([f"f_dc_{i}" for i in range(3)]), atol=1e-6)
    rest = ply.columns([f"f_rest_{i}" for i in range(45)]).reshape(-1, 3, 15).transpose(0, 2, 1)
    np.testing.assert_allclose(harmonics[:, 1:], rest, atol=1e-6)
    low, high = np.array(prim.GetExtentAttr().Get())
    assert prim.GetRadianceSphericalHarmonicsCoefficientsAttr().GetColorSpace() == Gf.ColorSpaceNames.SRGBRec709
    assert (low < positions.min(0)).all() and (high > positions.max(0)).all() and report.errors["psnr"] > 15


def test_frames_are_time_samples(tmp_path: Path) -> None:
    run = marked.dynamic_run(tmp_path / "run", marked.write_sequence(tmp_path / "files"))
    words = ["--time=0,0.5,1", "size=moments", "fps=25"]
    report = export_run(run, "gaussian-usd", tmp_path / "g.usdc", words)
    stage = Usd.Stage.Open(str(report.files[0]))
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode(), stage.GetFramesPerSecond()) == (0, 2, 25)
    prim = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert prim.GetPositionsAttr().GetTimeSamples() == [0, 1, 2]
    alone = export_run(run, "gaussian-ply", tmp_path / "a.ply", ["--time=0.5", "size=moments"]).files[0]
    np.testing.assert_allclose(np.array(prim.GetPositionsAttr().Get(1)), read_ply(alone).columns("xyz"), atol=1e-5)
    assert {f"frame_{n:04d}.psnr" for n in range(3)} <= set(report.errors)


def test_an_old_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(UsdVol, "ParticleField3DGaussianSplat")
    with pytest.raises(BackendUnavailable, match=r"needs usd-core 26\.3 or newer; found "):
        export_run(marked.static_run(tmp_path / "run"), "gaussian-usd", tmp_path / "g.usdc", ["views=orbit"])
