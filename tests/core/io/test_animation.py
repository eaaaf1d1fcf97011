"""Animations, also written frame by frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from neuprim.core.errors import DataError
from neuprim.core.io.images import FrameSpool, write_animation


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_animations_hold_their_frames_and_spools_write_the_same_bytes(tmp_path: Path, count: int, suffix: str) -> None:
    frames = [torch.full((12, 17, 3), i / 2) for i in range(count)]
    write_animation(tmp_path / f"whole{suffix}", frames, 10.0)
    spool = FrameSpool(tmp_path)
    for frame in frames:
        spool.add(frame)
    spool.write(tmp_path / f"spooled{suffix}", 10.0)
    assert (tmp_path / f"spooled{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2
    with Image.open(tmp_path / f"whole{suffix}") as film:
        assert film.size == (17, 12) and getattr(film, "n_frames", 1) == count
        for i in range(count):
            film.seek(i)
            assert abs(np.asarray(film.convert("RGB")).mean() - 127.5 * i) < 4
        assert count == 1 or (film.info["duration"] == 100 and film.info.get("loop") == 0)


def test_mp4_has_the_matrix_that_its_header_states(tmp_path: Path) -> None:
    av = pytest.importorskip("av", reason="MP4 needs neuprim[video]")
    color = np.array([0.9, 0.35, 0.1])
    write_animation(tmp_path / "a.mp4", [torch.from_numpy(color).float().expand(720, 1280, 3)] * 2, 24.0)
    with av.open(str(tmp_path / "a.mp4")) as film:
        frame, coded = next(film.decode(video=0)), film.streams.video[0].codec_context
        tags = (coded.colorspace, coded.color_primaries, coded.color_trc, coded.color_range)
    assert tags == (1, 1, 13, 1), "BT.709, transfer of sRGB, 16 to 235"
    luma = float(color @ (0.2126, 0.7152, 0.0722))
    blue, red = (color[2] - luma) / 1.8556, (color[0] - luma) / 1.5748
    planes = frame.to_ndarray()
    found = planes[:720].mean(), planes[720:900].mean(), planes[900:].mean()
    assert found == pytest.approx((16 + 219 * luma, 128 + 224 * blue, 128 + 224 * red), abs=2)


@pytest.mark.parametrize(
    ("name", "sizes", "fps", "words"),
    [
        ("a.avi", [2], 10.0, "expected .webp or .gif"),
        ("a.gif", [], 10.0, "0 frames"),
        ("a.gif", [2], 0.0, "positive rate"),
        ("a.gif", [2, 3], 10.0, "expected the same shape"),
    ],
)
def test_impossible_animations_are_refused(tmp_path: Path, name: str, sizes: list[int], fps: float, words: str) -> None:
    with pytest.raises(DataError, match=words):
        write_animation(tmp_path / name, [torch.zeros(n, 2, 3) for n in sizes], fps)
    with pytest.raises(DataError, match=f"{words}|has size \\(2, 3\\); expected \\(2, 2\\)"):
        spool = FrameSpool(tmp_path)
        for n in sizes:
            spool.add(torch.zeros(n, 2, 3))
        spool.write(tmp_path / name, fps)
    assert not list(tmp_path.iterdir())
