"""What a data set promises, and training views that judge: a broken promise is one line that names the member."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.data import PointCloud, PointSamples
from neuprim.core.data.dataset import hold_out_views
from neuprim.core.data.dataset_check import DatasetError, check_dataset_views, check_point_samples, check_points
from neuprim.core.errors import ConfigError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.train.initial_model import initial_model_to_train
from neuprim.core.train.settings import ModelSettings
from neuprim.tasks.static import SphericalHarmonics
from tests.core import tiny

N = tiny.SIZE
TIME = ConditionSpec("time", (), "fraction", (0.0, 1.0), lambda text: [])


def spoil(split: str = "train", index: int = 0, **changes: Any) -> Callable[[Any], None]:
    """Replaces members of one view's pixels; a function is applied to the member."""

    def change(data: Any) -> None:
        images = getattr(data, split).images
        members = {k: v(getattr(images[index], k)) if callable(v) else v for k, v in changes.items()}
        images[index] = replace(images[index], **members)

    return change


def member(**changes: Any) -> Callable[[Any], None]:
    return lambda data: data.__dict__.update(changes)


def viewed(split: str, **changes: Any) -> Callable[[Any], None]:
    """Replaces members of every view of a split."""

    def change(data: Any) -> None:
        views = getattr(data, split)
        plain = views.view
        views.view = lambda index: replace(plain(index), **changes)

    return change


def nan(image: Tensor) -> Tensor:
    image = image.clone()
    image[3, 4, 1] = float("nan")
    return image


def empty(data: Any) -> None:
    data.test.cameras = []


def wrong_view(data: Any) -> None:
    data.test.view = lambda index: "a view"


VIEW = "train view 0 (v0): "
SCALED = Camera(torch.eye(4) * 2, 1.0, 1.0, 0.0, 0.0, N, N)
TEXTS: Any = Camera(torch.eye(4), "1", 1.0, 0.0, 0.0, N, N)  # type: ignore[arg-type]
NUMPY: Any = Camera(np.eye(4), 1.0, 1.0, 0.0, 0.0, N, N)  # type: ignore[arg-type]
FAULTS: dict[str, Callable[[Any], None]] = {
    f"train view v0: rgb is float32 (8, 9, 3); expected float32 ({N}, {N}, 3)": spoil(rgb=torch.zeros(8, 9, 3)),
    f"rgb is uint8 ({N}, {N}, 3); expected float32": spoil(rgb=lambda x: (255 * x).to(torch.uint8)),
    "rgb is a numpy.ndarray; expected float32": spoil(rgb=lambda x: x.numpy()),
    "rgb is None; expected float32": spoil(rgb=None),
    f"alpha is float32 ({N}, {N}, 1); expected float32 ({N}, {N})": spoil(alpha=lambda x: x[..., None]),
    f"mask is float32 ({N}, {N}); expected bool ({N}, {N})": spoil(mask=torch.ones(N, N)),
    "rgb: found 1 values that are NaN or infinite, the first at [3, 4, 1]; expected finite": spoil(rgb=nan),
    "test view v0: alpha: found": spoil("test", alpha=lambda x: x / 0),
    "train view v0: pixels is a str; expected": lambda data: data.train.images.__setitem__(0, "png"),
    "two: background is float32 (1,); expected float32 (3,), one number": member(background=torch.ones(1)),
    f"rgb is float32 ({N}, {N}, 3); expected float32 ({N}, {N}, 1)": member(channels=1, background=torch.ones(1)),
    "two: channels is '3'; expected a whole number": member(channels="3"),
    "two: the test split is empty": empty,
    "test view 0 (v0): camera is None; expected a neuprim.core.cameras": viewed("test", camera=None),
    f"{VIEW}camera: camera rotation is singular or scaled": viewed("train", camera=SCALED),
    f"{VIEW}camera is Camera(": viewed("train", camera=TEXTS),
    f"{VIEW}camera: viewmat is a numpy.ndarray": viewed("train", camera=NUMPY),
    "train view 0: name is ''; expected nonempty text": viewed("train", name=""),
    "test view 0 is a str; expected a neuprim.core.data.dataset.View": wrong_view,
    "two: start is None; expected a function of (views, count, generator)": member(start=None),
    "two: exposure is 0; expected a positive number": member(exposure=0),
    "two: placement is a dict; expected a neuprim.core.volumes.density_truth.DensityGridPlacement": member(
        placement={}
    ),
    "two: test is a list; expected a neuprim.core.data.dataset.ViewSet": member(test=[]),
    "two: color_space is 'sRGB'; expected srgb or linear": member(color_space="sRGB"),
    "two: data_source is 'photos'; expected real or generated": member(data_source="photos"),
    "two: extent is nan; expected a positive number": member(extent=float("nan")),
    "two: up: found 3 values that are NaN or infinite": member(up=torch.full((3,), float("nan"))),
    "two: bounds is float32 (3, 2); expected float32 (2, 3)": member(bounds=torch.zeros(3, 2)),
}


@pytest.mark.parametrize("text", FAULTS)
def test_a_broken_promise_is_one_line(text: str) -> None:
    data = tiny.two_primitives()
    check_dataset_views(data, ())
    FAULTS[text](data)
    with pytest.raises(DatasetError) as caught:
        check_dataset_views(data, ())
    assert text in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (
            None,
            "train view 0 (v0): condition 'time' is missing, but the task needs this condition; conditions found: none",
        ),
        (torch.zeros(1), "train view 0 (v0): condition 'time' is float32 (1,); expected float32 ()"),
        (0.5, "train view 0 (v0): condition 'time' is a float; expected float32 ()"),
        (
            torch.tensor(float("nan")),
            "train view 0 (v0): condition 'time': found 1 values that are NaN or infinite; expected finite",
        ),
    ],
)
def test_conditions_that_the_task_declares(value: Any, text: str) -> None:
    data = tiny.two_primitives()
    if value is not None:
        viewed("train", conditions={"time": value})(data)
    with pytest.raises(DatasetError) as caught:
        check_dataset_views(data, [TIME])
    assert text in str(caught.value)


POINTS: dict[str, dict[str, Any]] = {
    "two: starting points: colors is float32 (4, 3); expected float32 (5, 3)": {"colors": torch.zeros(4, 3)},
    "two: starting points: velocities is float32 (5, 2); expected float32 (5, 3)": {"velocities": torch.zeros(5, 2)},
    "means is float32 (5, 2); expected float32 (5, 3)": {"means": torch.zeros(5, 2)},
    "means: found 15 values that are NaN or infinite": {"means": torch.full((5, 3), float("nan"))},
    "found 7 points; expected at most 6": {"means": torch.zeros(7, 3)},
    "quats is float32 (5, 3); expected float32 (5, 4)": {"quats": torch.zeros(5, 3)},
    "condition 'time' is float32 (2,); expected float32 (5,)": {"conditions": {"time": torch.zeros(2)}},
}


@pytest.mark.parametrize("text", POINTS)
def test_starting_points(text: str) -> None:
    data, cloud = tiny.two_primitives(), PointCloud(torch.zeros(5, 3), torch.zeros(5, 3))
    check_points(cloud, 6, data)
    cloud = replace(cloud, **POINTS[text])
    with pytest.raises(DatasetError) as caught:
        check_points(cloud, 6, data)
    assert text in str(caught.value)
    data = replace(data, start=lambda views, count, generator: cloud)
    with pytest.raises(DatasetError, match="starting points"):  # where a run asks for them
        initial_model_to_train(CosineDensity(1), SphericalHarmonics(0, 3), data, ModelSettings(primitives=6), 0)


def test_an_orbit_has_every_condition_of_the_training_views() -> None:
    data = tiny.two_primitives()
    plain = data.train.view
    data.train.view = lambda i: replace(
        plain(i), conditions={"time": torch.tensor(0.2 + 0.1 * i), "light": torch.tensor([i, 2.0, 3.0])}
    )  # type: ignore[method-assign]
    views = data.orbit(3)
    torch.testing.assert_close(torch.stack([v.conditions["time"] for v in views]), torch.tensor([0.2, 0.45, 0.7]))
    assert [v.conditions["light"].tolist() for v in views] == [[0.0, 2.0, 3.0]] * 3


SAMPLES: dict[str, dict[str, Any]] = {
    "points is a list; expected float32 (4, 3)": {"points": [[0.0] * 3] * 4},
    "points is float32 (5, 3); expected float32 (4, 3)": {"points": torch.zeros(5, 3)},
    "sigma is float32 (0,); expected float32 ('M',), M at least 1": {"sigma": torch.zeros(0)},
    "source is float32 (4, 1); expected float32 (4, 3)": {"source": torch.zeros(4, 1)},
    "sigma_scale is 0.0; expected a positive number": {"sigma_scale": 0.0},
    "source_scale is inf; expected a positive number": {"source_scale": float("inf")},
}


@pytest.mark.parametrize("text", SAMPLES)
def test_points_to_learn_from(text: str) -> None:
    good = PointSamples("f", {}, torch.zeros(4, 3), torch.zeros(4), torch.zeros(4, 3), 1.0)
    check_point_samples(good, tiny.two_primitives())
    check_point_samples(replace(good, source=None), tiny.two_primitives())
    with pytest.raises(DatasetError) as caught:
        check_point_samples(replace(good, **SAMPLES[text]), tiny.two_primitives())
    assert str(caught.value) == f"two: points of f: {text}"


def names(views: tiny.Views) -> list[str]:
    return [views.view(i).name for i in range(len(views))]


def test_one_of_each_group_takes_the_place_of_the_test_views() -> None:
    dataset = tiny.two_primitives()
    found = hold_out_views(dataset, 3)
    assert names(found.test) == ["v0", "v4"] and names(found.train) == ["v1", "v2", "v3", "v5"]  # type: ignore[arg-type]
    assert found.test.pixels(1) is dataset.train.pixels(4) and found.name == dataset.name and len(dataset.train) == 6


def test_no_moment_of_a_film_is_held_out_of_every_camera() -> None:
    frames = 8
    dataset = tiny.two_primitives(views=lambda count, start: tiny.Views(2 * frames, start))
    moments = {int(name[1:]) % frames for name in names(hold_out_views(dataset, frames).test)}  # type: ignore[arg-type]
    assert moments == {0, 1}


def test_what_cannot_be_held_out_is_refused() -> None:
    dataset = tiny.two_primitives()
    with pytest.raises(ConfigError, match=r"cannot hold out 1 of every 1 views from 6 training views"):
        hold_out_views(dataset, 1)
    with pytest.raises(ConfigError, match="from 1 training views; expected at least 2 views, and 1 of every 2 or more"):
        hold_out_views(replace(dataset, train=tiny.Views(1, 0.0)), 2)
