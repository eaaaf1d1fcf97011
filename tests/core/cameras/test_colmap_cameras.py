"""Cameras of COLMAP's models: text and binary, with and without points, and lenses that no pinhole can stand in for."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest
import torch

from neuprim.core.cameras.camera_files import read_camera_file
from neuprim.core.errors import DataError

pycolmap = pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'neuprim[colmap]'")

CAMERAS = "# Camera list\n1 PINHOLE 640 480 500 510 320.5 240.25\n2 SIMPLE_RADIAL 64 48 60 32 24 0.1\n"
# at (1, 2, -3) looking along +z of the world, y down: the world is the camera's frame, moved
IMAGES = "2 1 0 0 0 -1 -2 3 1 b.png\n10 20 5\n1 1 0 0 0 -1 -2 3 1 a.png\n\n"


def model(folder: Path, cameras: str = CAMERAS, images: str = IMAGES, points: str | None = "") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (("cameras", cameras), ("images", images), ("points3D", points)):
        if text is not None:
            (folder / f"{name}.txt").write_text(text)
    return folder


def check(path: Path) -> None:
    found = read_camera_file(path)
    assert [name for name, _ in found.named] == ["a", "b"] and found.notes == () and found.times is None
    camera = found.named[0][1]
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (500, 510, 320.5, 240.25)
    assert (camera.width, camera.height) == (640, 480)
    pixels, z = camera.project(torch.tensor([[1.5, 2.4, -1.0]], dtype=torch.float64))  # 0.5 right, 0.4 down, 2 ahead
    assert pixels[0].tolist() == pytest.approx([320.5 + 125, 240.25 + 102]) and float(z) == pytest.approx(2.0)


def test_a_model_by_its_folder_its_files_and_its_project(tmp_path: Path) -> None:
    folder = model(tmp_path / "project" / "sparse" / "0")
    for path in (folder, folder / "cameras.txt", folder / "images.txt", tmp_path / "project"):
        check(path)


def test_points_may_be_missing(tmp_path: Path) -> None:
    folder = model(tmp_path / "m", images=IMAGES.replace("10 20 5", "10 20 7"), points=None)
    check(folder)
    assert not (folder / "points3D.txt").exists()


def test_distortion_is_told_and_fisheyes_are_refused(tmp_path: Path) -> None:
    folder = model(tmp_path / "m", images=IMAGES.replace("1 a.png", "2 a.png"))
    assert read_camera_file(folder).notes == ("the lens distortion of 1 of 2 cameras (SIMPLE_RADIAL) is left out",)
    straight = model(tmp_path / "s", CAMERAS.replace("24 0.1", "24 0"), IMAGES.replace("1 a.png", "2 a.png"))
    assert read_camera_file(straight).notes == ()
    for lens in ("OPENCV_FISHEYE 640 480 500 500 320 240 0 0 0 0", "FOV 640 480 500 500 320 240 0.5"):
        bent = model(tmp_path / lens[:3], f"1 {lens}\n")
        with pytest.raises(DataError, match=r"camera 1 of image a.png: model is \w+; expected one of SIMPLE_PINHOLE"):
            read_camera_file(bent)


def test_a_count_that_the_file_does_not_pay_for(tmp_path: Path) -> None:
    read = pycolmap.Reconstruction(str(model(tmp_path / "text")))
    (tmp_path / "binary").mkdir()
    read.write_binary(str(tmp_path / "binary"))
    path = tmp_path / "binary" / "images.bin"
    path.write_bytes(struct.pack("<Q", 2**60) + path.read_bytes()[8:])
    with pytest.raises(DataError, match=r"images.bin: truncated or corrupt"):
        read_camera_file(tmp_path / "binary")
