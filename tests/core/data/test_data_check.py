"""What a data set promises: every broken promise is one line that names view, member, what was found and what was
expected."""

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
from neuprim.core.data.dataset_check import (
    DatasetError,
    check_dataset,
    check_points,
    check_samples,
)
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.train.initial_model import initial_model
from neuprim.core.train.settings import ModelSettings
from neuprim.tasks.static.fields import SphericalHarmonics
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


FAULTS: dict[str, tuple[Callable[[Any], None], str]] = {
    "another size": (spoil(rgb=torch.zeros(8, 9, 3)),
        f"train view v0: rgb is float32 (8, 9, 3); expected float32 ({N}, {N}, 3), rows x columns"),
    "channels first": (
        spoil(rgb=lambda x: x.permute(2, 0, 1)),
        f"train view v0: rgb is float32 (3, {N}, {N}); expected float32 ({N}, {N}, 3), rows x columns x channels",
    ),
    "bytes": (spoil(rgb=lambda x: (255 * x).to(torch.uint8)), f"rgb is uint8 ({N}, {N}, 3); expected float32"),
    "double": (spoil("test", rgb=lambda x: x.double()),
        f"test view v0: rgb is float64 ({N}, {N}, 3); expected float32"),
    "numpy": (spoil(rgb=lambda x: x.numpy()), "train view v0: rgb is a numpy.ndarray; expected float32"),
    "nothing": (spoil(rgb=None), "train view v0: rgb is None; expected float32"),
    "alpha with an axis too many": (
        spoil(alpha=lambda x: x[..., None]),
        f"train view v0: alpha is float32 ({N}, {N}, 1); expected float32 ({N}, {N}), rows x columns, or None",
    ),
    "mask of numbers": (spoil(mask=torch.ones(N, N)),
        f"train view v0: mask is float32 ({N}, {N}); expected bool ({N}, {N})"),
    "mask of another size": (spoil(mask=torch.ones(3, N, dtype=torch.bool)), f"mask is bool (3, {N}); expected bool"),
    "nan": (spoil(rgb=nan),
        "train view v0: rgb: found 1 values that are NaN or infinite, the first at [3, 4, 1]; expected finite numbers"),
    "infinite alpha": (spoil("test", alpha=lambda x: x / 0), "test view v0: alpha: found"),
    "no pixels": (lambda data: data.train.images.__setitem__(0, "png"),
        "train view v0: pixels are a str; expected a neuprim.core.data.Pixels"),
    "background of another length": (
        member(background=torch.ones(1)),
        "two: background is float32 (1,); expected float32 (3,), one number for each of the 3 channels",
    ),
    "background as a list": (member(background=[1.0, 1.0, 1.0]), "two: background is a list; expected float32 (3,)"),
    "other channels": (member(channels=1, background=torch.ones(1)),
        f"rgb is float32 ({N}, {N}, 3); expected float32 ({N}, {N}, 1)"),
    "channels as text": (member(channels="3"), "two: channels is '3'; expected a whole number"),
    "no test views": (empty, "two: the test split is empty"),
    "no camera": (viewed("test", camera=None),
        "test view 0 (v0): camera is None; expected a neuprim.core.cameras.Camera"),
    "a broken camera": (
        viewed("train", camera=Camera(torch.eye(4) * 2, 1.0, 1.0, 0.0, 0.0, N, N)),
        "train view 0 (v0): camera: camera rotation is singular or scaled",
    ),
    "a camera of texts": (viewed("train", camera=Camera(torch.eye(4), "1", 1.0, 0.0, 0.0, N, N)),
        "train view 0 (v0): camera is Camera("),
    "a matrix of numpy": (
        viewed("train", camera=Camera(np.eye(4), 1.0, 1.0, 0.0, 0.0, N, N)),  # type: ignore[arg-type]
        "train view 0 (v0): camera: viewmat is a numpy.ndarray",
    ),
    "no name": (viewed("train", name=""), "train view 0: name is ''; expected text"),
    "no view": (wrong_view, "test view 0: found a str; expected a neuprim.core.data.View"),
    "no starting points": (member(start=None), "two: start is None; expected a function of (views, count, generator)"),
    "exposure": (member(exposure=0), "two: exposure is 0; expected a positive number"),
    "placement": (member(placement={}),
        "two: placement is a dict; expected a neuprim.core.volumes.source.Placement, or None"),
    "a split that is none": (member(test=[]), "two: test is a list; expected a neuprim.core.data.ViewSet"),
    "colour space": (member(color_space="sRGB"), "two: color_space is 'sRGB'; expected srgb or linear"),
    "data source": (member(data_source="photos"),
        "two: data_source is 'photos'; expected real or generated or simulated"),
    "extent": (member(extent=float("nan")), "two: extent is nan; expected a positive number"),
    "up": (member(up=torch.full((3,), float("nan"))),
        "two: up: found 3 values that are NaN or infinite, the first at [0]"),
    "bounds": (member(bounds=torch.zeros(3, 2)), "two: bounds is float32 (3, 2); expected float32 (2, 3)"),
}  # fmt: skip


@pytest.mark.parametrize(("change", "text"), FAULTS.values(), ids=FAULTS)
def test_a_broken_promise_is_one_line(change: Callable[[Any], None], text: str) -> None:
    data = tiny.two_primitives()
    check_dataset(data, ())
    change(data)
    with pytest.raises(DatasetError) as caught:
        check_dataset(data, ())
    assert text in str(caught.value) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "train view 0 (v0): condition 'time' is missing; found none, the task needs it"),
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
        check_dataset(data, [TIME])
    assert text in str(caught.value)


POINTS: dict[str, tuple[dict[str, Any], str]] = {
    "more points than colours": (
        {"colors": torch.zeros(4, 3)},
        "two: starting points: colors is float32 (4, 3); expected float32 (5, 3)",
    ),
    "other channels": ({"colors": torch.zeros(5, 1)}, "colors is float32 (5, 1); expected float32 (5, 3)"),
    "planar": ({"means": torch.zeros(5, 2)}, "means is float32 (5, 2); expected float32 (5, 3)"),
    "whole numbers": (
        {"means": torch.zeros(5, 3, dtype=torch.int64)},
        "means is int64 (5, 3); expected float32 (5, 3)",
    ),
    "numpy": ({"means": np.zeros((5, 3))}, "means is a numpy.ndarray; expected float32"),
    "nan": (
        {"means": torch.full((5, 3), float("nan"))},
        "means: found 15 values that are NaN or infinite, the first at [0, 0]",
    ),
    "too many": ({"means": torch.zeros(7, 3)}, "found 7 points; expected at most 6"),
    "quats": ({"quats": torch.zeros(5, 3)}, "quats is float32 (5, 3); expected float32 (5, 4)"),
    "conditions": ({"conditions": {"time": torch.zeros(2)}}, "condition 'time' is float32 (2,); expected float32 (5,)"),
}


@pytest.mark.parametrize(("changes", "text"), POINTS.values(), ids=POINTS)
def test_starting_points(changes: dict[str, Any], text: str) -> None:
    data, cloud = tiny.two_primitives(), PointCloud(torch.zeros(5, 3), torch.zeros(5, 3))
    check_points(cloud, 6, data)
    cloud = replace(cloud, **changes)
    with pytest.raises(DatasetError) as caught:
        check_points(cloud, 6, data)
    assert text in str(caught.value)
    data = replace(data, start=lambda views, count, generator: cloud)
    with pytest.raises(DatasetError, match="starting points"):  # where a run asks for them
        initial_model(CosineDensity(1), SphericalHarmonics(0, 3), data, ModelSettings(primitives=6), 0)


def test_an_orbit_has_every_condition_of_the_training_views() -> None:
    data = tiny.two_primitives()
    plain = data.train.view
    data.train.view = lambda i: replace(
        plain(i), conditions={"time": torch.tensor(0.1 * i), "light": torch.tensor([i, 2.0, 3.0])}
    )  # type: ignore[method-assign]
    views = data.orbit(3)
    torch.testing.assert_close(torch.stack([v.conditions["time"] for v in views]), torch.tensor([0.0, 0.25, 0.5]))
    assert [v.conditions["light"].tolist() for v in views] == [[0.0, 2.0, 3.0]] * 3


SAMPLES: dict[str, tuple[dict[str, Any], str]] = {
    "a list": ({"points": [[0.0] * 3] * 4}, "points is a list; expected torch.float32 (4, 3)"),
    "doubles": ({"points": torch.zeros(4, 3).double()}, "points is float64 (4, 3); expected float32 (4, 3)"),
    "another count": ({"points": torch.zeros(5, 3)}, "points is float32 (5, 3); expected float32 (4, 3)"),
    "no points": ({"sigma": torch.zeros(0)}, "sigma is float32 (0,); expected float32 ('M',), M at least 1"),
    "other channels": ({"source": torch.zeros(4, 1)}, "source is float32 (4, 1); expected float32 (4, 3)"),
    "no scale": ({"sigma_scale": 0.0}, "sigma_scale is 0.0; expected a positive number"),
    "an endless scale": ({"source_scale": float("inf")}, "source_scale is inf; expected a positive number"),
}


@pytest.mark.parametrize(("changes", "text"), SAMPLES.values(), ids=SAMPLES)
def test_points_to_learn_from(changes: dict[str, Any], text: str) -> None:
    good = PointSamples("f", {}, torch.zeros(4, 3), torch.zeros(4), torch.zeros(4, 3), 1.0)
    check_samples(good, tiny.two_primitives())
    check_samples(replace(good, source=None), tiny.two_primitives())
    with pytest.raises(DatasetError) as caught:
        check_samples(replace(good, **changes), tiny.two_primitives())
    assert str(caught.value) == f"two: points of f: {text}".replace("torch.float32", "float32")
