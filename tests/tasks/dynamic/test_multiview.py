"""The loader of posed images with times, on a ball that goes round: what it reads, what it refuses, and where it
starts."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.data.initial import box_starting_points
from neuprim.core.data.starting_points import EmptyHull
from neuprim.core.io.exr import write_exr
from neuprim.tasks.dynamic.multiview import load_moving_multiview, sample_moving_points

SIZE, ANGLE, RADIUS, COLOR = 48, 0.7, 0.35, np.array([0.8, 0.4, 0.2])
TIMES = [i / 11 for i in range(12)]


def middle(time: float) -> np.ndarray:
    """Where the ball is; 2.4 units of way, so 7 radii."""
    return np.array([0.5 * math.cos(4.8 * time), 0.5 * math.sin(4.8 * time), 0.2 * time])


def ball(pose: np.ndarray, time: float) -> np.ndarray:
    """(H, W) 0..1 coverage of the ball by 3 x 3 rays a pixel, for an OpenGL camera to world."""
    n = 3 * SIZE
    plane = ((np.arange(n) + 0.5) / n * 2 - 1) * math.tan(ANGLE / 2)
    x, y = np.meshgrid(plane, -plane)
    rays = np.stack([x, y, -np.ones_like(x)], -1) @ pose[:3, :3].T
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    offset = middle(time) - pose[:3, 3]
    gap = np.linalg.norm(offset - (rays @ offset)[..., None] * rays, axis=-1)
    return (gap < RADIUS).reshape(SIZE, 3, SIZE, 3).mean((1, 3))


def views(scenes: Any) -> list[tuple[np.ndarray, float]]:
    """Poses and times: 12 times of 4 cameras."""
    return [(pose, t) for t in TIMES for pose in scenes.ring(4, 3.5)]


def write(folder: Path, split: str, shots: list[tuple[np.ndarray, float]], scenes: Any, exr: bool = False) -> None:
    """One ``transforms_SPLIT.json`` (``transforms.json`` for "") and its images."""
    frames = []
    for i, (pose, time) in enumerate(shots):
        alpha, name = ball(pose, time), f"{split or 'images'}/r_{i:03d}"
        image = np.concatenate([np.broadcast_to(COLOR, (SIZE, SIZE, 3)), alpha[..., None]], -1)
        if exr:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            premultiplied = np.concatenate([image[..., :3] * alpha[..., None] * 2.0, alpha[..., None]], -1)
            write_exr((folder / name).with_suffix(".exr"), torch.from_numpy(premultiplied))
        else:
            scenes.save((folder / name).with_suffix(".png"), image)
        frames.append({"file_path": f"./{name}", "time": time, "transform_matrix": pose.tolist()})
    name = f"transforms_{split}.json" if split else "transforms.json"
    scenes.write_json(folder / name, {"camera_angle_x": ANGLE, "frames": frames})


@pytest.fixture
def folder(tmp_path: Path, scenes: Any) -> Path:
    """12 times of 4 cameras to train on, 5 views to test."""
    path = tmp_path / "ball"
    path.mkdir()
    write(path, "train", views(scenes), scenes)
    write(path, "test", [(scenes.opengl_pose((2.0, 2.0, 2.0)), t) for t in (0.0, 0.3, 0.5, 0.77, 1.0)], scenes)
    return path


def edit(path: Path, change: Callable[[list[dict[str, Any]]], Any]) -> None:
    """Apply ``change`` to the frames of a file in place."""
    document = json.loads(path.read_text())
    change(document["frames"])
    path.write_text(json.dumps(document))


def times_of(split: Any) -> list[float]:
    return [split.view(i).conditions["time"].item() for i in range(len(split))]


def rng(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_views_and_times(folder: Path, scenes: Any, context: Any) -> None:
    data = load_moving_multiview({"path": folder}, context)
    assert (len(data.train), len(data.test), data.name, data.color_space) == (48, 5, "ball", "srgb")
    assert (data.data_source, data.up.tolist(), data.background.tolist()) == ("real", [0.0, 0.0, 1.0], [1.0] * 3)
    time = data.train.view(5).conditions["time"]
    assert time.dtype == torch.float32 and time.shape == ()
    assert times_of(data.train) == [np.float32(t) for t in TIMES for _ in range(4)]
    assert times_of(data.test) == [np.float32(t) for t in (0.0, 0.3, 0.5, 0.77, 1.0)]
    for split in (data.train, data.test):  # cameras, images and times belong together
        for i in range(len(split)):
            camera, pixels = split.view(i).camera, split.pixels(i)
            x, y, z = camera.viewmat[:3].numpy() @ np.append(middle(split.view(i).conditions["time"].item()), 1.0)
            assert pixels.alpha is not None
            found = scenes.centroid(pixels.alpha.numpy())
            assert math.hypot(found[0] - camera.fx * x / z - camera.cx, found[1] - camera.fy * y / z - camera.cy) < 0.5
            assert torch.allclose(pixels.rgb, torch.tensor(COLOR).float() * pixels.alpha[..., None], atol=1.5 / 255)


def test_one_file_of_frames(tmp_path: Path, scenes: Any, context: Any) -> None:
    write(tmp_path, "", views(scenes), scenes)
    data = load_moving_multiview({"path": tmp_path, "test_every": 4}, context)
    assert (len(data.train), len(data.test)) == (36, 12)
    assert times_of(data.test) == [np.float32(t) for t in TIMES]
    document = json.loads((tmp_path / "transforms.json").read_text())
    document["test_filenames"] = ["images/r_003.png"]
    for frame in document["frames"]:
        frame["file_path"] += ".png"
        frame["fl_x"], frame["k1"] = 60.0, 1e-4  # the cameras of the nerfstudio loader, lenses included
    scenes.write_json(tmp_path / "transforms.json", document)
    listed = load_moving_multiview({"path": tmp_path}, context)
    assert (len(listed.train), len(listed.test), listed.test.view(0).camera.fx) == (47, 1, 60.0)
    assert listed.train.pixels(0).mask is not None


def test_exr_is_linear_and_premultiplied(tmp_path: Path, scenes: Any, context: Any) -> None:
    for split in ("train", "test"):
        write(tmp_path, split, views(scenes)[:8], scenes, exr=True)
    data = load_moving_multiview({"path": tmp_path}, context)
    pixels = data.train.pixels(3)
    assert data.color_space == "linear" and pixels.alpha is not None
    assert torch.allclose(pixels.rgb, 2.0 * torch.tensor(COLOR).float() * pixels.alpha[..., None], atol=1e-3)
    points = data.initial_points(50, rng())
    assert torch.allclose(points.colors, 2.0 * torch.tensor(COLOR).float().expand(50, 3), atol=2e-3)


def test_frame_numbers_become_times(folder: Path, scenes: Any, context: Any) -> None:
    edit(folder / "transforms_train.json", lambda frames: [f.update(time=10 + i // 4) for i, f in enumerate(frames)])
    edit(folder / "transforms_test.json", lambda frames: [f.update(time=8 + i) for i, f in enumerate(frames)])
    data = load_moving_multiview({"path": folder, "time_range": "auto"}, context)
    assert times_of(data.train) == [np.float32((2 + i // 4) / 13) for i in range(48)]
    assert times_of(data.test) == [np.float32(i / 13) for i in range(5)]
    ranged = load_moving_multiview({"path": folder, "time_range": "-2:38"}, context)
    assert times_of(ranged.test) == [np.float32((10 + i) / 40) for i in range(5)]
    # not in use, yet part of the scene's clock
    write(folder, "val", [(scenes.opengl_pose((0.0, -3.0, 1.0)), 28)], scenes)
    assert times_of(load_moving_multiview({"path": folder, "time_range": "auto"}, context).test)[1] == np.float32(
        1 / 20
    )
    assert times_of(
        load_moving_multiview({"path": folder, "time_range": "auto", "test_split": "val"}, context).test
    ) == [1.0]


def test_files_that_are_missing(folder: Path, scenes: Any, context: Any) -> None:
    scenes.refused(
        load_moving_multiview, {"path": folder, "test_split": "late"}, context, "transforms_late.json", "not found"
    )
    (folder / "train" / "r_007.png").unlink()
    scenes.refused(load_moving_multiview, {"path": folder}, context, "1 files not found", "train/r_007")
    for split in ("train", "test"):
        (folder / f"transforms_{split}.json").unlink()
    scenes.refused(
        load_moving_multiview,
        {"path": folder},
        context,
        str(folder),
        "neither transforms_train.json nor transforms.json",
    )


def test_a_scene_without_times_is_static(folder: Path, scenes: Any, context: Any) -> None:
    for split in ("train", "test"):
        edit(folder / f"transforms_{split}.json", lambda frames: [f.pop("time") for f in frames])
    for setting in ("0:1", "auto"):
        words = ("transforms_train.json: no frame has a time", "task=static")
        scenes.refused(load_moving_multiview, {"path": folder, "time_range": setting}, context, *words)


@pytest.mark.parametrize(
    ("setting", "value", "words"),
    [
        ("0:1", None, ["time is null", "finite number"]),
        ("auto", "0.5", ['time is "0.5"', "finite number"]),
        ("0:1", math.nan, ["time is NaN", "finite number"]),
        ("auto", math.inf, ["time is Infinity", "finite number"]),
        ("auto", "absent", ["time is missing", "because other frames have a time"]),
    ],
)
def test_times_that_are_none(
    folder: Path, scenes: Any, context: Any, setting: str, value: Any, words: list[str]
) -> None:
    change = {} if value == "absent" else {"time": value}
    edit(folder / "transforms_test.json", lambda frames: (frames[3].pop("time"), frames[3].update(change)))
    where = ("transforms_test.json: frames[3]", "./test/r_003")
    scenes.refused(load_moving_multiview, {"path": folder, "time_range": setting}, context, *where, *words)


def test_times_out_of_range(folder: Path, scenes: Any, context: Any) -> None:
    scenes.refused(
        load_moving_multiview,
        {"path": folder, "time_range": "0:0.5"},
        context,
        "transforms_train.json: frames[24]",
        "0 to 0.5",
    )
    for value in (1.0001, -1, 30):
        edit(folder / "transforms_train.json", lambda frames, value=value: frames[5].update(time=value))  # type: ignore[misc]
        place = ["transforms_train.json: frames[5]", "./train/r_005"]
        words = [*place, f"time is {value}", "from 0 to 1", "scene.time_range"]
        scenes.refused(load_moving_multiview, {"path": folder}, context, *words)
        load_moving_multiview({"path": folder, "time_range": "auto"}, context)
    for split in ("train", "test"):
        edit(folder / f"transforms_{split}.json", lambda frames: [f.update(time=3) for f in frames])
    scenes.refused(
        load_moving_multiview,
        {"path": folder, "time_range": "auto"},
        context,
        "every frame has the time 3",
        "two different times",
    )


# ---------------------------------------------------------------- where it starts


def covered(means: Tensor, within: float) -> list[float]:
    """For 23 times between and at those of the images: which part of the ball's surface has a point near."""
    directions = torch.nn.functional.normalize(torch.randn((300, 3), generator=rng()), dim=-1)
    parts = []
    for i in range(23):
        surface = torch.from_numpy(middle(i / 22)).float() + RADIUS * directions
        parts.append((torch.cdist(surface, means).min(dim=1).values < within).float().mean().item())
    return parts


def beside(means: Tensor) -> float:
    """The part of the points that the ball never comes near."""
    path = torch.from_numpy(np.stack([middle(t) for t in np.linspace(0, 1, 200)])).float()
    return (torch.cdist(means, path).min(dim=1).values > 1.25 * RADIUS).float().mean().item()


def test_starting_points_cover_the_ball_at_all_times(folder: Path, context: Any) -> None:
    data = load_moving_multiview({"path": folder}, context)
    points = data.initial_points(2000, rng(1))
    assert points.means.shape == (2000, 3) == points.colors.shape and len(points.means.unique(dim=0)) == 2000
    assert min(covered(points.means, 0.35 * RADIUS)) > 0.98 and beside(points.means) < 0.05
    assert torch.allclose(points.colors, torch.tensor(COLOR).float().expand(2000, 3), atol=0.02)
    times = points.conditions["time"]
    assert times.dtype == torch.float32 and times.shape == (2000,)
    assert sorted(set(times.tolist())) == [np.float32(t) for t in TIMES]
    where = torch.from_numpy(np.stack([middle(t) for t in times.tolist()])).float()
    assert (points.means - where).norm(dim=-1).max() < 1.7 * RADIUS, "a point lies where the ball was at its time"


def test_a_camera_that_jumps_gives_points_where_the_ball_passes(tmp_path: Path, scenes: Any, context: Any) -> None:
    """Every image has its own time, as in D-NeRF."""
    octants = np.array([[-1, -1, 1], [1, 1, 1], [1, -1, 1]] * 20)
    directions = np.abs(np.random.default_rng(0).normal(size=(60, 3))) * octants
    eyes = 3.5 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    write(tmp_path, "train", [(scenes.opengl_pose(tuple(eye)), i / 59) for i, eye in enumerate(eyes)], scenes)
    write(tmp_path, "test", [(scenes.opengl_pose((2.0, 2.0, 2.0)), 0.5)], scenes)
    points = load_moving_multiview({"path": tmp_path}, context).initial_points(1000, rng())
    assert min(covered(points.means, RADIUS)) > 0.98 and beside(points.means) < 0.25
    assert len(points.conditions["time"].unique()) == 29, "runs of four images, half overlapping"


def test_what_rests_is_covered_evenly(tmp_path: Path, scenes: Any, context: Any) -> None:
    """Found at all times, it gets no more points than if it had been found once."""
    still = [(pose, 0.4) for pose in scenes.ring(4, 3.5)]
    write(tmp_path, "train", [shot for _ in TIMES for shot in still], scenes)
    write(tmp_path, "test", still[:1], scenes)
    file = tmp_path / "transforms_train.json"
    edit(file, lambda frames: [f.update(time=TIMES[i // 4]) for i, f in enumerate(frames)])
    points = load_moving_multiview({"path": tmp_path}, context).initial_points(400, rng())
    gaps = torch.cdist(points.means, points.means).fill_diagonal_(9.0).min(dim=1).values
    assert gaps.quantile(0.05) > 0.3 * gaps.median() and len(set(points.conditions["time"].tolist())) == 12


def test_photographs_start_in_a_box_at_random_times(folder: Path, scenes: Any, context: Any) -> None:
    for file in [*folder.glob("train/*.png"), *folder.glob("test/*.png")]:
        scenes.save(file, np.full((SIZE, SIZE), 0.25))
    points = load_moving_multiview({"path": folder}, context).initial_points(500, rng())
    assert torch.equal(
        points.means, box_starting_points(load_moving_multiview({"path": folder}, context).train, 500, rng()).means
    )
    assert sorted(set(points.conditions["time"].tolist())) == [np.float32(t) for t in TIMES]


def test_moments_without_matter_give_no_points_and_masks_that_disagree_are_named(
    folder: Path, scenes: Any, context: Any
) -> None:
    for i in range(8):  # the first two times show nothing yet
        scenes.save(folder / "train" / f"r_{i:03d}.png", np.zeros((SIZE, SIZE, 4)))
    points = load_moving_multiview({"path": folder}, context).initial_points(400, rng())
    assert min(points.conditions["time"].tolist()) == pytest.approx(TIMES[2])
    for i in range(8, 48):
        scenes.save(folder / "train" / f"r_{i:03d}.png", np.zeros((SIZE, SIZE, 4)))
    data = load_moving_multiview({"path": folder}, context)
    with pytest.raises(EmptyHull, match="4 alpha masks is empty"):
        sample_moving_points(data.train, 10, rng())
