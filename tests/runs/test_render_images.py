"""Which frames a film has: cameras, times and lights together."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from neuprim.core.cameras.pinhole import CameraViews
from neuprim.core.data import View
from neuprim.core.errors import ConfigError
from neuprim.runs.render_images import _run_views_of_camera_file, _view_file_names, set_run_view_conditions
from neuprim.tasks.dynamic import TASK as DYNAMIC
from neuprim.tasks.relight import TASK as RELIGHT
from tests import scenes

BOTH = replace(RELIGHT, conditions=(*DYNAMIC.conditions, *RELIGHT.conditions))
VIEWS = [View(f"v{i}", scenes.camera(8 + i, 8), {"light_intensity": torch.ones(3)}) for i in range(4)]


def test_time_and_light_go_along_together() -> None:
    views, animated = set_run_view_conditions(VIEWS[:1], BOTH, {"time": "0:1:48", "light": "orbit"})
    assert animated and len(views) == 48 == len({v.name for v in views})
    times = torch.stack([v.conditions["time"] for v in views])
    assert torch.allclose(times, torch.linspace(0, 1, 48), atol=1e-6)
    angles = torch.stack([torch.atan2(v.conditions["light"][1], v.conditions["light"][0]) for v in views]) % (
        2 * torch.pi
    )
    assert torch.allclose(angles, torch.arange(48) * (2 * torch.pi / 48), atol=1e-5)
    assert all(v.conditions["light_intensity"].tolist() == [1, 1, 1] for v in views)


def test_cameras_are_spread_over_the_frames_and_frames_over_the_cameras() -> None:
    views, _ = set_run_view_conditions(VIEWS, BOTH, {"time": "0:1:8", "light": "1,2,3"})
    assert [v.camera.width for v in views] == [8, 8, 9, 9, 10, 10, 11, 11]
    views, animated = set_run_view_conditions(VIEWS, BOTH, {"time": "0,1", "light": "orbit"})
    assert (
        animated
        and [float(v.conditions["time"]) for v in views] == [0, 0, 1, 1]
        and [v.camera.width for v in views] == [8, 9, 10, 11]
    )


def test_one_value_is_no_animation() -> None:
    views, animated = set_run_view_conditions(VIEWS, BOTH, {"time": "0.5", "light": "1,2,3"})
    assert not animated and [v.name for v in views] == ["v0", "v1", "v2", "v3"]


def test_lengths_that_differ_and_what_is_missing_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"--time 0:1:48 has 48 frames and --light orbit:4:40:60 has 60 frames"):
        set_run_view_conditions(VIEWS, BOTH, {"time": "0:1:48", "light": "orbit:4:40:60"})
    with pytest.raises(ConfigError, match="view v0 has no time, which task 'relight' needs; give --time"):
        set_run_view_conditions(VIEWS, BOTH, {"light": "1,2,3"})


def test_a_files_times_are_the_frames_where_the_task_has_a_time() -> None:
    file = CameraViews(tuple((v.name, v.camera) for v in VIEWS), times=(0.0, 0.25, 0.5, 1.0))
    assert [float(v.conditions["time"]) for v in _run_views_of_camera_file(file, DYNAMIC, {})] == [0.0, 0.25, 0.5, 1.0]
    assert [v.conditions for v in _run_views_of_camera_file(file, DYNAMIC, {"time": "0.5"})] == [{}] * 4, (
        "what the user says comes first"
    )
    assert [v.conditions for v in _run_views_of_camera_file(file, RELIGHT, {})] == [{}] * 4
    assert [v.conditions for v in _run_views_of_camera_file(replace(file, times=None), DYNAMIC, {})] == [{}] * 4
    views, animated = set_run_view_conditions(
        _run_views_of_camera_file(file, BOTH, {}), BOTH, {"light": "orbit:4:40:4", "light_intensity": "2"}
    )
    assert animated and [float(v.conditions["time"]) for v in views] == [0.0, 0.25, 0.5, 1.0]


def test_no_two_views_share_a_file() -> None:
    assert _view_file_names(("a/b", "c d")) == ["a_b", "c_d"]
    assert _view_file_names(("a/b", "a_b", "A_B")) == ["000_a_b", "001_a_b", "002_A_B"]
