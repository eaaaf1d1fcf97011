"""Channels of any number and name: what pictures show of them, and what files hold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import OpenEXR
import pytest
import torch
from torch import Tensor

from neuprim.core.channels import Channels, find_channels, read_stored_channels
from neuprim.core.errors import CheckpointError, ConfigError, DataError
from neuprim.core.io import images
from neuprim.core.io.exr import default_exr_channel_names, exr_channels, write_exr
from neuprim.tasks.static import TASK
from tests.core import tiny

BANDS = ("450nm", "550 nm", "Ünïcode", "NIR", "layer.R")


def image(channels: int, height: int = 4, width: int = 6) -> Tensor:
    return torch.rand(height, width, channels, generator=torch.Generator().manual_seed(channels)) * 1.5 - 0.1


# ---------------------------------------------------------------- what pictures show


@pytest.mark.parametrize(
    ("names", "shown", "indices"),
    [
        (default_exr_channel_names(5), "c0, c1, c2 of 5 channels as red, green, blue", (0, 1, 2)),
        (BANDS, "450nm, 550 nm, Ünïcode of 5 channels as red, green, blue", (0, 1, 2)),
        (("NIR", "B", "G", "R"), "R, G, B of 4 channels as red, green, blue", (3, 2, 1)),
        (("700nm", "550nm", "450nm"), "700nm, 550nm, 450nm as red, green, blue", (0, 1, 2)),
        (("c0", "c1"), "c0, c1 as red, green", (0, 1)),
    ],
)
def test_without_a_display_it_is_said_what_is_shown(names: tuple[str, ...], shown: str, indices: Sequence[int]) -> None:
    channels, values = Channels(names), image(len(names))
    assert channels.display_text == shown
    assert channels.hides_channels == (len(names) != 3) and not channels.is_rgb
    found = channels.display(values)
    assert found.shape == (4, 6, 3) and torch.equal(found[..., : len(indices)], values[..., list(indices)])
    assert not found[..., len(indices) :].any()


def test_the_tasks_own_display_is_what_is_shown() -> None:
    channels = Channels(BANDS, "linear", lambda x: x.flip(-1)[..., :3], "bands")
    values = image(5)
    assert torch.equal(channels.display(values), values[..., [4, 3, 2]].clamp(0, 1))
    assert torch.equal(channels.display_rows(values[0]), channels.display(values)[0])
    assert (
        "through the display of task 'bands'" in channels.display_text
        and not channels.hides_channels
        and not channels.is_rgb
    )
    assert not Channels(own=lambda x: x).is_rgb


@pytest.mark.parametrize(
    ("own", "words"),
    [
        (lambda x: x, ("torch.float32 of shape (4, 6, 5) for an image (4, 6, 5)", "expected floats (4, 6, 3)")),
        (lambda x: (255 * x[..., :3]).byte(), ("torch.uint8",)),
        (lambda x: x[..., :3].numpy(), ("display returned ndarray",)),
        (lambda x: x[..., :3] / 0, ("72 NaN or infinite values",)),
    ],
)
def test_a_display_that_gives_no_picture_is_named(own: Any, words: Sequence[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        Channels(BANDS, own=own, task="bands").display(image(5))
    text = str(caught.value)
    assert text.startswith("task 'bands': display returned") and all(w in text for w in words)


# ---------------------------------------------------------------- where they come from


def test_a_data_set_must_have_the_channels_that_its_task_names() -> None:
    dataset = tiny.two_primitives()
    assert find_channels(TASK, dataset).names == ("R", "G", "B")
    assert find_channels(replace(TASK, channels=("a", "b", "c")), dataset).names == ("a", "b", "c")
    with pytest.raises(
        DataError, match=r"^two: images have 3 channels; expected 5, the channels of task 'static': 450nm, 550 nm"
    ):
        find_channels(replace(TASK, channels=BANDS), dataset)
    with pytest.raises(
        DataError, match=r"^two: the background has shape \(3,\); expected \(5,\), one number per channel"
    ):
        find_channels(TASK, replace(dataset, channels=5))


def test_a_model_keeps_its_names_and_old_ones_get_some(tmp_path: Path) -> None:
    bands = replace(TASK, channels=BANDS)
    kept = read_stored_channels(tmp_path, {"channels": list("vwxyz"), "color_space": "linear"}, bands, 5)
    assert (kept.names, kept.color_space) == (tuple("vwxyz"), "linear")
    assert read_stored_channels(tmp_path, {}, bands, 5).names == BANDS
    assert read_stored_channels(tmp_path, {}, bands, 4).names == ("c0", "c1", "c2", "c3")
    assert read_stored_channels(tmp_path, {}, TASK, 3) == Channels(task="static")
    for damaged in (list("abcd"), "abcde", list("abcdd"), [1, 2, 3, 4, 5], ["a", "b", "c", "d", "\n"]):
        with pytest.raises(CheckpointError, match=r"header names the channels .*; expected 5 different names"):
            read_stored_channels(tmp_path, {"channels": damaged}, bands, 5)


# ---------------------------------------------------------------- OpenEXR


@pytest.mark.parametrize("half", [True, False])
@pytest.mark.parametrize(
    "names",
    [BANDS, ("R", "G", "B"), ("Y",), ("NIR", "B", "G", "R"), ("z" * 31, "ü" * 15), default_exr_channel_names(31)],
)
def test_exr_gives_back_every_channel_by_its_name(tmp_path: Path, names: tuple[str, ...], half: bool) -> None:
    path, values = tmp_path / "a.exr", image(len(names))
    write_exr(path, values, half=half, names=names)
    read = images.read_image(path, (6, 4), names)
    expected = values.half() if half else values
    assert read.dtype == expected.dtype and torch.equal(read, expected)
    assert exr_channels(path) == tuple(sorted(names, key=str.encode))
    assert images.image_info(path, names) == images.ImageInfo(6, 4, len(names), True)
    assert torch.equal(images.read_image(path, channels=names[-1:]), expected[..., -1:])
    with OpenEXR.File(str(path), separate_channels=True) as file:
        assert set(file.channels()) == set(names)
