"""Colour spaces of OpenEXR files, against matrices of the ACES documents and OpenColorIO's own conversion."""

from __future__ import annotations

import copy
import sys
from pathlib import Path

import numpy as np
import PyOpenColorIO as ocio
import pytest
import torch

from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.runs.color_space import load_output_color_space

COLORS = torch.rand(50, 3, generator=torch.Generator().manual_seed(0)) * 20 - 1
BUILT_IN = "ocio://default"


def xyz_from_rgb(chromaticities: tuple[float, ...]) -> np.ndarray:
    """SMPTE RP 177: the matrix to CIE XYZ of primaries and white."""
    x, y = np.array(chromaticities).reshape(4, 2).T
    points = np.stack([x / y, np.ones(4), (1 - x - y) / y])
    return points[:, :3] * np.linalg.solve(points[:, :3], points[:, 3])


def adapted(source: tuple[float, ...], target: tuple[float, ...]) -> np.ndarray:
    """From one linear space to another, with Bradford's adaptation between the white points."""
    bradford = np.array([[0.8951, 0.2664, -0.1614], [-0.7502, 1.7135, 0.0367], [0.0389, -0.0685, 1.0296]])
    a, b = xyz_from_rgb(source), xyz_from_rgb(target)
    ratio = (bradford @ b.sum(1)) / (bradford @ a.sum(1))
    return np.linalg.inv(b) @ np.linalg.inv(bradford) @ np.diag(ratio) @ bradford @ a


@pytest.mark.parametrize("name", ["ACEScg", "ACES2065-1", "Linear Rec.709 (sRGB)", "Linear P3-D65", "lin_ap1_scene"])
def test_colours_are_converted_as_opencolorio_does(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OCIO", raising=False)
    space = load_output_color_space(name)
    expected = COLORS.numpy().copy()
    config = ocio.Config.CreateFromFile(BUILT_IN)
    config.getProcessor("Linear Rec.709 (sRGB)", name).getDefaultCPUProcessor().applyRGB(expected)
    assert np.allclose(space.convert(COLORS), expected, rtol=1e-5, atol=1e-5)
    assert (space.chromaticities is None) == (name == "Linear P3-D65")
    if space.chromaticities is not None:
        rec709 = (0.64, 0.33, 0.30, 0.60, 0.15, 0.06, 0.3127, 0.3290)
        assert np.allclose(space.matrix, adapted(rec709, space.chromaticities), atol=2e-4)


def test_a_configuration_of_the_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With names of its own."""
    config = copy.deepcopy(ocio.Config.CreateFromFile(BUILT_IN))
    space = copy.deepcopy(config.getColorSpace("ACEScg"))
    space.setName("studio linear")
    space.clearAliases()
    config.addColorSpace(space)
    (tmp_path / "studio.ocio").write_text(config.serialize())
    monkeypatch.setenv("OCIO", str(tmp_path / "studio.ocio"))
    built_in = load_output_color_space("ACEScg")
    found = load_output_color_space("studio linear")
    assert torch.equal(found.matrix, built_in.matrix) and found.chromaticities == built_in.chromaticities


@pytest.mark.parametrize(
    "name, text",
    [
        ("ACESgc", f"no such colour space in {BUILT_IN}; did you mean 'ACEScg'"),
        ("ACEScct", "not a linear space"),
        ("sRGB Encoded Rec.709 (sRGB)", "not a linear space"),
        ("Raw", "not a linear space"),
    ],
)
def test_wrong_spaces_are_one_line(name: str, text: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("OCIO", raising=False)
    with pytest.raises(ConfigError, match=f"^--colorspace {name.partition('(')[0]}") as error:
        load_output_color_space(name)
    assert text in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("content", [None, "ocio_profile_version: 2\nroles: [\n", "hello"])
def test_broken_configurations_are_one_line(
    content: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "broken.ocio"
    if content is not None:
        file.write_text(content)
    monkeypatch.setenv("OCIO", str(file))
    with pytest.raises(ConfigError, match=r"broken\.ocio") as error:
        load_output_color_space("ACEScg")
    assert "\n" not in str(error.value)


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "PyOpenColorIO", None)
    with pytest.raises(BackendUnavailable, match=r"pip install 'neuprim\[ocio\]'"):
        load_output_color_space("ACEScg")
