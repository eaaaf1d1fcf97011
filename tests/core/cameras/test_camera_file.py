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
GOOD: dict[str, Any] = {
    "w": 64,
    "h": 48,
    "camera_angle_x": math.pi / 2,
    "frames": [{"transform_matrix": POSE}, {"transform_matrix": POSE}],
}


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


def pose(**cells: Any) -> list[list[Any]]:
    matrix: list[list[Any]] = [list(row) for row in POSE]
    for key, value in cells.items():
        matrix[int(key[1])][int(key[2])] = value
    return matrix


HUGE = 10**400
BAD: list[tuple[str, Any, str]] = [
    ("empty", "", "JSON"),
    ("text", "cameras", "JSON"),
    ("cut", json.dumps(GOOD)[:-40], "JSON"),
    ("nested", "[" * 100_000, "JSON"),
    ("list", [], "a list of 0; expected an object"),
    ("no frames", {k: v for k, v in GOOD.items() if k != "frames"}, "frames"),
    ("empty frames", {**GOOD, "frames": []}, "frames"),
    ("frames of text", {**GOOD, "frames": ["a"]}, r"frames\[0\]"),
    ("no width", {k: v for k, v in GOOD.items() if k != "w"}, "w is missing"),
    ("width of text", {**GOOD, "w": "64"}, 'w is "64"'),
    ("width true", {**GOOD, "w": True}, "w is true"),
    ("width zero", {**GOOD, "w": 0}, "w is 0; expected a positive whole number"),
    ("width negative", {**GOOD, "h": -5}, "h is -5; expected a positive whole number"),
    ("width huge", {**GOOD, "w": 10**9}, "w is 1000000000; expected 1 to 32768 pixels"),
    ("width beyond floats", {**GOOD, "w": HUGE}, "not valid JSON"),
    ("width infinite", '{"w": 1e999, "h": 4, "fl_x": 3, "frames": [{}]}', "w"),
    ("no angle", {k: v for k, v in GOOD.items() if k != "camera_angle_x"}, "camera_angle_x"),
    ("angle zero", {**GOOD, "camera_angle_x": 0.0}, "camera_angle_x"),
    ("angle in degrees", {**GOOD, "camera_angle_x": 60.0}, "camera_angle_x"),
    ("angle nan", '{"w": 4, "h": 4, "camera_angle_x": NaN, "frames": [{}]}', "camera_angle_x"),
    ("focal zero", {**GOOD, "fl_x": 0}, "focal"),
    ("focal negative", {**GOOD, "fl_x": 50, "fl_y": -50}, "focal"),
    ("width of halves", {**GOOD, "w": 64.5}, "w is 64.5; expected a positive whole number"),
    ("time of text", {**GOOD, "frames": [{"transform_matrix": POSE, "time": "late"}]}, "time is"),
    ("rate", {**GOOD, "fps": 0}, "fps is 0; expected a number above 0"),
    ("rate of ticks", {**GOOD, "fps": 6000}, "fps is 6000; expected 0.1 to 240 frames per second"),
    ("fisheye", {**GOOD, "camera_model": "OPENCV_FISHEYE"}, r"frames\[0\]: the camera is a fisheye"),
    ("fisheye by a flag", {**GOOD, "is_fisheye": True}, "the camera is a fisheye"),
    ("panorama", {**GOOD, "camera_model": "EQUIRECTANGULAR"}, "camera_model is .* expected one of OPENCV"),
    ("distortion of text", {**GOOD, "k1": "none"}, "k1 is"),
    ("centre of text", {**GOOD, "cx": "middle"}, "cx"),
    ("no matrix", {**GOOD, "frames": [{}]}, "transform_matrix"),
    ("matrix null", {**GOOD, "frames": [{"transform_matrix": None}]}, "transform_matrix"),
    ("matrix object", {**GOOD, "frames": [{"transform_matrix": {"a": 1}}]}, "transform_matrix"),
    ("matrix of text", {**GOOD, "frames": [{"transform_matrix": [["a"] * 4] * 4}]}, "transform_matrix"),
    ("matrix ragged", {**GOOD, "frames": [{"transform_matrix": [*POSE[:3], [0, 1]]}]}, "transform_matrix"),
    ("matrix 2x4", {**GOOD, "frames": [{"transform_matrix": POSE[:2]}]}, "transform_matrix"),
    (
        "matrix with a projection",
        {**GOOD, "frames": [{"transform_matrix": pose(m30=1.0)}]},
        r"transform_matrix\[3\] is",
    ),
    ("matrix number", {**GOOD, "frames": [{"transform_matrix": 3}]}, "transform_matrix"),
    ("matrix beyond floats", {**GOOD, "frames": [{"transform_matrix": pose(m03=HUGE)}]}, "not valid JSON"),
    (
        "pose infinite",
        json.dumps({**GOOD, "frames": [{"transform_matrix": pose(m03=12345.5)}]}).replace("12345.5", "1e999"),
        "Infinity; expected a finite number",
    ),
    ("pose scaled", {**GOOD, "frames": [{"transform_matrix": pose(m00=2.0)}]}, "rotation"),
    ("pose singular", {**GOOD, "frames": [{"transform_matrix": pose(m00=0.0)}]}, "rotation"),
    ("pose mirrored", {**GOOD, "frames": [{"transform_matrix": pose(m00=-1.0)}]}, "mirrored"),
]


@pytest.mark.parametrize(("data", "words"), [(d, w) for _, d, w in BAD], ids=[n for n, _, _ in BAD])
def test_bad_files_are_refused_by_name_and_field(tmp_path: Path, data: Any, words: str) -> None:
    path = write(tmp_path / "my cameras.json", data)
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


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"camera_type": "fisheye"}, 'camera_type is "fisheye"; expected perspective'),
        ({"camera_type": 3}, "camera_type is 3; expected perspective"),
        ({"camera_path": []}, "camera_path is a list of 0; expected a non-empty list"),
        ({"camera_path": [3]}, r"camera_path\[0\] is 3; expected an object"),
        ({"camera_path": {"a": 1}}, "camera_path is an object; expected a non-empty list"),
        (
            {"camera_path": [{"camera_to_world": FLAT, "fov": 180}]},
            r"camera_path\[0\]: fov is 180; expected a vertical field of view in degrees",
        ),
        ({"camera_path": [{"camera_to_world": FLAT}]}, "fov is missing"),
        (
            {"camera_path": [{"camera_to_world": FLAT[:15], "fov": 50}]},
            "camera_to_world is a list of 15; expected 16 numbers",
        ),
        (
            {"camera_path": [{"camera_to_world": ["a"] * 16, "fov": 50}]},
            r"camera_to_world\[0\]\[0\] is .*expected a finite number",
        ),
        ({"camera_path": [{"camera_to_world": "here", "fov": 50}]}, 'camera_to_world is "here"; expected 16 numbers'),
        (
            {"camera_path": [{"camera_to_world": [2 * x for x in FLAT[:15]] + [1], "fov": 50}]},
            "rotation is singular or scaled",
        ),
        ({"render_width": None}, "render_width is null; expected a positive whole number"),
        ({"render_height": 10**6}, "render_height is 1000000; expected 1 to 32768 pixels"),
        ({"fps": None, "seconds": 0}, "seconds is 0; expected a number above 0"),
        ({"fps": None, "seconds": 1e-9}, "seconds is 1e-09; expected 0.1 to 240 frames per second"),
    ],
)
def test_bad_camera_paths_are_refused_by_name_and_field(tmp_path: Path, change: dict[str, Any], words: str) -> None:
    with pytest.raises(DataError, match=words) as caught:
        read_camera_file(write(tmp_path / "path.json", {**PATH, **change}))
    assert "path.json" in str(caught.value) and "\n" not in str(caught.value)
