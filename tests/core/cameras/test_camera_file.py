"""Cameras from JSON."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.core.cameras.file import read_cameras
from neuprim.core.errors import DataError

POSE = [[1.0, 0.0, 0.0, 0.5], [0.0, 0.0, -1.0, -4.0], [0.0, 1.0, 0.0, 0.25], [0.0, 0.0, 0.0, 1.0]]  # at (0.5, -4, 0.25), looking along +y
GOOD: dict[str, Any] = {"w": 64, "h": 48, "camera_angle_x": math.pi / 2, "frames": [{"transform_matrix": POSE}, {"transform_matrix": POSE}]}


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
    frames = [{"transform_matrix": POSE}, {"transform_matrix": POSE, "fl_x": 10, "fl_y": 11.5, "cx": -3, "cy": 7, "w": 20, "h": 30}]
    data = {"w": 64, "h": 48, "fl_x": 50.0, "frames": frames}
    (_, first), (_, second) = read_cameras(write(tmp_path / "c.json", data))
    assert (first.fx, first.fy, first.cx, first.cy) == (50.0, 50.0, 32.0, 24.0)
    assert (second.fx, second.fy, second.cx, second.cy, second.width, second.height) == (10.0, 11.5, -3.0, 7.0, 20, 30)


def test_size_from_outside_serves_where_the_file_names_none(tmp_path: Path) -> None:
    data = {k: v for k, v in GOOD.items() if k not in ("w", "h")}
    (_, camera), _ = read_cameras(write(tmp_path / "c.json", data), (30, 20))
    assert (camera.width, camera.height, camera.fx) == (30, 20, pytest.approx(15.0))
    (_, camera), _ = read_cameras(write(tmp_path / "d.json", GOOD), (30, 20))
    assert (camera.width, camera.height) == (64, 48)


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
    ("list", [], "frames"),
    ("no frames", {k: v for k, v in GOOD.items() if k != "frames"}, "frames"),
    ("empty frames", {**GOOD, "frames": []}, "frames"),
    ("frames of text", {**GOOD, "frames": ["a"]}, r"frames\[0\]"),
    ("no width", {k: v for k, v in GOOD.items() if k != "w"}, "'w'"),
    ("width of text", {**GOOD, "w": "64"}, "w is '64'"),
    ("width true", {**GOOD, "w": True}, "w is True"),
    ("width zero", {**GOOD, "w": 0}, "size"),
    ("width negative", {**GOOD, "h": -5}, "size"),
    ("width huge", {**GOOD, "w": 10**9}, "size"),
    ("width beyond floats", {**GOOD, "w": HUGE}, "w"),
    ("width infinite", '{"w": 1e999, "h": 4, "fl_x": 3, "frames": [{}]}', "w"),
    ("no angle", {k: v for k, v in GOOD.items() if k != "camera_angle_x"}, "camera_angle_x"),
    ("angle zero", {**GOOD, "camera_angle_x": 0.0}, "camera_angle_x"),
    ("angle in degrees", {**GOOD, "camera_angle_x": 60.0}, "camera_angle_x"),
    ("angle nan", '{"w": 4, "h": 4, "camera_angle_x": NaN, "frames": [{}]}', "camera_angle_x"),
    ("focal zero", {**GOOD, "fl_x": 0}, "focal"),
    ("focal negative", {**GOOD, "fl_x": 50, "fl_y": -50}, "focal"),
    ("focal null", {**GOOD, "fl_x": None}, "fl_x"),
    ("centre of text", {**GOOD, "cx": "middle"}, "cx"),
    ("no matrix", {**GOOD, "frames": [{}]}, "transform_matrix"),
    ("matrix null", {**GOOD, "frames": [{"transform_matrix": None}]}, "transform_matrix"),
    ("matrix object", {**GOOD, "frames": [{"transform_matrix": {"a": 1}}]}, "transform_matrix"),
    ("matrix of text", {**GOOD, "frames": [{"transform_matrix": [["a"] * 4] * 4}]}, "transform_matrix"),
    ("matrix ragged", {**GOOD, "frames": [{"transform_matrix": [*POSE[:3], [0, 1]]}]}, "transform_matrix"),
    ("matrix 3x4", {**GOOD, "frames": [{"transform_matrix": POSE[:3]}]}, "transform_matrix"),
    ("matrix number", {**GOOD, "frames": [{"transform_matrix": 3}]}, "transform_matrix"),
    ("matrix beyond floats", {**GOOD, "frames": [{"transform_matrix": pose(m03=HUGE)}]}, "transform_matrix"),
    ("pose infinite", json.dumps({**GOOD, "frames": [{"transform_matrix": pose(m03=12345.5)}]}).replace("12345.5", "1e999"), "non-finite"),
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


def test_the_bad_frame_is_named(tmp_path: Path) -> None:
    path = write(tmp_path / "c.json", {**GOOD, "frames": [{"transform_matrix": POSE}, {"transform_matrix": pose(m00=-1.0)}]})
    with pytest.raises(DataError, match=r"frames\[1\]"):
        read_cameras(path)


def test_missing_file_folder_and_bytes(tmp_path: Path) -> None:
    (tmp_path / "bytes.json").write_bytes(b"\xff\xfe\x00{}")
    for path in (tmp_path / "none.json", tmp_path, tmp_path / "bytes.json"):
        with pytest.raises(DataError, match=path.name):
            read_cameras(path)


def test_a_file_too_large_is_not_read(tmp_path: Path) -> None:
    path = tmp_path / "large.json"
    with open(path, "wb") as file:
        file.truncate(10 * 2**30)  # sparse
    with pytest.raises(DataError, match="bytes"):
        read_cameras(path)
