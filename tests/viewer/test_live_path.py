"""Camera paths: poses and cameras are each other's inverse, keys make a smooth way, and its file is one that ``neuprim
render`` reads."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.cameras.file import read_cameras
from neuprim.core.cameras.world import World
from neuprim.core.errors import ConfigError
from neuprim.tasks.dynamic import TASK as DYNAMIC
from neuprim.tasks.relight import TASK as RELIGHT
from neuprim.viewer.film import free_name
from neuprim.viewer.path import CameraPath, Key, condition_texts
from neuprim.viewer.poses import Pose, fitted


def camera(x: float, y: float = -3.0, fov: float = 100.0) -> Camera:
    view = look_at(torch.tensor([x, y, 1.0], dtype=torch.float64), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(view, fov, fov, 32.0, 24.0, 64, 48)


def keys(*xs: float, **conditions: torch.Tensor) -> list[Key]:
    return [Key(Pose.of(camera(x)), conditions) for x in xs]


def test_a_pose_is_its_camera_in_any_window() -> None:
    there = camera(1.3)
    back = Pose.of(there).camera(64, 48)
    assert (
        torch.allclose(back.viewmat, there.viewmat, atol=1e-12) and back.fy == pytest.approx(there.fy) and back.cx == 32
    )
    wide = Pose.of(there).camera(128, 48)
    assert wide.fx == wide.fy == pytest.approx(there.fy) and wide.cx == 64, "the vertical field of view stays"


@pytest.mark.parametrize(
    ("size", "found"), [((1280, 800), (960, 600)), ((400, 800), (400, 800)), ((1, 5000), (1, 960)), ((0, 0), (1, 1))]
)
def test_windows_are_fitted_into_pictures(size: tuple[int, int], found: tuple[int, int]) -> None:
    assert fitted(size, 960) == found


def test_a_path_goes_through_its_keys_and_stays_smooth() -> None:
    path = CameraPath(keys(-1.0, 0.5, 1.0), seconds=2.0, fps=24.0)
    assert path.frames == 48
    poses = path.poses(201)
    for index, key in ((0, path.keys[0]), (100, path.keys[1]), (200, path.keys[2])):
        assert np.allclose(poses[index].position, key.pose.position)
        assert np.allclose((poses[index].rotation.inv() * key.pose.rotation).magnitude(), 0, atol=1e-7)
    ways = np.diff([pose.position for pose in poses], axis=0)
    turns = [(b.rotation * a.rotation.inv()).magnitude() for a, b in pairwise(poses)]
    assert np.abs(np.diff(ways, axis=0)).max() < 0.1 * np.abs(ways).max() and max(turns) < 3 * np.median(turns)


def test_keys_change_places_and_one_is_a_still() -> None:
    path = CameraPath(keys(0.0, 1.0, 2.0))
    first = path.keys[0]
    assert path.move(0, 1) == 1 and path.keys[1] is first
    assert path.move(0, -1) == 0 and path.move(2, 1) == 2 and path.move(-1, 1) == -1
    one = CameraPath(path.keys[:1])
    assert one.frames == 1 and len(one.poses(3)) == 3
    with pytest.raises(ConfigError, match="no keys"):
        CameraPath().poses(2)


def test_the_file_is_one_that_render_reads(tmp_path: Path) -> None:
    path = CameraPath(keys(-1.0, 1.0), seconds=1.0, fps=6.0)
    path.write(tmp_path / "path.json", (80, 60), World())
    found = [camera for _, camera in read_cameras(tmp_path / "path.json")]
    assert len(found) == 6 and (found[0].width, found[0].height) == (80, 60)
    for pose, one in zip(path.poses(6), found, strict=True):
        expected = pose.camera(80, 60)
        assert torch.allclose(one.viewmat, expected.viewmat, atol=1e-9) and one.fx == pytest.approx(expected.fx)


def test_conditions_go_straight_from_key_to_key() -> None:
    path = CameraPath([Key(Pose.of(camera(0.0)), {"time": torch.tensor(t)}) for t in (0.0, 0.8, 0.4)])
    frames = path.conditions(DYNAMIC.conditions, 5)
    assert [round(float(frame["time"]), 6) for frame in frames] == [0.0, 0.4, 0.8, 0.6, 0.4]
    assert condition_texts(frames, DYNAMIC.conditions, World()) == {"time": "0,0.4,0.8,0.6,0.4"}
    assert condition_texts(frames[1:2], DYNAMIC.conditions, World()) == {"time": "0.4"}


def test_a_light_stays_where_it_is_along_a_path() -> None:
    def lit(x: float) -> Key:
        return Key(Pose.of(camera(x)), {"light": torch.tensor([x, 0.0, 2.0]), "light_intensity": torch.ones(3)})

    still = CameraPath([lit(1.0), Key(Pose.of(camera(2.0)), lit(1.0).conditions)])
    assert condition_texts(still.conditions(RELIGHT.conditions, 4), RELIGHT.conditions, World()) == {
        "light": "1,0,2",
        "light_intensity": "1,1,1",
    }
    with pytest.raises(ConfigError, match="light: changes along the path"):
        condition_texts(CameraPath([lit(1.0), lit(2.0)]).conditions(RELIGHT.conditions, 4), RELIGHT.conditions, World())


def test_names_that_are_taken_are_left_alone(tmp_path: Path) -> None:
    names = []
    for _ in range(3):
        path = free_name(tmp_path / "path.json")
        path.write_text("")
        names.append(path.name)
    assert names == ["path.json", "path-2.json", "path-3.json"]
