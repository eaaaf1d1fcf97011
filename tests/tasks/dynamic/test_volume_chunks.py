"""A sequence in chunks of time: how many, which frames each sees, and that all of them have the whole sequence's times,
box and light."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch

from neuprim.config import compose
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.io.vdb import write_vdb
from neuprim.core.task import Chunks, SceneContext
from neuprim.tasks.dynamic import TASK
from neuprim.tasks.dynamic.volume.volume_scene import (
    MAX_FRAMES,
    MIN_FRAMES,
    count_time_chunks,
    open_volume_source,
    split_into_time_chunks,
)
from tests.tasks.dynamic.sequences import dataset, empty_frame, recorded, write_blobs

NUMBERS = (2, 3, 5, 6, 7, 8, 10, 11, 12)
EMPTY = 3
SEEN = ["2:6", "5:10", "8:12"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Nine frames with gaps, the first three of which are empty."""
    centers = {number: 6.0 + step for step, number in enumerate(NUMBERS)}
    made = write_blobs(tmp_path_factory.mktemp("files"), centers)
    for number in NUMBERS[:EMPTY]:
        write_vdb(made / f"ball_{number}.vdb", empty_frame())
    return made


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cached")


def chunks(folder: Path, cache: Path, *words: str) -> Chunks | None:
    config = config_of(folder, *words)
    return split_into_time_chunks(config, SceneContext(0, cache / "cache"))


def config_of(folder: Path, *words: str) -> dict[str, Any]:
    scene = ["task=dynamic", "scene=vdb", f"scene.vdb='{folder}'", "scene.look=smoke_fire"]
    small = ["scene.size=24", "scene.cameras=6", "scene.samples=1"]
    return compose([*scene, *small, *words], check_output=False).to_dict()


# ---------------------------------------------------------------- how many


@pytest.mark.parametrize(
    ("requested", "frames", "images", "expected"),
    [
        (None, 500, 0, 1),
        (1, 500, 0, 1),
        (7, 500, 0, 7),
        ("auto", MAX_FRAMES, 0, 1),
        ("auto", MAX_FRAMES + 1, 0, 2),
        ("auto", 10 * MAX_FRAMES, 0, 10),
        ("auto", 100, 3, 3),
        ("auto", 100, 1000, 100 // MIN_FRAMES),
        ("auto", MIN_FRAMES - 1, 1000, 1),
    ],
)
def test_the_number_follows_from_frames_and_memory(
    requested: int | str | None, frames: int, images: int, expected: int
) -> None:
    assert count_time_chunks(requested, frames, images, 1) == expected


@pytest.mark.parametrize(
    ("requested", "frames", "message"),
    [
        (5, 9, "there are 9 frames .* at most 4, because"),
        (2, 3, "expected null, because a chunk"),
        (2, 1, "there is 1 frame"),
    ],
)
def test_more_than_the_frames_allow_is_refused(requested: int, frames: int, message: str) -> None:
    with pytest.raises(ConfigError, match=f"scene.chunks={requested}: .*{message}"):
        count_time_chunks(requested, frames, 0, 1)


# ---------------------------------------------------------------- which frames


def test_chunks_share_out_frames_and_see_one_more_at_each_seam(folder: Path, cache: Path) -> None:
    found = chunks(folder, cache, "scene.chunks=3")
    assert found is not None
    assert [part.settings["scene.span"] for part in found.parts] == SEEN and found.parts[0].name == "frames_02-06"
    assert sum(part.primitives for part in found.parts) == pytest.approx(1)
    assert sum(part.steps for part in found.parts) == pytest.approx(1)
    assert [part.steps for part in found.parts] == pytest.approx([4 / 13, 5 / 13, 4 / 13])
    shares = [part.primitives for part in found.parts]  # by the matter that they see: in one frame, four and four
    assert shares == pytest.approx([1 / 9, 4 / 9, 4 / 9], rel=0.05)


def test_time_goes_faster_in_a_chunk(folder: Path, cache: Path) -> None:
    """As windows and rates say that are measured in the whole sequence's time."""
    found = chunks(folder, cache, "scene.chunks=3", "model.init.window=0.9")
    assert found is not None
    usual = config_of(folder)["train"]["rates"]
    own, length = found.parts[0].settings, 4 / 10
    assert own["model.init.window"] == pytest.approx(length)
    assert own["train.rates.window_center"] == pytest.approx(length * usual["window_center"])
    assert own["train.rates.velocity"] == pytest.approx(usual["velocity"] / length)
    assert own["train.rates.acceleration"] == pytest.approx(usual["acceleration"] / length**2)
    assert "train.rates.W_t" not in own  # which this form does not have
    assert "model.init.window" not in chunks(folder, cache, "scene.chunks=3", "model.init.window=0.1").parts[0].settings  # type: ignore[union-attr]


def test_nothing_is_fitted_where_there_is_nothing(folder: Path, cache: Path) -> None:
    found = chunks(folder, cache, "scene.frames=2:8", "scene.chunks=3")
    assert found is not None and [part.settings["scene.span"] for part in found.parts] == ["3:7", "6:8"]
    assert [part.steps for part in found.parts] == pytest.approx([4 / 7, 3 / 7])
    with pytest.raises(DataError):  # and nowhere anything
        chunks(folder, cache, "scene.frames=2:3")


# ---------------------------------------------------------------- what a chunk sees


def test_a_span_has_the_whole_sequences_times_box_light_and_images(folder: Path, tmp_path: Path) -> None:
    whole, part = dataset(folder, tmp_path), dataset(folder, tmp_path, span="5:10")
    assert [f.number for f in recorded(part).capture.frames] == [5, 6, 7, 8, 10]
    assert part.exposure == whole.exposure and torch.equal(part.bounds, whole.bounds)  # type: ignore[arg-type]
    assert recorded(part).folder.address == recorded(whole).folder.address
    assert len(part.train) == 4 * 5 and len(part.test) == 2 * 5
    named = {whole.test.view(i).name: i for i in range(len(whole.test))}
    for i in range(len(part.test)):
        view = part.test.view(i)
        same = named[view.name]
        assert torch.equal(view.conditions["time"], whole.test.view(same).conditions["time"])
        assert torch.equal(part.test.pixels(i).rgb, whole.test.pixels(same).rgb)
    times = part.initial_points(200, torch.Generator().manual_seed(0)).conditions["time"]
    assert 0.3 - 1e-6 <= float(times.min()) and float(times.max()) <= 0.8 + 1e-6
    assert part.points is not None
    drawn = part.points.draw(50, torch.Generator().manual_seed(1))
    assert 0.3 - 1e-6 <= float(drawn.conditions["time"]) <= 0.8 + 1e-6
    assert [clip.views for clip in TASK.clips(part)] == [range(5), range(5, 10)]


def test_files_of_a_span_are_its_frames_in_the_sequences_time(folder: Path, tmp_path: Path) -> None:
    small = {"vdb": str(folder), "size": 24, "cameras": 6, "samples": 1}
    settings: Mapping[str, Any] = {**small, "look": "smoke_fire", "span": "5:10"}
    source = open_volume_source(settings, SceneContext(0, tmp_path / "cache"))
    assert list(source.placement.numbers) == [5, 6, 7, 8, 10]
    assert source.placement.times["time"] == pytest.approx([0.3, 0.4, 0.5, 0.6, 0.8])
