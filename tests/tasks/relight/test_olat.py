"""The layout of GS³ and NRHints, in every variant that is known, and what is said about those that are not."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Mapping
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.config import compose
from neuprim.core.data import Dataset
from neuprim.core.io.exr import write_exr
from neuprim.core.io.images import srgb_to_linear, write_png
from neuprim.core.task import SceneContext
from neuprim.runs.fit import Note, prepare_training, train_to_end
from neuprim.tasks import relight
from neuprim.tasks.relight.datasets import load_olat as load
from neuprim.tasks.relight.lighting import dataset_lighting, measure_falloff

SIZE = 12
FX, FY, CX, CY = 20.0, 21.0, 5.0, 6.5

Edit = Callable[[dict[str, Any]], Any]


def straight(index: int) -> Tensor:
    """(H, W, 4) uint8 with all kinds of alpha; the corner is empty."""
    generator = torch.Generator().manual_seed(index)
    image = torch.randint(0, 256, (SIZE, SIZE, 4), generator=generator, dtype=torch.uint8)
    image[..., 3] = image[..., 3] // 128 * 128
    image[3:9, 3:9, 3] = 255
    image[0, 0] = 0
    return image


def linear(index: int) -> Tensor:
    """(H, W, 4) what a straight 8-bit image is as premultiplied linear light."""
    image = straight(index).float() / 255
    return torch.cat([srgb_to_linear(image[..., :3]) * image[..., 3:], image[..., 3:]], dim=-1)


@pytest.fixture
def folder(tmp_path: Path, scenes: Any) -> Path:
    """Three training and two test images as PNG, in the plainest variant."""
    root = tmp_path / "scene"
    for split, count, start in (("train", 3, 0), ("test", 2, 10)):
        (root / split).mkdir(parents=True)
        poses = scenes.ring(count)
        frames = []
        for i in range(count):
            write_png(root / split / f"r_{i}.png", straight(start + i))
            frames.append(
                {"file_path": f"./{split}/r_{i}", "transform_matrix": poses[i].tolist(), "pl_pos": [1.0 + i, 2.0, 4.0]}
            )
        scenes.write_json(root / f"transforms_{split}.json", {"camera_angle_x": 0.8, "frames": frames})
    return root


def edit(folder: Path, change: Edit, split: str = "train") -> None:
    path = folder / f"transforms_{split}.json"
    value = json.loads(path.read_text())
    change(value)
    path.write_text(json.dumps(value))


def both(folder: Path, change: Edit) -> None:
    for split in ("train", "test"):
        edit(folder, change, split)


def read(folder: Path, context: SceneContext, **settings: Any) -> Dataset:
    return load({"path": str(folder), **settings}, context)


def each(change: Edit) -> Edit:
    """The change made to every frame."""
    return lambda document: [change(frame) for frame in document["frames"]]


# What is read
# ----------------------------------------------------------------


def test_the_plainest_variant(folder: Path, context: SceneContext) -> None:
    dataset = read(folder, context)
    assert (len(dataset.train), len(dataset.test), dataset.color_space, dataset.name) == (3, 2, "linear", "scene")
    found = (dataset_lighting(dataset).falloff, dataset.exposure, dataset.background.tolist())
    assert found == ("inverse_square", 1.0, [0.0] * 3)
    view = dataset.train.view(1)
    assert view.name == "r_1" and view.conditions["light"].tolist() == [2.0, 2.0, 4.0]
    assert view.conditions["light_intensity"].tolist() == [1.0, 1.0, 1.0]
    assert all(v.dtype == torch.float32 and v.shape == (3,) for v in view.conditions.values())
    focal = 0.5 * SIZE / math.tan(0.4)
    assert (view.camera.fx, view.camera.fy, view.camera.cx) == (pytest.approx(focal), pytest.approx(focal), SIZE / 2)
    mask = relight.relight_matter_mask(dataset, 0)
    assert mask is not None and not mask[0, 0] and mask[5, 5]


def test_png_becomes_premultiplied_linear_light(folder: Path, context: SceneContext) -> None:
    pixels = read(folder, context).train.pixels(2)
    assert pixels.alpha is not None
    torch.testing.assert_close(pixels.rgb, linear(2)[..., :3])
    torch.testing.assert_close(pixels.alpha, linear(2)[..., 3])


def as_exr(folder: Path, factor: float = 1.0) -> None:
    for split, start in (("train", 0), ("test", 10)):
        for i, png in enumerate(sorted((folder / split).glob("*.png"))):
            image = linear(start + i)
            write_exr(png.with_suffix(".exr"), torch.cat([image[..., :3] * factor, image[..., 3:]], dim=-1), half=False)
            png.unlink()


def test_exr_is_linear_and_not_premultiplied_again(folder: Path, context: SceneContext) -> None:
    from_png = read(folder, context)
    expected = [from_png.test.pixels(i) for i in range(2)]
    as_exr(folder, 3.0)
    from_exr = read(folder, context)
    assert from_exr.color_space == "linear"
    for i, pixels in enumerate(expected):
        found = from_exr.test.pixels(i)
        torch.testing.assert_close(found.rgb, 3.0 * pixels.rgb, rtol=1e-3, atol=1e-4)  # copies are kept as half floats
        torch.testing.assert_close(found.alpha, pixels.alpha, rtol=1e-3, atol=1e-4)
    assert read(folder, context, exposure=3).test.pixels(0).rgb.sub(expected[0].rgb).abs().max() < 1e-3


def test_intrinsics_come_as_principal_point_then_focal_lengths(
    folder: Path, context: SceneContext, scenes: Any
) -> None:
    order = {"camera_intrinsics": [CX, CY, FX, FY]}
    both(folder, lambda d: d.update(order))
    words = ("camera_intrinsics gives a focal length of 20", "camera_angle_x gives 14.191")
    scenes.refused(load, {"path": str(folder)}, context, *words)
    both(folder, lambda d: d.pop("camera_angle_x"))
    for _ in range(2):
        camera = read(folder, context).train.view(0).camera
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FX, FY, CX, CY)
        both(folder, lambda d: d.pop("camera_intrinsics", None))
        both(folder, each(lambda f: f.update(order)))


def test_suffix_of_the_file_may_stand_apart(folder: Path, context: SceneContext) -> None:
    both(folder, each(lambda f: f.update(file_ext=".png")))
    assert len(read(folder, context).train) == 3
    both(folder, each(lambda f: f.update(file_ext="png", file_path=f["file_path"] + ".png")))
    assert read(folder, context).train.view(0).name == "r_0"
    as_exr(folder)
    both(folder, each(lambda f: f.update(file_ext=".exr", file_path=f["file_path"].removesuffix(".png"))))
    assert read(folder, context).train.file(0).suffix == ".exr"


@pytest.mark.parametrize("prefix", ["train", "/home/somebody/captures/scene/train", "..\\scene\\train"])
def test_image_paths_of_other_machines(folder: Path, context: SceneContext, prefix: str) -> None:
    """GS³ saves optimised poses with the image's stem as file_path and the full path beside it."""
    separator = "\\" if "\\" in prefix else "/"
    edit(
        folder,
        lambda d: [
            f.update(img_path=f"{prefix}{separator}r_{i}.png", file_path=f"r_{i}") for i, f in enumerate(d["frames"])
        ],
    )
    train = read(folder, context).train
    assert [train.file(i).name for i in range(3)] == ["r_0.png", "r_1.png", "r_2.png"] and train.view(2).name == "r_2"


def test_image_path_alone_and_absolute(folder: Path, context: SceneContext) -> None:
    edit(folder, lambda d: [f.update(img_path=str(folder / "train" / f"r_{i}.png")) for i, f in enumerate(d["frames"])])
    edit(folder, each(lambda f: f.pop("file_path")))
    assert read(folder, context).train.view(1).name == "r_1"


def corrections(frame: Mapping[str, Any], turn: float = 0.1) -> dict[str, Any]:
    """R_opt and T_opt of a frame's pose turned about its own axis, as GS³ stores them: transposed rotation, then
    translation."""
    c2w = np.array(frame["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0])
    c, s = math.cos(turn), math.sin(turn)
    view = np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, 0.05], [0, 0, 0, 1]]) @ np.linalg.inv(c2w)
    return {"R_opt": view[:3, :3].T.tolist(), "T_opt": view[:3, 3].tolist(), "_view": view}


def test_corrections_replace_the_pose(folder: Path, context: SceneContext) -> None:
    before = read(folder, context).train.view(1).camera.viewmat
    frames = json.loads((folder / "transforms_train.json").read_text())["frames"]
    fixed = corrections(frames[1])
    edit(folder, lambda d: d["frames"][1].update(R_opt=fixed["R_opt"], T_opt=fixed["T_opt"]))
    np.testing.assert_allclose(read(folder, context).train.view(1).camera.viewmat.numpy(), fixed["_view"], atol=1e-12)
    assert torch.equal(read(folder, context, ignore_corrections=True).train.view(1).camera.viewmat, before)
    identity = corrections(frames[0], 0.0)
    identity["T_opt"][2] -= 0.05
    edit(folder, lambda d: d["frames"][0].update(R_opt=identity["R_opt"], T_opt=identity["T_opt"]))
    edit(folder, lambda d: d["frames"][0].pop("transform_matrix"))
    pose = torch.from_numpy(np.array(frames[0]["transform_matrix"]) @ np.diag([1.0, -1.0, -1.0, 1.0]))
    torch.testing.assert_close(
        read(folder, context).train.view(0).camera.viewmat @ pose, torch.eye(4, dtype=torch.float64)
    )


def test_intensities(folder: Path, context: SceneContext) -> None:
    edit(folder, lambda d: (d.update(pl_intensity=[1.0, 2.0, 3.0]), d["frames"][1].update(pl_intensity=25)))
    train = read(folder, context).train
    found = [train.view(i).conditions["light_intensity"].tolist() for i in range(3)]
    assert found == [[1.0, 2.0, 3.0], [25.0] * 3, [1.0, 2.0, 3.0]]


def test_lights_beside_the_camera(folder: Path, context: SceneContext) -> None:
    """A flash two units above and one behind each camera; equal numbers of all frames are pointed out."""
    both(folder, each(lambda frame: frame.update(pl_pos=[0.0, 2.0, 1.0])))
    with pytest.warns(match="pl_pos is the same in all frames.*scene.light_space=camera"):
        read(folder, context)
    dataset = read(folder, context, light_space="camera")
    for i in range(3):
        view = dataset.train.view(i)
        wanted = view.camera.viewmat.inverse() @ torch.tensor([0.0, -2.0, -1.0, 1.0]).double()
        assert torch.allclose(view.conditions["light"].double(), wanted[:3], atol=1e-5)


def test_exposure(folder: Path, context: SceneContext) -> None:
    plain = read(folder, context)
    values = torch.cat([plain.train.pixels(i).rgb.flatten() for i in range(3)])
    dataset = read(folder, context, exposure="auto", falloff="inverse_square")
    assert (
        dataset.exposure == pytest.approx(values.quantile(0.995).item(), rel=5e-3)
        and dataset_lighting(dataset).falloff == "inverse_square"
    )
    torch.testing.assert_close(dataset.test.pixels(0).rgb * dataset.exposure, plain.test.pixels(0).rgb)
    torch.testing.assert_close(dataset.test.pixels(0).alpha, plain.test.pixels(0).alpha)


@pytest.mark.parametrize(
    ("count", "exponent", "range_of_distances", "falloff", "told"),
    [
        (200, -2.0, 0.2, "inverse_square", True),
        (200, 0.0, 0.2, "none", True),
        (200, 0.0, 1e-3, "inverse_square", False),
        (200, 0.0, 0.0, "inverse_square", False),
        (20, 0.0, 0.2, "inverse_square", False),
    ],
)
def test_images_say_how_light_weakens(
    count: int, exponent: float, range_of_distances: float, falloff: str, told: bool
) -> None:
    """Though they also darken with the angle between light and camera, and with chance; where they do not say it, a
    line does."""
    g = torch.Generator().manual_seed(0)
    lights, eyes = torch.nn.functional.normalize(torch.randn(2, count, 3, generator=g), dim=-1)
    distances = 4 * (1 + range_of_distances * (torch.rand(count, generator=g) - 0.5))
    values = (1.5 + (lights * eyes).sum(-1)) * distances**exponent * (0.2 * torch.randn(count, generator=g)).exp()

    class Views:
        def __len__(self) -> int:
            return count

        def view(self, i: int) -> Any:
            conditions = {"light": 1 + lights[i] * distances[i], "light_intensity": torch.full((3,), 2.0)}
            return SimpleNamespace(conditions=conditions, camera=SimpleNamespace(position=1 + 3 * eyes[i].double()))

        def pixels(self, i: int) -> Any:
            return SimpleNamespace(rgb=values[i].expand(2, 2, 3))

    dataset: Any = SimpleNamespace(center=torch.ones(3), train=Views(), name=f"{count} {range_of_distances}")
    with nullcontext() if told else pytest.warns(match="do not show whether light weakens"):
        assert measure_falloff(dataset) == falloff


def test_exposures_may_be_typed(folder: Path) -> None:
    for text, value in (("auto", "auto"), ("2.5", 2.5)):
        words = ["task=relight", "scene=olat", f"scene.path='{folder}'", f"scene.exposure={text}"]
        assert compose(words, check_output=False).scene["exposure"] == value


def test_starting_points_and_orbit(folder: Path, context: SceneContext) -> None:
    for split in ("train", "test"):
        for png in (folder / split).glob("*.png"):
            image = straight(0)
            image[..., 3] = 0
            image[4:8, 4:8] = 255
            write_png(png, image)
    dataset = read(folder, context)
    points = dataset.initial_points(20, torch.Generator().manual_seed(0))
    assert 0 < len(points.means) <= 20 and (points.colors > 0.9).all()
    views = relight.light_orbit(dataset, 4)
    lights = torch.stack([v.conditions["light"] for v in views])
    assert torch.isfinite(lights).all() and len(lights.unique(dim=0)) == 4
    torch.testing.assert_close(lights[:, 2], lights[:1, 2].expand(4))
    assert all(v.conditions["light_intensity"].tolist() == [1.0] * 3 for v in views)


# What is refused
# ----------------------------------------------------------------


def test_distances_of_the_camera_are_compared_only_if_both_are_given(
    folder: Path, context: SceneContext, scenes: Any
) -> None:
    for given in ({"camera_far": 2.0}, {"camera_near": 0, "camera_far": 0.5}):
        edit(folder, lambda d, given=given: d.update(given))  # type: ignore[misc]
        assert len(read(folder, context).train) == 3
    edit(folder, lambda d: d.update(camera_near=4.0, camera_far=3.0))
    scenes.refused(load, {"path": str(folder)}, context, "camera_far is 3.0", "above camera_near, 4")


FRAME = "transforms_train.json: frames[1]"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda f: f.pop("pl_pos"), (FRAME, "pl_pos is missing", "point light's position")),
        (lambda f: f.update(pl_pos=[1, 2]), (FRAME, "pl_pos is a list of 2")),
        (lambda f: f.update(pl_pos=[1, 2, "x"]), (FRAME, 'pl_pos[2] is "x"', "finite number")),
        (
            lambda f: f.update(pl_intensity=[1, 2]),
            (FRAME, "pl_intensity is a list of 2", "3 numbers of at least 0, or one"),
        ),
        (lambda f: f.update(pl_intensity=-1), (FRAME, "pl_intensity is -1", "at least 0")),
        (lambda f: f.pop("transform_matrix"), (FRAME, "transform_matrix is missing")),
        (lambda f: f.update(file_ext=".npy"), (FRAME, 'file_ext is ".npy"', ".exr")),
        (lambda f: f.update(file_ext=".exr"), ("1 files not found", "./train/r_1.exr")),
        (lambda f: f.pop("file_path"), (FRAME, "file_path is missing")),
        (lambda f: f.update(img_path="a/b.png", file_path=None), ("1 files not found", "a/b.png")),
        (lambda f: f.update(file_path="./train/r_0"), ("train/r_0", "listed 2 times")),
        (lambda f: f.update(R_opt=np.eye(3).tolist()), (FRAME, "T_opt is missing", "beside R_opt")),
        (lambda f: f.update(T_opt=[0, 0, 1]), (FRAME, "R_opt is missing", "beside T_opt")),
        (lambda f: f.update(R_opt=[[1, 0], [0, 1]], T_opt=[0, 0, 1]), (FRAME, "R_opt is a list of 2", "3 rows of 3")),
        (lambda f: f.update(R_opt=np.diag([1, 1, 2.0]).tolist(), T_opt=[0, 0, 1]), (FRAME, "singular or scaled")),
        (
            lambda f: f.update(camera_intrinsics=[FX, FY, CX, CY]),
            (FRAME, "principal point outside", "[cx, cy, fx, fy]"),
        ),
        (lambda f: f.update(camera_intrinsics=[CX, CY, 0, FY]), (FRAME, "camera_intrinsics", "focal lengths above 0")),
        (
            lambda f: f.update(camera_intrinsics=[[FX, 0, CX], [0, FY, CY], [0, 0, 1]]),
            (FRAME, "camera_intrinsics is a list of 3"),
        ),
        (lambda f: f.update(camera_angle_x=4.0), (FRAME, "camera_angle_x is 4.0", "between 0 and pi")),
    ],
)
def test_wrong_frames_are_named(
    folder: Path, context: SceneContext, scenes: Any, change: Edit, words: tuple[str, ...]
) -> None:
    edit(folder, lambda d: change(d["frames"][1]))
    scenes.refused(load, {"path": str(folder), "strict": True}, context, *words)


def test_darkness_has_no_exposure(folder: Path, context: SceneContext, scenes: Any) -> None:
    for png in (folder / "train").glob("*.png"):
        write_png(png, torch.zeros(SIZE, SIZE, 3, dtype=torch.uint8))
    for png in (folder / "test").glob("*.png"):
        write_png(png, straight(0)[..., :3])
    scenes.refused(load, {"path": str(folder), "exposure": "auto"}, context, str(folder), "99.5 %", "scene.exposure")


def test_corrections_of_lights_and_cameras(folder: Path, tmp_path: Path) -> None:
    """A short run, from the command line's words to the line that says how far they went."""
    words = ["task=relight", "scene=olat", f"scene.path='{folder}'", "scene.refine=[light,camera]"]
    words += ["model.primitives=20", "train.iterations=9", f"output_dir='{tmp_path / 'run'}'"]
    said: list[str] = []
    fitted = prepare_training(compose(words))
    train_to_end(fitted, lambda event: said.append(event.text) if isinstance(event, Note) else None)
    assert fitted.dataset.refine == {"light": "offset", "light_intensity": "factor", "camera": "pose"}
    (line,) = [text for text in said if text.startswith("corrections of training views")]
    assert re.search(r"light [\d.e-]+, light_intensity [\d.]+%, camera [\d.e-]+ degrees and [\d.e-]+$", line), line
    assert fitted.trainer.corrections is not None and float(fitted.trainer.corrections.numbers.abs().max()) > 1e-4
