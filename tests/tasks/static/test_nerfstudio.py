"""nerfstudio / instant-ngp loader: intrinsics, lenses, masks, splits, and every kind of bad input."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.cameras import Camera
from neuprim.core.data.image_views import RadialDistortion, undistortion_grid
from neuprim.core.errors import NeuprimWarning
from neuprim.tasks.static.datasets import load_nerfstudio as load

W, H = 64, 50
PINHOLE = {"fl_x": 60.0, "fl_y": 66.0, "cx": 29.3, "cy": 27.1, "w": W, "h": H}
Lens = Callable[[float, float], tuple[float, float]]


def opencv(k1: float, k2: float, p1: float, p2: float, k3: float = 0.0, k4: float = 0.0) -> Lens:
    """OpenCV's documented distortion, written out."""

    def bend(x: float, y: float) -> tuple[float, float]:
        r = math.hypot(x, y)
        radial = 1 + k1 * r**2 + k2 * r**4 + k3 * r**6 + k4 * r**8
        return x * radial + 2 * p1 * x * y + p2 * (r * r + 2 * x * x), y * radial + p1 * (
            r * r + 2 * y * y
        ) + 2 * p2 * x * y

    return bend


def fisheye(k1: float, k2: float) -> Lens:
    def bend(x: float, y: float) -> tuple[float, float]:
        r = math.hypot(x, y)
        t = math.atan(r)
        return x / r * (t + k1 * t**3 + k2 * t**5), y / r * (t + k1 * t**3 + k2 * t**5)

    return bend


@pytest.fixture
def capture(tmp_path: Path, scenes: Any) -> Callable[..., Path]:
    """Writes 10 views of one mark as a lens would show them; keywords go into the file."""

    def write(lens: Lens = lambda x, y: (x, y), count: int = 10, sigma: float = 1.0, **fields: Any) -> Path:
        path = tmp_path / "toy"
        values = {**PINHOLE, **fields}
        frames = []
        for i, pose in enumerate(scenes.ring(count, radius=1.6)):
            x, y = lens(*scenes.direction(pose, scenes.mark))
            u, v = values["fl_x"] * x + values["cx"], values["fl_y"] * y + values["cy"]
            assert 4 < u < W - 4 and 4 < v < H - 4, "the mark must be in the picture"
            scenes.save(path / "images" / f"{i:02d}.png", scenes.blob(W, H, u, v, sigma))
            frames.append({"file_path": f"images/{i:02d}.png", "transform_matrix": pose.tolist()})
        scenes.write_json(path / "transforms.json", {**values, "frames": frames[::-1]})
        return path

    return write


def edit(path: Path, change: Callable[[Any], Any]) -> None:
    document = json.loads((path / "transforms.json").read_text())
    change(document)
    (path / "transforms.json").write_text(json.dumps(document))


def worst(scenes: Any, data: Any) -> float:
    return max(scenes.off_by(s, i) for s in (data.train, data.test) for i in range(len(s)))


def names(views: Any) -> list[str]:
    return [views.view(i).name for i in range(len(views))]


@pytest.mark.parametrize(
    ("lens", "fields"),
    [
        (opencv(-0.2, 0.05, 0.01, -0.02), {"k1": -0.2, "k2": 0.05, "p1": 0.01, "p2": -0.02}),
        (
            opencv(0.2, 0.02, 0.0, 0.0, 0.03, 0.01),
            {"k1": 0.2, "k2": 0.02, "k3": 0.03, "k4": 0.01, "camera_model": "OPENCV"},
        ),
        (fisheye(0.05, -0.01), {"k1": 0.05, "k2": -0.01, "camera_model": "OPENCV_FISHEYE"}),
        (fisheye(0.0, 0.0), {"is_fisheye": True}),
        (fisheye(0.0, 0.0), {"is_fisheye": 1}),
    ],
)
def test_lenses_are_undone(capture: Any, scenes: Any, context: Any, lens: Lens, fields: dict[str, Any]) -> None:
    path = capture(lens, **fields)
    assert worst(scenes, load({"path": path}, context)) < 0.06
    assert worst(scenes, load({"path": path, "downsample": 2}, context)) < 0.06
    edit(path, lambda d: [d.pop(k) for k in fields])
    assert worst(scenes, load({"path": path}, context)) > 0.15, "the marks would not show a lens that is ignored"


def test_what_the_photograph_does_not_show_is_masked(capture: Any, context: Any) -> None:
    # pincushion: the corners of the undistorted view lie outside of the photograph
    mask = load({"path": capture(opencv(0.3, 0, 0, 0), k1=0.3)}, context).train.pixels(0).mask
    assert mask is not None and not mask[0, 0] and not mask[-1, -1] and mask[H // 2, W // 2]
    assert 0.5 < mask.float().mean() < 1


def test_a_lens_that_folds_over_does_not_mirror_the_middle_into_the_corners(capture: Any, context: Any) -> None:
    # r (1 - 1.8 r^2) turns back at r = 0.43, inside of the picture
    mask = load({"path": capture(opencv(-1.8, 0, 0, 0), k1=-1.8)}, context).train.pixels(0).mask
    assert mask is not None
    y, x = np.indices((H, W)) + 0.5
    radius = np.hypot((x - PINHOLE["cx"]) / PINHOLE["fl_x"], (y - PINHOLE["cy"]) / PINHOLE["fl_y"])
    assert not mask.numpy()[radius > 0.46].any() and mask.numpy()[radius < 0.40].all()


def test_what_does_not_fold_over_lies_around_a_principal_point_off_the_middle() -> None:
    _, valid = undistortion_grid(Camera(torch.eye(4), 40.0, 40.0, 70.0, 20.0, 80, 40), RadialDistortion(k1=-1.8))
    assert valid[20, 70] and not valid[20, 20]


def test_per_frame_intrinsics_sizes_and_lenses(capture: Any, scenes: Any, context: Any) -> None:
    path = capture()
    pose = scenes.ring(10, 1.6)[4]
    x, y = opencv(-0.1, 0, 0, 0)(*scenes.direction(pose, scenes.mark))
    scenes.save(path / "images" / "04.png", scenes.blob(80, 40, 50 * x + 38, 50 * y + 21))

    def change(document: Any) -> None:
        frame = next(f for f in document["frames"] if "04" in f["file_path"])
        frame.update(fl_x=50, fl_y=50, cx=38, cy=21, w=80.0, h=40, k1=-0.1)

    edit(path, change)
    data = load({"path": path, "downsample": 2}, context)
    assert worst(scenes, data) < 0.06 and data.downsampling == "1/2 by area"
    assert (data.train.view(3).camera.width, data.train.view(3).camera.height) == (40, 20)


@pytest.mark.parametrize("per_frame", [True, False])
def test_masks(capture: Any, scenes: Any, context: Any, per_frame: bool) -> None:
    path = capture()
    mask = np.zeros((H, W), np.uint8)
    mask[10:40, 20:51] = 1
    mask[21, 31] = 0
    Image.fromarray(mask).save(path / "mask.png")
    edit(path, lambda d: [f.update(mask_path="mask.png") for f in (d["frames"] if per_frame else [d])])
    found = load({"path": path}, context).train.pixels(0).mask
    assert found is not None and np.array_equal(found.numpy(), mask.astype(bool))
    half = load({"path": path, "downsample": 2}, context).train.pixels(0).mask
    assert half is not None and half.sum() == 15 * 15 - 1, "a reduced pixel counts where all of its pixels do"


@pytest.mark.parametrize(
    ("train", "val", "test", "expected"),
    [
        ("1 2", None, "5", "1 2/5"),
        (None, None, "0 1 2 3 4 5 6", "7 8 9/0 1 2 3 4 5 6"),
        ("0 1 2 3 4 5 6 7", None, None, "0 1 2 3 4 5 6 7/8 9"),
        (None, "0 1", "2 3", "4 5 6 7 8 9/2 3"),
        ("4 5", "0 1", None, "4 5/0 1"),
        (None, "0 1", None, "2 3 4 5 6 7 8 9/0 1"),
        ("4", "0", "", "4/0"),
        ("4", "4", "5", "4/5"),
    ],
)
def test_split_lists_and_views_for_validation_never_train(
    capture: Any, context: Any, train: str | None, val: str | None, test: str | None, expected: str
) -> None:
    given = {"train_filenames": train, "val_filenames": val, "test_filenames": test}
    lists = {k: [f"./images/0{i}.png" for i in v.split()] for k, v in given.items() if v is not None}
    data = load({"path": capture(**lists)}, context)
    assert "/".join(" ".join(str(int(n)) for n in names(views)) for views in (data.train, data.test)) == expected


@pytest.mark.parametrize("name", ["masks/{0}.png", "masks/{0}.png.png", "images/dynamic_mask_{0}.png"])
def test_masks_beside_the_images_count(capture: Any, context: Any, name: str) -> None:
    path = capture()
    mask = np.full((H, W), 255, np.uint8)
    mask[:, :20] = 0
    (path / "masks").mkdir()
    for i in range(10):
        Image.fromarray(255 - mask if "dynamic" in name else mask).save(path / name.format(f"{i:02d}"))
    with pytest.warns(NeuprimWarning, match="found masks for 10 of 10 images"):
        data = load({"path": path}, context)
    found = data.train.pixels(0).mask
    assert found is not None and np.array_equal(found.numpy(), mask > 0)
    edit(path, lambda d: d["frames"][0].update(mask_path="images/09.png"))
    assert load({"path": path}, context).train.pixels(0).mask is None, "what the file names counts alone"


def test_resized_images_scale_the_camera(capture: Any, scenes: Any, context: Any) -> None:
    path = capture(sigma=2.0)
    for file in (path / "images").iterdir():
        Image.open(file).resize((W // 2, H // 2), Image.Resampling.BOX).save(file)
    with pytest.warns(NeuprimWarning, match="w, h are 64x50 and the image 32x25; cameras are scaled"):
        data = load({"path": path}, context)
    assert worst(scenes, data) < 0.03
    edit(path, lambda d: [d.pop(key) for key in ("w", "h")] and d.update(cx=W / 2, cy=H / 2))
    scenes.refused(load, {"path": path}, context, "the centre of an image of 64x50", "32x25", "expected w, h")


def test_turned_photographs(capture: Any, scenes: Any, context: Any) -> None:
    path = capture()
    exif = Image.Exif()
    exif[0x0112] = 6
    for file in sorted((path / "images").iterdir()):
        Image.open(file).save(file.with_suffix(".jpg"), quality=98, exif=exif)
        file.unlink()
    edit(path, lambda d: [f.update(file_path=f["file_path"].replace("png", "jpg")) for f in d["frames"]])
    assert worst(scenes, load({"path": path}, context)) < 0.1, "the stated size is that of the stored pixels"
    edit(path, lambda d: d.update(w=H, h=W))
    scenes.refused(load, {"path": path}, context, "image is 64x50; expected 50x64", "EXIF orientation 6 rotates")


def test_upper_and_lower_case(capture: Any, context: Any) -> None:
    path = capture()
    for file in (path / "images").iterdir():
        file.rename(file.with_suffix(".PNG"))
    (path / "images").rename(path / "Images")
    assert len(load({"path": path}, context).train) == 8


def third(document: Any) -> Any:
    return next(f for f in document["frames"] if "03" in f["file_path"])


def damage_image(path: Path) -> None:
    file = path / "images" / "03.png"
    file.write_bytes(file.read_bytes()[:-40])


def black_mask(path: Path) -> None:
    Image.fromarray(np.zeros((H, W), np.uint8)).save(path / "black.png")
    edit(path, lambda d: third(d).update(mask_path="black.png"))


def no_pose(path: Path) -> None:
    edit(path, lambda d: third(d)["transform_matrix"][0].__setitem__(3, math.nan))


def empty_file(path: Path) -> None:
    (path / "images" / "03.png").write_bytes(b"")


@pytest.mark.parametrize("damage", [damage_image, black_mask, no_pose, empty_file])
def test_one_bad_view_is_left_out_and_named(
    capture: Any, scenes: Any, context: Any, damage: Callable[[Path], None]
) -> None:
    path = capture()
    damage(path)
    with pytest.warns(NeuprimWarning, match=r"; view 03 is left out \(scene.strict=true refuses it\)"):
        data = load({"path": path}, context)
    assert len(data.train) + len(data.test) == 9 and "03" not in names(data.train) + names(data.test)
    assert worst(scenes, data) < 0.02, "poses stay with their images"
    scenes.refused(load, {"path": path, "strict": True}, context)


def test_a_transparent_view_among_others_is_left_out(capture: Any, scenes: Any, context: Any) -> None:
    path = capture()
    for i in range(10):
        spot = np.array(Image.open(path / "images" / f"{i:02d}.png"))[..., :1]
        alpha = np.where(spot > 20, 255, 0).astype(np.uint8) * (i != 3)
        Image.fromarray(np.concatenate([spot, spot, spot, alpha], axis=-1)).save(path / "images" / f"{i:02d}.png")
    with pytest.warns(NeuprimWarning, match=r"03.png: image is fully transparent.*; view 03 is left out"):
        data = load({"path": path}, context)
    assert "03" not in names(data.train) and len(data.initial_points(10, torch.Generator().manual_seed(0)).means) == 10


def test_ply_points(capture: Any, context: Any) -> None:
    path = capture(ply_file_path="points.ply")
    header = "ply\nformat ascii 1.0\nelement vertex 3\n" + "".join(f"property float {c}\n" for c in "xyz")
    color = "".join(f"property uchar {c}\n" for c in ("red", "green", "blue"))
    (path / "points.ply").write_text(header + color + "end_header\n1 2 3 255 0 0\n4 5 6 0 255 0\n1 2 3 0 0 255\n")
    points = load({"path": path}, context).initial_points(10, torch.Generator().manual_seed(0))
    assert points.means.tolist() == [[1, 2, 3], [4, 5, 6]], "points at one place count once"
    assert points.colors.tolist() == [[1, 0, 0], [0, 1, 0]]
    (path / "points.ply").write_text(header + "end_header\n1 2 3\n4 5 6\n7 8 9\n")
    points = load({"path": path}, context).initial_points(2, torch.Generator().manual_seed(0))
    assert points.colors.tolist() == [[0.5] * 3] * 2


def frame(**fields: Any) -> Callable[[Any], None]:
    """Changes the frame of images/06.png, the fourth in the file."""
    return lambda d: d["frames"][3].update(fields)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("fl_x") and d.pop("fl_y"), "no focal length"),
        (lambda d: d.update(fl_x=-3), "fl_x is -3; expected a focal length in pixels above 0"),
        (lambda d: d.update(cx=math.nan), "cx is NaN"),
        (lambda d: d.update(k1="small"), 'k1 is "small"'),
        (lambda d: d.update(p2=[0.1]), "p2 is a list of 1"),
        (frame(k3=math.inf), "frames[3]: k3 is Infinity"),
        (lambda d: d.update(w=64.5), "w is 64.5; expected a positive whole number"),
        (lambda d: d.update(w=32), "image is 64x50; expected 32x50"),
        (lambda d: d.update(camera_model="EQUIRECTANGULAR"), "OPENCV_FISHEYE"),
        (lambda d: d.update(camera_model="OPENCV_FISHEYE", p1=0.1), "p1, p2 are 0.1, 0 for a fisheye lens"),
        (frame(is_fisheye="yes"), 'frames[3]: is_fisheye is "yes"; expected true or false'),
        (frame(transform_matrix=np.diag([1.0, -1.0, 1.0, 1.0]).tolist()), "mirrored"),
        (frame(transform_matrix=np.zeros((4, 4)).tolist()), "0 0 0 1"),
        (frame(file_path=7), "frames[3]: file_path is 7"),
        (frame(mask_path="no.png"), "mask_path: 1 files not found: no.png"),
        (frame(mask_path=1), "frames[3]: mask_path is 1"),
        (lambda d: d.update(train_filenames="all"), "a list of texts"),
        (lambda d: d.update(test_filenames=["images/77.png"]), "images/77.png"),
        (lambda d: d.update(train_filenames=["images/01.png"], test_filenames=["images/01.png"]), "share 1 images"),
        (lambda d: d.update(train_filenames=[]), "training split has no images"),
        (lambda d: d.update(test_filenames=[]), "test split has no images"),
        (lambda d: d.update(frames=d["frames"][:1]), "training split has no images"),
        (lambda d: d.update(ply_file_path="no.ply"), "no.ply"),
        (lambda d: d.update(frames=[]), "frames is a list of 0"),
    ],
)
def test_bad_fields(capture: Any, scenes: Any, context: Any, change: Callable[[Any], Any], words: str) -> None:
    path = capture()
    edit(path, change)
    scenes.refused(load, {"path": path, "strict": True}, context, str(path), words)


def test_missing_images_are_listed_or_skipped(capture: Any, scenes: Any, context: Any) -> None:
    path = capture()
    for i in (2, 7):
        (path / "images" / f"{i:02d}.png").unlink()
    scenes.refused(load, {"path": path}, context, "2 files not found: images/02.png, images/07.png; scene.skip_missing")
    data = load({"path": path, "skip_missing": True}, context)
    assert sorted(names(data.train) + names(data.test)) == ["00", "01", "03", "04", "05", "06", "08", "09"]
    assert worst(scenes, data) < 0.02, "poses stay with their images"
    for file in (path / "images").iterdir():
        file.unlink()
    scenes.refused(load, {"path": path, "skip_missing": True}, context, "10 files not found")


def test_names_that_are_not_utf8_become_names_that_can_be_written(capture: Any, context: Any) -> None:
    path = capture()
    try:
        (path / "images" / "03.png").rename(path / "images" / "caf\udce9.png")
    except OSError:
        pytest.skip("this file system has only names in UTF-8")
    edit(path, lambda d: d["frames"][6].update(file_path="images\\caf\udce9.png"))
    assert "caf\\udce9" in names(load({"path": path}, context).train)


def test_test_images_that_are_training_images_are_told(capture: Any, context: Any) -> None:
    path = capture()
    edit(path, lambda d: d["frames"].append({**d["frames"][9], "file_path": "images/00"}))
    with pytest.warns(NeuprimWarning, match=r"1 of 2 test images are training images, too, e.g. 00.png"):
        load({"path": path}, context)
