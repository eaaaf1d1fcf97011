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


@pytest.mark.parametrize("name", ["a.png", "left cam/IMG  1.png", "0001"])
def test_images_without_their_lines_of_points(tmp_path: Path, name: str) -> None:
    lines = [line.replace("a.png", name) for line in IMAGES.split("\n") if "png" in line]
    folder = model(tmp_path / "m", images="\n".join(lines[::-1]))
    with pytest.raises(DataError, match=r"images.txt: the line after image 1 is no line of points; expected X, Y, "):
        read_camera_file(folder)


@pytest.mark.parametrize("name", ["", "/"])
def test_images_without_names(tmp_path: Path, name: str) -> None:
    read = pycolmap.Reconstruction(str(model(tmp_path / "text")))
    read.images[1].name = name
    (tmp_path / "binary").mkdir()
    read.write_binary(str(tmp_path / "binary"))
    with pytest.raises(DataError, match=f"binary: image 1 has the name '{name}'; expected a file name"):
        read_camera_file(tmp_path / "binary")


@pytest.mark.skipif(not hasattr(pycolmap, "Rig"), reason="this pycolmap has no rigs")
@pytest.mark.parametrize("kind", ["bin", "txt"])
def test_poses_of_images_and_frames_must_agree(tmp_path: Path, kind: str) -> None:
    read = pycolmap.Reconstruction()
    rig, frame = pycolmap.Rig(rig_id=1), pycolmap.Frame(frame_id=1, rig_id=1)
    turned = pycolmap.Rotation3d([0.5, 0.5, 0.5, 0.5])
    images = [pycolmap.Image(name=f"{i}.png", camera_id=i, image_id=i) for i in (1, 2)]
    for i, image in enumerate(images, 1):
        lens = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[60, 60, 32, 24], camera_id=i)
        read.add_camera(lens)
        rig.add_ref_sensor(lens.sensor_id) if i == 1 else rig.add_sensor(
            lens.sensor_id, pycolmap.Rigid3d(turned, [0.1, 0.2, 0.3])
        )
        frame.add_data_id(image.data_id)
        image.frame_id = 1
    read.add_rig(rig)
    frame.rig_from_world = pycolmap.Rigid3d(turned, [1.0, 2.0, 3.0])
    read.add_frame(frame)
    for image in images:
        read.add_image(image)
    write = read.write_binary if kind == "bin" else read.write_text
    write(str(tmp_path))
    assert len(read_camera_file(tmp_path).named) == 2
    frames = (tmp_path / f"frames.{kind}").read_bytes()
    read.transform(pycolmap.Sim3d(10.0, pycolmap.Rotation3d(), [0.0, 0.0, 0.0]))
    write(str(tmp_path))
    (tmp_path / f"frames.{kind}").write_bytes(frames)
    with pytest.raises(DataError, match=rf"pose of image 1.png in images.{kind} differs from that in frames.{kind}"):
        read_camera_file(tmp_path)
