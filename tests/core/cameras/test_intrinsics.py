"""Intrinsics of transforms files: which record wins, what agrees, and what is refused; and the keys beside them."""

from __future__ import annotations

import math
from typing import Any

import pytest

from neuprim.core.cameras.intrinsics import (
    CameraTarget,
    describe_unknown_camera_keys,
    has_fisheye_lens,
    read_camera,
    read_lens_coefficients,
    refuse_unsupported_camera_keys,
)
from neuprim.core.errors import DataError
from neuprim.core.io.json_reader import JsonReader

POSE = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 3.0]]
IMAGE = CameraTarget(64, 48, "a.png")
PORTRAIT = CameraTarget(48, 72, "a.png")
ANGLE = 2 * math.atan(32 / 50)
"""Of 50 pixels on an image 64 wide."""


def camera(
    frame: dict[str, Any], file: dict[str, Any], target: CameraTarget = IMAGE
) -> tuple[tuple[float, ...], list[str]]:
    """fx, fy, cx, cy and what was said."""
    said: list[str] = []
    own = JsonReader({"transform_matrix": POSE, **frame}, "t.json: frames[0]")
    found = read_camera(own, JsonReader(file, "t.json"), target, None, said.append)
    return tuple(round(v, 3) for v in (found.fx, found.fy, found.cx, found.cy)), said


@pytest.mark.parametrize(
    ("frame", "file", "expected"),
    [
        ({}, {"fl_x": 50}, (50, 50, 32, 24)),
        ({}, {"fl_y": 50}, (50, 50, 32, 24)),
        ({}, {"fl_x": 50, "fl_y": 55, "cx": 30, "cy": 25}, (50, 55, 30, 25)),
        ({}, {"camera_angle_x": ANGLE}, (50, 50, 32, 24)),
        ({}, {"x_fov": math.degrees(ANGLE)}, (50, 50, 32, 24)),
        ({}, {"camera_intrinsics": [30, 25, 50, 55]}, (50, 55, 30, 25)),
        ({}, {"fl_x": 50, "camera_angle_x": ANGLE * 1.005, "cx": 32.2}, (50, 50, 32.2, 24)),
        ({"camera_angle_x": ANGLE}, {"fl_x": 90, "fl_y": 90, "cx": 32, "cy": 24}, (50, 50, 32, 24)),
        ({"fl_x": 50}, {"fl_x": 90, "fl_y": 95}, (50, 50, 32, 24)),
        ({"fl_x": 50}, {"camera_angle_x": 1.5, "camera_angle_y": 1.2}, (50, 50, 32, 24)),
        ({"fl_x": 50}, {"camera_intrinsics": [5, 5, 90, 90]}, (50, 50, 32, 24)),
        ({"camera_intrinsics": [30, 25, 50, 55]}, {"fl_x": 90, "cx": 5, "cy": 5}, (50, 55, 30, 25)),
        ({"fl_x": 50}, {"cx": 30, "cy": 25}, (50, 50, 30, 25)),
        ({"cx": 30, "cy": 25}, {"fl_x": 50, "cx": 5, "cy": 5}, (50, 50, 30, 25)),
        ({}, {"fl_x": 100, "cx": 60, "cy": 50, "w": 128, "h": 96}, (50, 50, 30, 25)),
        ({}, {"fl_x": 25, "cx": 15, "cy": 12.5, "w": 32, "h": 24}, (50, 50, 30, 25)),
        ({"w": 64, "h": 48}, {"fl_x": 100, "w": 128, "h": 96}, (50, 50, 32, 24)),
        ({"w": 64, "h": 48}, {"camera_angle_x": ANGLE, "w": 100, "h": 20}, (50, 50, 32, 24)),
    ],
)
def test_the_frames_own_wins_whole_and_lengths_follow_the_size(
    frame: Any, file: Any, expected: tuple[float, ...]
) -> None:
    assert camera(frame, file)[0] == expected


@pytest.mark.parametrize(
    ("frame", "file", "words"),
    [
        ({}, {}, "frames\\[0\\]: no focal length"),
        ({}, {"fl_x": 50, "camera_angle_x": 0.9}, "t.json: fl_x gives .* of 50 pixels, but camera_angle_x gives 66"),
        ({"fl_x": 50, "x_fov": 40}, {}, "frames\\[0\\]: fl_x gives .* x_fov gives 87.9"),
        ({}, {"fl_y": 50, "y_fov": 40}, "fl_y gives .* y_fov gives 65.9"),
        (
            {},
            {"fl_x": 50, "fl_y": 90, "camera_angle_x": ANGLE, "camera_angle_y": 0.895},
            "fl_y gives .* camera_angle_y gives 50",
        ),
        ({}, {"fl_x": 50, "camera_intrinsics": [32, 24, 60, 60]}, "fl_x gives .* camera_intrinsics gives 60"),
        ({}, {"cx": 20, "camera_intrinsics": [32, 24, 60, 60]}, "cx, cy are .* camera_intrinsics begins"),
        ({}, {"camera_angle_x": ANGLE, "camera_angle_y": 0.6}, "pixels that are not square"),
        ({}, {"fl_x": 50, "w": 100, "h": 48}, "a.png: image is 64x48; expected 100x48"),
        ({}, {"fl_x": 100, "cx": 64, "cy": 48}, "centre of an image of 128x96, .* expected w, h"),
        ({}, {"fl_x": 100, "cx": 48, "cy": 36}, "centre of an image of 96x72"),
        ({}, {"fl_x": 25, "cx": 16, "cy": 12}, "centre of an image of 32x24"),
        ({}, {"fl_x": 50, "cx": 64, "cy": 20, "w": 64, "h": 48}, "principal point outside of a.png"),
        ({}, {"camera_intrinsics": [50, 55, 30, 25]}, r"outside of a.png .* \[cx, cy, fx, fy\]"),
        ({}, {"fl_x": 0.78, "cx": 0.5, "cy": 0.5}, "0.78 pixels on 64x48, a field of view above 170 degrees"),
        ({}, {"x_fov": 178}, "view above 170 degrees"),
        ({}, {"fl_x": 50, "cx": 0.5, "cy": 0.5, "w": 64, "h": 48}, "expected pixels, not fractions of the image"),
        ({"fl_x": 90}, {"fl_x": 50, "cx": 20, "cy": 24}, "its own focal length, but cx of the file"),
        ({"fl_x": 90}, {"fl_x": 50, "k1": 0.1}, "k1 of the file"),
        ({"cx": 30}, {"fl_x": 50, "cx": 20, "cy": 20}, "the frame has only one of cx, cy"),
        ({"w": 64, "h": 48}, {"fl_x": 50, "w": 100, "h": 20}, "fl_x, fl_y are for images of 100x20 \\(w, h\\)"),
    ],
)
def test_contradictions_are_refused(frame: Any, file: Any, words: str) -> None:
    with pytest.raises(DataError, match=words):
        camera(frame, file)


def test_the_sensors_angles_of_blender_give_way_to_lengths_in_pixels() -> None:
    """BlenderNeRF writes angle_x of the image's longer side, and angle_y of a sensor that the image does not fill."""
    angle = 2 * math.atan(36 / 2 / 50)
    focal = 72 * 50 / 36
    lengths = {"fl_x": focal, "fl_y": focal, "cx": 24, "cy": 36}
    found, said = camera({}, {"camera_angle_x": angle, "camera_angle_y": 0.471, **lengths}, PORTRAIT)
    assert found == (100, 100, 24, 36) and len(said) == 2 and all("is taken" in line for line in said)


def test_a_lens_comes_whole_from_the_frame() -> None:
    frame = JsonReader({"k1": 0.1}, "f")
    file = JsonReader({"k1": 0.5, "k2": 0.5, "camera_model": "OPENCV_FISHEYE"}, "t")
    assert (read_lens_coefficients(frame, file)["k1"], read_lens_coefficients(frame, file)["k2"]) == (0.1, 0.0)
    assert has_fisheye_lens(frame, file), "the model is not among the coefficients"
    assert not has_fisheye_lens(JsonReader({"camera_model": "OPENCV"}, "f"), file)
    with pytest.raises(DataError, match=r"camera_model is .FULL_OPENCV"):
        has_fisheye_lens(JsonReader({"camera_model": "FULL_OPENCV"}, "f"), file)


REFUSED: dict[str, Any] = {"latlong": True, "equirectangular": 1, "ftheta_p1": 0.3, "ortho": True, "k5": 0.01}
REFUSED |= {"rolling_shutter": [0, 0.1, 0, 0], "transform_matrix_start": POSE, "shift_x": 0.2, "lens_model": "fov"}
REFUSED |= {"distortion_params": [0.1, 0, 0, 0], "camera_type": "EQUIRECTANGULAR", "white_transparent": True}
REFUSED |= {"driver_parameters": {"LightX": 1}, "from_na": True}


@pytest.mark.parametrize("key", REFUSED)
def test_keys_that_change_the_picture_are_refused_by_name(key: str) -> None:
    with pytest.raises(DataError, match=f"t.json: {key} "):
        refuse_unsupported_camera_keys(JsonReader({key: REFUSED[key]}, "t.json"))


def test_unknown_keys_are_named_once_and_those_of_real_files_are_not() -> None:
    known = {"aabb_scale": 16, "applied_transform": POSE, "frames": [], "orientation_override": "none"}
    file = JsonReader({**known, "is_fisheye": False, "from_na": False, "exposures": 1}, "t.json")
    frame = {"file_path": "a", "colmap_im_id": 1, "sharpness": 3.0, "time": 0.1, "depth_file_path": "d"}
    frames = [JsonReader(frame, "f")] * 3
    refuse_unsupported_camera_keys(file)
    line = describe_unknown_camera_keys(file, frames, ())
    assert line.startswith("t.json: keys that are not read: exposures, frames[].time; task=dynamic")
    assert describe_unknown_camera_keys(file, frames, ("time", "exposures")) == ""
