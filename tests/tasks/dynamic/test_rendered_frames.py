"""Ground truth in a place of the user's choice: the same numbers as from this machine's cache, and nothing believed
that lies there."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from neuprim.core.data import Dataset
from neuprim.core.errors import DataError
from neuprim.tasks.dynamic.volume import capture as capturing
from neuprim.tasks.dynamic.volume.capture_dataset import FrameViews, FrameVoxels, MediumVoxels
from tests.tasks.dynamic.sequences import dataset, recorded, write_blobs


@pytest.fixture
def files(tmp_path: Path) -> Path:
    return write_blobs(tmp_path / "files", {number: 9.0 + number for number in (1, 2, 3)})


@pytest.mark.parametrize("address", ["DIR/shared", "file://DIR/shared", "memory://neuprim-truth"])
def test_the_same_data_set_from_anywhere(
    files: Path, tmp_path: Path, address: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    address = address.replace("DIR", str(tmp_path))
    plain = dataset(files, tmp_path)
    dataset(files, tmp_path / "maker", cache=address)  # another machine, with a cache of its own
    monkeypatch.setattr(capturing, "render_medium", lambda *a, **k: pytest.fail("rendered again"))
    data = dataset(files, tmp_path / "reader", cache=address)
    assert recorded(data).folder.path.name == recorded(plain).folder.path.name, "keyed alike"
    for i in range(0, len(plain.train), 5):
        a, b = plain.train.pixels(i), data.train.pixels(i)
        assert torch.equal(a.rgb, b.rgb) and torch.equal(a.alpha, b.alpha)
    clouds = [d.initial_points(50, torch.Generator().manual_seed(0)) for d in (plain, data)]
    assert torch.equal(clouds[0].means, clouds[1].means) and plain.exposure == data.exposure
    assert data.points is not None and plain.points is not None
    first = data.points.draw(20, torch.Generator().manual_seed(1))
    monkeypatch.setattr(capturing.Capture, "medium", lambda *a: pytest.fail("read again"))
    again = dataset(files, tmp_path / "third", cache=address)
    assert again.points is not None
    assert torch.equal(again.points.draw(20, torch.Generator().manual_seed(1)).sigma, first.sigma), (
        "voxels are kept there, too"
    )
    if address.startswith("memory"):
        import fsspec

        fsspec.filesystem("memory").rm("/neuprim-truth", recursive=True)


def test_damage_and_strange_files_are_refused_by_name(files: Path, tmp_path: Path) -> None:
    data = dataset(files, tmp_path)
    recording = recorded(data)
    frame = recording.folder.path / "frame_00002"
    image = recording.capture.fetch_image(recording.folder, recording.capture.frames[1], 0)
    image.write_bytes(image.read_bytes() + bytes(10**6))
    with pytest.raises(
        DataError, match=r"cam_00\.exr: 1,0\d\d,\d\d\d bytes; expected at most .*; delete the folder .*frame_00002"
    ):
        data.train.pixels(1)
    points = {"means": np.zeros((9, 2), np.float32), "colors": np.zeros((9, 3), np.float32)}
    np.savez(frame / "points.npz", **points, weight=1.0, brightest=np.float32(1))
    with pytest.raises(
        DataError, match=r"points\.npz: damaged \(means is float32 of shape \(9, 2\).*delete its folder"
    ):
        data.initial_points(50, torch.Generator().manual_seed(0))
    good = {
        "index": np.array([1, 5]),
        "values": np.ones((2, 4), np.float32),
        "shape": np.array([2, 2, 2]),
        "scene_from_index": np.eye(4),
    }
    np.savez(tmp_path / "voxels.npz", **good)
    assert len(MediumVoxels.read(tmp_path / "voxels.npz").index) == 2
    for change in (
        {"index": np.array([1, 8])},
        {"index": np.array([5, 1])},
        {"index": np.array([-1, 5])},
        {"index": np.array([1])},
        {"values": np.full((2, 4), np.nan, np.float32)},
        {"scene_from_index": np.full((4, 4), np.inf)},
    ):
        np.savez(tmp_path / "voxels.npz", **{**good, **change})
        with pytest.raises(DataError, match=r"voxels\.npz: damaged .*ascending places in it, and finite values"):
            MediumVoxels.read(tmp_path / "voxels.npz")


def test_memory_is_bounded_by_the_setting_whatever_the_length(files: Path, tmp_path: Path) -> None:
    def caches(data: Dataset) -> list[Any]:
        assert isinstance(data.train, FrameViews) and isinstance(data.test, FrameViews)
        assert isinstance(data.points, FrameVoxels)
        return [data.train._images, data.test._images, data.points._voxels]

    data = dataset(files, tmp_path, memory=1, size=96, cameras=9)
    train, test, voxels = caches(data)
    assert train._memory + test._memory + voxels._memory == pytest.approx(2**20)
    for views, cache in ((data.train, train), (data.test, test)):
        for i in range(len(views)):
            views.pixels(i)
        assert 0 < sum(image.nbytes for image in cache._items.values()) <= max(cache._memory, 96 * 96 * 8)
    assert len(train._items) < len(data.train)
    usual = [round(cache._memory) / 2**20 for cache in caches(dataset(files, tmp_path))]
    assert usual == [768, 128, 512]
