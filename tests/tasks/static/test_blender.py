"""NeRF-synthetic loader: conventions on marks of known place, and every kind of bad input."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.data.image_views import ImageViews
from neuprim.core.errors import DataError, NeuprimWarning
from neuprim.core.io.exr import write_exr
from neuprim.tasks.static.datasets import load_blender as load

W, H, ANGLE = 48, 36, 0.9


@pytest.fixture
def folder(tmp_path: Path, scenes: Any) -> Path:
    """6 training and 2 test views of one mark, RGBA."""
    path = tmp_path / "toy"
    focal = 0.5 * W / math.tan(0.5 * ANGLE)
    poses = scenes.ring(8)
    for split, chosen in (("train", poses[:6]), ("test", poses[6:])):
        frames = []
        for i, pose in enumerate(chosen):
            x, y = scenes.direction(pose, scenes.mark)
            spot = scenes.blob(W, H, focal * x + W / 2, focal * y + H / 2)
            scenes.save(path / split / f"r_{i}.png", np.stack([spot, spot, spot, np.ones_like(spot)], axis=-1))
            frames.append({"file_path": f"./{split}/r_{i}", "transform_matrix": pose.tolist()})
        scenes.write_json(path / f"transforms_{split}.json", {"camera_angle_x": ANGLE, "frames": frames})
    return path


def test_marks_are_where_cameras_say(folder: Path, scenes: Any, context: Any) -> None:
    data = load({"path": str(folder)}, context)
    assert (len(data.train), len(data.test)) == (6, 2)
    assert max(scenes.off_by(s, i) for s in (data.train, data.test) for i in range(len(s))) < 0.02
    assert [data.train.view(i).name for i in range(6)] == [f"r_{i}" for i in range(6)]
    assert (data.name, data.channels, data.color_space, data.downsampling) == ("toy", 3, "srgb", "none")
    assert data.background.tolist() == [1.0, 1.0, 1.0] and not data.random_background
    assert data.center.norm() < 1e-3 and data.up.tolist() == [0.0, 0.0, 1.0]
    assert 3.0 < data.extent < 4.0


def test_straight_alpha_is_premultiplied_before_it_is_averaged(folder: Path, context: Any) -> None:
    pixels = np.zeros((H, W, 4), np.uint8)
    pixels[:, 0::2] = (200, 100, 50, 255)
    pixels[:, 1::2] = (255, 255, 255, 0)  # transparent white must not bleed in
    Image.fromarray(pixels).save(folder / "train" / "r_0.png")
    full = load({"path": folder}, context).train.pixels(0)
    assert full.alpha is not None and torch.allclose(full.rgb[0, 0], torch.tensor([200.0, 100.0, 50.0]) / 255)
    assert full.rgb[0, 1].abs().max() == 0 and full.alpha[0, 1] == 0
    half = load({"path": folder, "downsample": 2}, context).train.pixels(0)
    assert half.alpha is not None and half.alpha.shape == (H // 2, W // 2)
    assert torch.allclose(half.rgb[3, 3], torch.tensor([100.0, 50.0, 25.0]) / 255, atol=0.5 / 255)
    assert half.alpha[3, 3].item() == pytest.approx(0.5, abs=0.51 / 255)
    assert torch.allclose(half.over(torch.ones(3))[3, 3], torch.tensor([227.5, 177.5, 152.5]) / 255, atol=1 / 255)


def test_hold_out_leaves_the_test_split_unread(folder: Path, context: Any) -> None:
    (folder / "transforms_test.json").unlink()
    data = load({"path": folder, "hold_out": 3}, context)
    assert [data.test.view(i).name for i in range(len(data.test))] == ["r_0", "r_3"]
    assert [data.train.view(i).name for i in range(len(data.train))] == ["r_1", "r_2", "r_4", "r_5"]


def test_focal_lengths_and_principal_point_of_the_file(folder: Path, scenes: Any, context: Any) -> None:
    """As BlenderNeRF writes them for a camera with a shift."""
    for split in ("train", "test"):
        document = json.loads((folder / f"transforms_{split}.json").read_text())
        for frame in document["frames"]:
            x, y = scenes.direction(np.array(frame["transform_matrix"]), scenes.mark)
            spot = scenes.blob(W, H, 40 * x + 28, 40 * y + 15)
            scenes.save(folder / f"{frame['file_path']}.png", np.stack([spot, spot, spot, np.ones_like(spot)], axis=-1))
        angle = 2 * math.atan(0.5 * W / 40)
        document.update(
            camera_angle_x=angle, fl_x=40, fl_y=40, cx=28, cy=15, w=float(W), h=float(H), k1=0.0, aabb_scale=4
        )
        scenes.write_json(folder / f"transforms_{split}.json", document)
    data = load({"path": folder}, context)
    assert max(scenes.off_by(s, i) for s in (data.train, data.test) for i in range(len(s))) < 0.02


def test_exr_is_linear_premultiplied_and_kept_above_one(folder: Path, context: Any) -> None:
    for split, n in (("train", 6), ("test", 2)):
        for i in range(n):
            (folder / split / f"r_{i}.png").unlink()
            write_exr(folder / split / f"r_{i}.exr", torch.tensor([8.0, 0.5, 0.25, 0.5]).expand(H, W, 4))
    data = load({"path": folder, "downsample": 2}, context)
    pixels = data.train.pixels(0)
    assert data.color_space == "linear"
    assert pixels.rgb[0, 0].tolist() == [8.0, 0.5, 0.25] and pixels.alpha is not None and pixels.alpha[0, 0] == 0.5


def test_images_load_lazily_and_within_the_cache(folder: Path, context: Any) -> None:
    data = load({"path": folder, "preload": False}, context)
    (folder / "train" / "r_2.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    data.train.pixels(1)
    with pytest.raises(DataError, match=r"r_2\.png"):
        data.train.pixels(2)
    small = ImageViews(data.train._frames[:2], cache_bytes=W * H * 4 + 1)  # type: ignore[attr-defined]
    small.pixels(0), small.pixels(1)
    assert len(small._stored) == 1
    with pytest.raises(IndexError):
        small.pixels(2)


def set_frame(key: str, value: Any) -> Any:
    return lambda document: document["frames"][3].__setitem__(key, value)


def set_pose(row: int, column: int, value: Any) -> Any:
    return lambda document: document["frames"][3]["transform_matrix"][row].__setitem__(column, value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("camera_angle_x"), "frames[0]: no focal length; expected camera_angle_x"),
        (lambda d: d.update(camera_angle_x="wide"), 'camera_angle_x is "wide"'),
        (lambda d: d.update(camera_angle_x=math.nan), "camera_angle_x is NaN"),
        (lambda d: d.update(camera_angle_x=True), "camera_angle_x is true"),
        (lambda d: d.update(camera_angle_x=0), "camera_angle_x is 0"),
        (lambda d: d.update(camera_angle_x=3.2), "camera_angle_x is 3.2"),
        (lambda d: d.update(camera_angle_x=10**400), "not valid JSON"),
        (lambda d: d["frames"][3].pop("transform_matrix"), "frames[3]: transform_matrix is missing"),
        (set_frame("transform_matrix", [1, 2, 3]), "frames[3]: transform_matrix is a list of 3"),
        (set_frame("transform_matrix", [[1, 0, 0]] * 4), "4 rows of 4 numbers"),
        (set_frame("transform_matrix", "eye"), "4 rows of 4 numbers"),
        (set_pose(1, 2, math.nan), "transform_matrix[1][2] is NaN"),
        (set_pose(0, 3, math.inf), "transform_matrix[0][3] is Infinity"),
        (set_pose(0, 0, None), "transform_matrix[0][0] is null"),
        (set_pose(3, 0, 1.0), "expected 0 0 0 1"),
        (set_frame("transform_matrix", np.diag([1.0, 1.0, 0.0, 1.0]).tolist()), "singular"),
        (set_frame("transform_matrix", np.diag([2.0, 2.0, 2.0, 1.0]).tolist()), "scaled"),
        (set_frame("transform_matrix", np.diag([-1.0, 1.0, 1.0, 1.0]).tolist()), "mirrored"),
        (set_frame("file_path", "./train/r_0"), "'train/r_0' is listed 2 times"),
        (set_frame("file_path", "x" * 5000), "1 files not found"),
    ],
)
def test_bad_fields(folder: Path, scenes: Any, context: Any, change: Any, words: str) -> None:
    file = folder / "transforms_train.json"
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))
    scenes.refused(load, {"path": folder, "strict": True}, context, "transforms_train.json", words)


def test_damaged_images_are_found_while_loading(folder: Path, scenes: Any, context: Any) -> None:
    bad = folder / "test" / "r_1.png"
    data = bad.read_bytes()
    bad.write_bytes(data[: len(data) // 2])
    scenes.refused(load, {"path": folder, "strict": True}, context, str(bad), "truncated or corrupt")
    Image.fromarray(np.zeros((H, W), np.uint16)).save(bad)
    scenes.refused(
        load, {"path": folder, "strict": True}, context, str(bad), "16-bit grey PNG", "expected 8-bit RGB or RGBA"
    )
    with pytest.warns(NeuprimWarning, match="16-bit grey PNG.*; view r_1 is left out"):
        assert len(load({"path": folder}, context).test) == 1


def test_mixed_sizes_channels_and_kinds(folder: Path, scenes: Any, context: Any) -> None:
    bad = folder / "train" / "r_3.png"
    scenes.save(bad, np.zeros((H, W + 1, 4)))
    scenes.refused(load, {"path": folder}, context, str(bad), "49x36", "expected 48x36", "r_0.png")
    scenes.save(bad, np.zeros((H, W, 3)))
    scenes.refused(load, {"path": folder}, context, str(bad), "3 channels", "only RGB images, or only RGBA images")
    bad.unlink()
    write_exr(bad.with_suffix(".exr"), torch.zeros(H, W, 4))
    scenes.refused(load, {"path": folder}, context, "r_3.exr", "images mix OpenEXR")
