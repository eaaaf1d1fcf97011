"""Training views that judge: which, that nobody learns from them, and that every moment of a film is learned from."""

from __future__ import annotations

from dataclasses import replace

import pytest

from neuprim.core.data.dataset import hold_out_views
from neuprim.core.errors import ConfigError
from tests.core import tiny


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
    with pytest.raises(ConfigError, match=r"every 1\. of 6 training views"):
        hold_out_views(dataset, 1)
    with pytest.raises(ConfigError, match="of 1 training views held out; expected 2"):
        hold_out_views(replace(dataset, train=tiny.Views(1, 0.0)), 2)
