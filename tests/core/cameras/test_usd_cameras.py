"""Cameras of USD stages, against the matrices that Pixar's own library makes of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.cameras import Camera
from neuprim.core.cameras.camera_files import is_usd, read_camera_file, read_usd_cameras
from neuprim.core.errors import DataError

pytest.importorskip("pxr", reason="needs usd-core: pip install 'neuprim[usd]'")

CAMERA = """
    def Camera "Cam"
    {
        float focalLength = 35
        float horizontalAperture = 36
        float verticalAperture = 27
        float horizontalApertureOffset = 3
        float verticalApertureOffset = -2
        matrix4d xformOp:transform = ( (1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0.5, -4, 0.25, 1) )
        uniform token[] xformOpOrder = ["xformOp:transform"]
    }
"""
MOVING = CAMERA.replace(
    "matrix4d xformOp:transform = ( (1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0.5, -4, 0.25, 1) )",
    "matrix4d xformOp:transform.timeSamples = { 1: ( (1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, -4, 0, 1) ),"
    " 3: ( (1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (2, -4, 0, 1) ) }",
).replace("focalLength = 35", "focalLength.timeSamples = { 1: 35, 3: 45 }")


def usd(path: Path, body: str = CAMERA, head: str = 'upAxis = "Z"\n    metersPerUnit = 0.01') -> Path:
    path.write_text(f'#usda 1.0\n(\n    {head}\n)\n\ndef Xform "World"\n{{{body}}}\n')
    return path


def projected(path: Path, prim: str, time: float, points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """(N, 2) pixels by the library's own frustum."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    frustum = UsdGeom.Camera(stage.GetPrimAtPath(prim)).GetCamera(time).frustum
    matrix = np.array(frustum.ComputeViewMatrix()) @ np.array(frustum.ComputeProjectionMatrix())
    clip = np.concatenate([points, np.ones((len(points), 1))], 1) @ matrix
    ndc = clip[:, :2] / clip[:, 3:]
    return (ndc * (0.5, -0.5) + 0.5) * size


POINTS = np.array([[0.5, 0.0, 0.25], [0.9, 1.0, 0.7], [0.1, 2.0, -0.4]])


def close(camera: Camera, expected: np.ndarray) -> bool:
    return bool(np.abs(camera.project(torch.from_numpy(POINTS))[0].numpy() - expected).max() < 1e-3)


def test_a_camera_that_stands_still(tmp_path: Path) -> None:
    path = usd(tmp_path / "a.usda")
    found = read_camera_file(path, (640, 480))  # of the aperture's shape
    ((_, camera),) = found.named
    assert close(camera, projected(path, "/World/Cam", 0, POINTS, (640, 480)))
    assert camera.fx == camera.fy == pytest.approx(35 / 36 * 640) and camera.cx < 320 and camera.cy < 240
    assert found.fps is None and found.notes[0].startswith("Z is up and a unit is 0.01 m in this file")


def test_all_formats_are_known_by_what_is_in_them(tmp_path: Path) -> None:
    from pxr import Sdf, UsdUtils

    text = usd(tmp_path / "a.usda")
    Sdf.Layer.FindOrOpen(str(text)).Export(str(tmp_path / "b.usdc"))
    UsdUtils.CreateNewUsdzPackage(str(tmp_path / "b.usdc"), str(tmp_path / "c.usdz"))
    (tmp_path / "d.usd").write_bytes((tmp_path / "b.usdc").read_bytes())
    expected = read_camera_file(text, (64, 48)).named[0][1]
    for name in ("b.usdc", "c.usdz", "d.usd"):
        assert is_usd(tmp_path / name)
        camera = read_camera_file(tmp_path / name, (64, 48)).named[0][1]
        assert torch.allclose(camera.viewmat, expected.viewmat)
        assert (camera.fx, camera.cx, camera.cy) == (expected.fx, expected.cx, expected.cy)


def test_a_camera_that_moves_has_a_frame_per_time_code(tmp_path: Path) -> None:
    path = usd(tmp_path / "a.usda", MOVING, "startTimeCode = 1\n    endTimeCode = 3\n    timeCodesPerSecond = 25")
    found = read_camera_file(path, (640, 480))
    assert len(found.named) == 3 and found.fps == 25 and found.notes[0].startswith("Y is up")
    assert found.codes == (1, 2, 3)
    for i, (_, camera) in enumerate(found.named):
        assert camera.position.tolist() == pytest.approx([i, -4, 0])
        assert camera.fx == pytest.approx((35 + 5 * i) / 36 * 640)
        assert close(camera, projected(path, "/World/Cam", 1 + i, POINTS, (640, 480)))


@pytest.mark.parametrize("size", [(640, 300), (300, 480)])
def test_another_shape_shows_the_whole_aperture_and_more(tmp_path: Path, size: tuple[int, int]) -> None:
    path = usd(tmp_path / "a.usda")
    camera = read_camera_file(path, size).named[0][1]
    assert camera.fx == camera.fy == pytest.approx(35 * min(size[0] / 36, size[1] / 27))
    left, right = (-18 + 3) / 35 * camera.fx + camera.cx, (18 + 3) / 35 * camera.fx + camera.cx
    top, bottom = camera.cy - (13.5 - 2) / 35 * camera.fy, camera.cy + (13.5 + 2) / 35 * camera.fy
    assert min(left, top) > -1e-3 and right < size[0] + 1e-3 and bottom < size[1] + 1e-3


BAD: dict[str, tuple[str, str]] = {  # what stands in a stage's text, and what stands there instead
    "has no camera; expected one": (CAMERA, ""),
    'projection is "orthographic"; expected perspective': ("{", '{ token projection = "orthographic"'),
    "focal is 0.0; expected a focal length above 0": ("= 35", "= 0"),
    "aperture is 0 x 27; expected numbers above 0": ("= 36", "= 0"),
    "focal is NaN; expected a focal length": ("= 35", "= nan"),
    "its transform scales the axes by 2, 1, 1; expected the same scale": ("(1, 0, 0, 0)", "(2, 0, 0, 0)"),
    "mirrored": ("(1, 0, 0, 0)", "(-1, 0, 0, 0)"),
    "its transform scales the axes by 0, 1, 1": ("(1, 0, 0, 0)", "(0, 0, 0, 0)"),
    "not a readable USD file": ("{", "["),
    "startTimeCode and endTimeCode are missing": (CAMERA, MOVING),
}
RANGES = ("startTimeCode = 1\n    endTimeCode = 1e12", "startTimeCode = 3\n    endTimeCode = 1")


def refused(path: Path, words: str, size: tuple[int, int] | None = (64, 48)) -> None:
    with pytest.raises(DataError, match=words) as caught:
        read_camera_file(path, size)
    assert path.name in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize("words", BAD)
def test_bad_stages_are_refused_in_one_line(tmp_path: Path, words: str) -> None:
    old, new = BAD[words]
    refused(usd(tmp_path / "a b.usda", CAMERA.replace(old, new, 1)), words)


def test_missing_sizes_endless_ranges_and_files_of_another_kind(tmp_path: Path) -> None:
    path = tmp_path / "a b.usda"
    refused(usd(path), r"states no image size .* give --size WxH", None)
    for head in RANGES:
        refused(usd(path, MOVING, head), "expected a range of 1 to 100000 time codes")
    for data in (b"PXR-USDC" + bytes(range(256)) * 9, b"#usda 1.0\n("):
        path.write_bytes(data)
        refused(path, "not a readable USD file")


def test_render_settings_that_are_not_followed(tmp_path: Path) -> None:
    settings = """
    def RenderSettings "S"
    {{
        uniform int2 resolution = (64, 48)
        uniform float pixelAspectRatio = {}
        uniform token aspectRatioConformPolicy = "{}"
    }}
"""
    head = 'renderSettingsPrimPath = "/World/S"'
    cropped = read_camera_file(usd(tmp_path / "a.usda", CAMERA + settings.format(1, "cropAperture"), head))
    assert cropped.notes[0].endswith("; aspectRatioConformPolicy cropAperture is read as expandAperture")
    path = usd(tmp_path / "b.usda", CAMERA + settings.format(2, "expandAperture"), head)
    refused(path, r"b\.usda: pixelAspectRatio 2; expected 1 \(square pixels\), or --size WxH", None)
    found = read_camera_file(path, (640, 480))
    assert found.named[0][1].width == 640 and "aspectRatioConformPolicy" not in found.notes[0]


def test_a_reader_that_never_ends_or_dies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path, script = usd(tmp_path / "a.usda"), tmp_path / "script.py"
    monkeypatch.setattr("neuprim.core.cameras.camera_files._USD_SECONDS", 1.0)
    for text, words in (
        ("import time; time.sleep(60)", "reading took over 1 s"),
        ("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "the USD reader was ended by SIGKILL"),
        ("print('hello')", "not a readable USD file"),
        ("raise MemoryError", "MemoryError"),
    ):
        script.write_text(text)
        monkeypatch.setattr("neuprim.core.cameras.camera_files._USD_SCRIPT", script)
        with pytest.raises(DataError, match=words):
            read_usd_cameras(path, "", (64, 48))
