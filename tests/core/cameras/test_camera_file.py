"""Cameras from JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.core.cameras.camera_files import read_camera_file, read_cameras
from neuprim.core.errors import DataError

POSE = [
    [1.0, 0.0, 0.0, 0.5],
    [0.0, 0.0, -1.0, -4.0],
    [0.0, 1.0, 0.0, 0.25],
    [0.0, 0.0, 0.0, 1.0],
]  # at (0.5, -4, 0.25), looking along +y
GOOD: dict[str, Any] = {"w": 64, "h": 48, "camera_angle_x": math.pi / 2, "frames": [{"transform_matrix": POSE}] * 2}


def write(path: Path, value: Any) -> Path:
    path.write_text(value if isinstance(value, str) else json.dumps(value), encoding="utf-8")
    return path


def test_field_of_view(tmp_path: Path) -> None:
    (name, camera), (other, _) = read_cameras(write(tmp_path / "c.json", GOOD))
    assert name != other
    assert (camera.width, camera.height) == (64, 48)
    assert camera.fx == pytest.approx(32.0) and camera.fy == pytest.approx(32.0)
    assert (camera.cx, camera.cy) == (32.0, 24.0)
    assert torch.allclose(camera.position, torch.tensor([0.5, -4.0, 0.25], dtype=torch.float64))
    ahead = camera.viewmat @ torch.tensor([0.5, 1.0, 0.25, 1.0], dtype=torch.float64)
    assert torch.allclose(ahead[:3], torch.tensor([0.0, 0.0, 5.0], dtype=torch.float64), atol=1e-12)
    above = camera.viewmat @ torch.tensor([0.5, 1.0, 1.25, 1.0], dtype=torch.float64)
    assert above[1] < 0, "up in the scene is towards smaller rows"


def test_focal_lengths_and_overrides_by_frame(tmp_path: Path) -> None:
    frames = [
        {"transform_matrix": POSE},
        {"transform_matrix": POSE, "fl_x": 10, "fl_y": 11.5, "cx": -3, "cy": 7, "w": 20, "h": 30},
    ]
    data = {"w": 64, "h": 48, "fl_x": 50.0, "frames": frames}
    (_, first), (_, second) = read_cameras(write(tmp_path / "c.json", data))
    assert (first.fx, first.fy, first.cx, first.cy) == (50.0, 50.0, 32.0, 24.0)
    assert (second.fx, second.fy, second.cx, second.cy, second.width, second.height) == (10.0, 11.5, -3.0, 7.0, 20, 30)


BAD: dict[str, dict[str, Any]] = {
    "frames is a list of 0": {"frames": []},
    r"frames\[0\] is": {"frames": ["a"]},
    'w is "64"': {"w": "64"},
    "w is missing; expected a positive whole number": {"w": None},
    "w is 1000000000; expected 1 to 32768 pixels": {"w": 10**9},
    "time is": {"frames": [{"transform_matrix": POSE, "time": "late"}]},
    "fps is 0; expected a number above 0": {"fps": 0},
    "fps is 6000; expected 0.1 to 240 frames per second": {"fps": 6000},
    r"frames\[0\]: the camera is a fisheye": {"camera_model": "OPENCV_FISHEYE"},
    "the camera is a fisheye": {"is_fisheye": True},
    "camera_model is .* expected one of OPENCV": {"camera_model": "EQUIRECTANGULAR"},
    "k1 is": {"k1": "none"},
    "transform_matrix is missing": {"frames": [{}]},
}


@pytest.mark.parametrize("words", BAD)
def test_bad_fields_are_refused_by_name(tmp_path: Path, words: str) -> None:
    """Other fields: the tests of the scenes' loaders, which read them with the same functions."""
    path = write(tmp_path / "my cameras.json", {**GOOD, **BAD[words]})
    with pytest.raises(DataError, match=words) as caught:
        read_cameras(path)
    assert str(path) in str(caught.value)


def test_three_rows_and_null_intrinsics_are_as_the_data_loaders_take_them(tmp_path: Path) -> None:
    data = {**GOOD, "fl_x": None, "frames": [{"transform_matrix": POSE[:3], "fl_x": None}]}
    ((_, camera),) = read_cameras(write(tmp_path / "c.json", data))
    assert camera.fx == pytest.approx(32.0) and torch.allclose(
        camera.position, torch.tensor([0.5, -4.0, 0.25], dtype=torch.float64)
    )


def test_times_rate_and_distortion_are_told(tmp_path: Path) -> None:
    frames = [{"transform_matrix": POSE, "time": 0.25, "k1": 0.1}, {"transform_matrix": POSE, "time": 1}]
    found = read_camera_file(write(tmp_path / "c.json", {**GOOD, "fps": 24, "p2": 0.0, "frames": frames}))
    assert found.times == (0.25, 1.0) and found.fps == 24.0
    assert found.notes == ("the lens distortion of 1 of 2 cameras is left out",)
    plain = read_camera_file(write(tmp_path / "c.json", {**GOOD, "frames": [frames[0], {"transform_matrix": POSE}]}))
    assert plain.times is None and plain.fps is None
    assert read_camera_file(write(tmp_path / "c.json", GOOD)).notes == ()


# ---------------------------------------------------------------- camera paths of nerfstudio's viewer

FLAT = [x for row in POSE for x in row]
PATH: dict[str, Any] = {
    "camera_type": "perspective",
    "render_height": 48,
    "render_width": 64,
    "fps": 24,
    "seconds": 4,
    "camera_path": [
        {"camera_to_world": FLAT, "fov": 90.0, "aspect": 4 / 3},
        {"camera_to_world": POSE, "fov": 60, "aspect": 1},
    ],
}


def test_a_camera_path_has_vertical_fields_of_view_in_degrees(tmp_path: Path) -> None:
    found = read_camera_file(write(tmp_path / "c.json", PATH))
    (_, first), (_, second) = found.named
    assert (first.width, first.height, first.cx, first.cy) == (64, 48, 32.0, 24.0)
    assert first.fx == first.fy == pytest.approx(24.0) and second.fy == pytest.approx(24.0 / math.tan(math.pi / 6))
    pixels, z = first.project(
        torch.tensor([[0.5 + 1.0, -4.0 + 2.0, 0.25 + 0.5]], dtype=torch.float64)
    )  # 1 right, 2 ahead, 0.5 up
    assert pixels[0].tolist() == pytest.approx([32 + 12, 24 - 6]) and float(z) == pytest.approx(2.0)
    assert torch.equal(first.viewmat, second.viewmat), "rows, or numbers one by one"
    assert found.fps == 24 and found.times is None and "moved and scaled the scene" in found.notes[0]


BAD_PATHS: dict[str, dict[str, Any]] = {
    'camera_type is "fisheye"; expected perspective': {"camera_type": "fisheye"},
    r"camera_path\[0\] is 3; expected an object": {"camera_path": [3]},
    r"camera_path\[0\]: fov is 180": {"camera_path": [{"camera_to_world": FLAT, "fov": 180}]},
    "fov is missing": {"camera_path": [{"camera_to_world": FLAT}]},
    "expected a finite number": {"camera_path": [{"camera_to_world": ["a"] * 16, "fov": 50}]},
    'is "here"; expected 16 numbers': {"camera_path": [{"camera_to_world": "here", "fov": 50}]},
    "singular or scaled": {"camera_path": [{"camera_to_world": [2 * x for x in FLAT[:15]] + [1], "fov": 50}]},
    "render_width is null; expected a positive whole number": {"render_width": None},
    "render_height is 1000000; expected 1 to 32768 pixels": {"render_height": 10**6},
    "seconds is 0; expected a number above 0": {"fps": None, "seconds": 0},
    "seconds is 1e-09; expected 0.1 to 240 frames per second": {"fps": None, "seconds": 1e-9},
}


@pytest.mark.parametrize("words", BAD_PATHS)
def test_bad_camera_paths_are_refused_by_name_and_field(tmp_path: Path, words: str) -> None:
    with pytest.raises(DataError, match=words) as caught:
        read_camera_file(write(tmp_path / "path.json", {**PATH, **BAD_PATHS[words]}))
    assert "path.json" in str(caught.value) and "\n" not in str(caught.value)
