"""COLMAP loader on tiny models written with pycolmap."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.cameras.camera_files import read_camera_file
from neuprim.core.cameras.colmap import check_binary_colmap_model
from neuprim.core.errors import NeuprimWarning
from neuprim.tasks.static.datasets import load_colmap as load

W, H = 64, 50
PARAMS = {
    "SIMPLE_PINHOLE": [60.0, 29.3, 27.1],
    "PINHOLE": [60.0, 66.0, 29.3, 27.1],
    "SIMPLE_RADIAL": [60.0, 29.3, 27.1, -0.2],
    "OPENCV": [60.0, 66.0, 29.3, 27.1, -0.2, 0.05, 0.01, -0.02],
    "OPENCV_FISHEYE": [60.0, 66.0, 29.3, 27.1, 0.05, -0.01, 0.0, 0.0],
}
POINTS = np.array([[0.21, -0.13, 0.34], [1.0, 2.0, 3.0]])
COLORS = np.array([[255, 0, 0], [0, 51, 255]], dtype=np.uint8)


@pytest.fixture
def pycolmap() -> Any:
    return pytest.importorskip("pycolmap", reason="needs pycolmap: pip install 'neuprim[colmap]'")


@pytest.fixture
def capture(tmp_path: Path, scenes: Any, pycolmap: Any) -> Callable[..., Path]:
    """Writes 10 views of one mark, each the given camera's own projection of it."""

    def write(model: str = "PINHOLE", params: list[float] | None = None, text: bool = False) -> Path:
        path, count = tmp_path / "toy", 10
        reconstruction = pycolmap.Reconstruction()
        lens = pycolmap.Camera(model=model, width=W, height=H, params=params or PARAMS[model], camera_id=1)
        reconstruction.add_camera_with_trivial_rig(lens)
        for i, pose in enumerate(scenes.ring(count, radius=1.6)):
            view = np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
            u, v = 30.0, 25.0
            if params is None:
                u, v = lens.img_from_cam((view @ np.append(scenes.mark, 1.0))[None, :3])[0]
            scenes.save(path / "images" / f"{i:02d}.png", scenes.blob(W, H, u, v, 1.0))
            rigid = pycolmap.Rigid3d(pycolmap.Rotation3d(view[:3, :3]), view[:3, 3])
            # numbers run against the names, which decide the order
            image = pycolmap.Image(name=f"{i:02d}.png", camera_id=1, image_id=count - i)
            reconstruction.add_image_with_trivial_frame(image, rigid)
        for xyz, color in zip(POINTS, COLORS, strict=True):
            reconstruction.add_point3D(xyz, pycolmap.Track(), color)
        (path / "sparse" / "0").mkdir(parents=True)
        (reconstruction.write_text if text else reconstruction.write)(str(path / "sparse" / "0"))
        return path

    return write


def worst(scenes: Any, data: Any) -> float:
    return max(scenes.off_by(s, i) for s in (data.train, data.test) for i in range(len(s)))


@pytest.mark.parametrize("model", list(PARAMS))
def test_marks_are_where_cameras_say(capture: Any, scenes: Any, context: Any, model: str) -> None:
    path = capture(model)
    data = load({"path": path}, context)
    assert worst(scenes, data) < (0.02 if "PINHOLE" in model else 0.06)
    assert (data.train.pixels(0).mask is None) == ("PINHOLE" in model)
    assert [data.test.view(i).name for i in range(len(data.test))] == ["00", "08"] and len(data.train) == 8
    assert (data.name, data.color_space, data.downsampling) == ("toy", "srgb", "none")
    points = data.initial_points(10, torch.Generator().manual_seed(0))
    assert np.allclose(points.means, POINTS) and np.allclose(points.colors, COLORS / 255.0)
    assert worst(scenes, load({"path": path, "downsample": 2}, context)) < 0.06


def test_names_with_blanks_are_whole_in_text_models(capture: Any, context: Any) -> None:
    path = capture(text=True)
    file = path / "sparse" / "0" / "images.txt"
    file.write_text(file.read_text().replace(" 03.png", " left cam/IMG  0003.JPG"))
    (path / "images" / "left cam").mkdir()
    (path / "images" / "03.png").rename(path / "images" / "left cam" / "IMG  0003.jpg")  # and in another case
    data = load({"path": path}, context)
    assert "IMG  0003" in [data.train.view(i).name for i in range(len(data.train))]


@pytest.fixture
def two(capture: Any, pycolmap: Any) -> Path:
    """A reconstruction in two models: ``sparse/0`` has three of the ten images, ``sparse/1`` all."""
    path: Path = capture()
    sparse = path / "sparse"
    (sparse / "0").rename(sparse / "1")
    model = pycolmap.Reconstruction(str(sparse / "1"))
    (sparse / "0").mkdir()
    for image in sorted(model.images.values(), key=lambda i: i.name)[3:]:
        model.deregister_frame(image.frame_id)
    model.write(str(sparse / "0"))
    return path


def test_the_largest_of_several_models_is_taken_and_told(two: Path, context: Any) -> None:
    with pytest.warns(
        NeuprimWarning, match=r"0 with 3, 1 with 10 posed images; 1 is used \(scene.model=DIR chooses another\)"
    ):
        data = load({"path": two}, context)
    assert len(data.train) + len(data.test) == 10
    with pytest.warns(NeuprimWarning, match=r"7 of 10 images have no pose in .*sparse/0, e.g. 03.png"):
        data = load({"path": two, "model": "sparse/0"}, context)
    assert len(data.train) + len(data.test) == 3
    assert len(read_camera_file(two).named) == 10


@pytest.mark.parametrize("name", ["masks/03.png", "masks/03.png.png"])
def test_masks_beside_the_images_count(capture: Any, context: Any, name: str) -> None:
    path = capture()
    mask = np.full((H, W), 255, np.uint8)
    mask[:, :20] = 0
    (path / "masks").mkdir()
    Image.fromarray(mask).save(path / name)
    with pytest.warns(NeuprimWarning, match=r"found masks for 1 of 10 images"):
        data = load({"path": path}, context)
    masks = {data.train.view(i).name: data.train.pixels(i).mask for i in range(len(data.train))}
    assert masks["01"] is None and np.array_equal(masks["03"], mask > 0)


def test_damaged_views_are_left_out(capture: Any, scenes: Any, context: Any) -> None:
    path = capture(text=True)
    file = path / "images" / "03.png"
    file.write_bytes(file.read_bytes()[:-40])
    with pytest.warns(NeuprimWarning, match=r"03.png: .*truncated or corrupt.*; view 03 is left out"):
        data = load({"path": path}, context)
    assert len(data.train) == 7 and len(data.test) == 2 and worst(scenes, data) < 0.02


@pytest.mark.parametrize("model", ["PINHOLE", "OPENCV"])
def test_reduced_folders_scale_the_camera_to_the_actual_size(
    capture: Any, scenes: Any, context: Any, pycolmap: Any, model: str
) -> None:
    path = capture(model)
    lens = pycolmap.Camera(model=model, width=W, height=H, params=PARAMS[model])
    w, h = 21, 17  # a third of 64 x 50, each side rounded
    for i, pose in enumerate(scenes.ring(10, radius=1.6)):
        view = np.linalg.inv(pose @ np.diag([1.0, -1.0, -1.0, 1.0]))
        u, v = lens.img_from_cam((view @ np.append(scenes.mark, 1.0))[None, :3])[0]
        scenes.save(path / "images_3" / f"{i:02d}.png", scenes.blob(w, h, u * w / W, v * h / H, 0.8))
    data = load({"path": path, "images": "images_3"}, context)
    assert worst(scenes, data) < 0.1 and data.downsampling == "images_3"
    assert (data.train.view(0).camera.width, data.train.view(0).camera.height) == (w, h)
    data = load({"path": path, "images": "images_3", "downsample": 2}, context)
    assert data.downsampling == "images_3, then 10x8 from 21x17 by area"


def test_test_every_and_skip_missing(capture: Any, scenes: Any, context: Any) -> None:
    path = capture()
    assert len(load({"path": path, "test_every": 5}, context).test) == 2
    for i in (3, 4):
        (path / "images" / f"{i:02d}.png").unlink()
    scenes.refused(load, {"path": path}, context, "2 files not found", "03.png", "04.png", "scene.skip_missing=true")
    data = load({"path": path, "skip_missing": True}, context)
    assert len(data.train) + len(data.test) == 8 and worst(scenes, data) < 0.02


def test_models_with_rigs_of_two_cameras(tmp_path: Path, pycolmap: Any) -> None:
    if not hasattr(pycolmap, "Rig"):
        pytest.skip("this pycolmap has no rigs")
    reconstruction = pycolmap.Reconstruction()
    rig = pycolmap.Rig(rig_id=1)
    for i in (1, 2):
        lens = pycolmap.Camera(model="PINHOLE", width=W, height=H, params=PARAMS["PINHOLE"], camera_id=i)
        reconstruction.add_camera(lens)
        sensor = pycolmap.sensor_t(pycolmap.SensorType.CAMERA, i)
        if i == 1:
            rig.add_ref_sensor(sensor)
        else:
            rig.add_sensor(sensor, pycolmap.Rigid3d())
    reconstruction.add_rig(rig)
    reconstruction.write(str(tmp_path))
    check_binary_colmap_model(tmp_path, lambda model: 4)


@pytest.mark.parametrize(
    ("params", "words"),
    [
        ([0.0, 66.0, 29.3, 27.1], ["fx=0.0", "focal lengths above 0"]),
        ([60.0, -66.0, 29.3, 27.1], ["fy=-66.0"]),
        ([60.0, 66.0, float("nan"), 27.1], ["nan", "finite"]),
    ],
)
def test_impossible_cameras(capture: Any, scenes: Any, context: Any, params: list[float], words: list[str]) -> None:
    scenes.refused(load, {"path": capture("PINHOLE", params)}, context, "camera 1 of image 00.png", *words)


def test_wrong_image_shape(capture: Any, scenes: Any, context: Any) -> None:
    path = capture()
    scenes.save(path / "images" / "03.png", np.zeros((H, W // 2)))
    scenes.refused(load, {"path": path}, context, "03.png", "32x50", "expected 64x50", "or a reduction")
