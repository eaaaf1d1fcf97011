"""Films that are made frame by frame are the files that all frames together make."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from neuprim.core.errors import DataError
from neuprim.core.io import images
from neuprim.core.io.reel import Reel


@pytest.mark.parametrize("count", [1, 2, 7])
@pytest.mark.parametrize("suffix", [".webp", ".gif"])
def test_the_same_bytes(tmp_path: Path, count: int, suffix: str) -> None:
    generator = torch.Generator().manual_seed(count)
    frames = [torch.rand((12, 17, 3), generator=generator) for _ in range(count)]
    images.write_animation(tmp_path / f"whole{suffix}", frames, 24.0)
    reel = Reel(tmp_path)
    for frame in frames:
        reel.add(frame)
    reel.write(tmp_path / f"reel{suffix}", 24.0)
    assert (tmp_path / f"reel{suffix}").read_bytes() == (tmp_path / f"whole{suffix}").read_bytes()
    assert len(list(tmp_path.iterdir())) == 2


def test_what_is_no_film(tmp_path: Path) -> None:
    reel = Reel(tmp_path)
    with pytest.raises(DataError, match=r"x\.webp: 0 frames"):
        reel.write(tmp_path / "x.webp", 24.0)
    reel.add(torch.zeros(4, 5, 3))
    with pytest.raises(DataError, match=r"frame 1 of a film is \(6, 4\); expected \(5, 4\), as the first"):
        reel.add(torch.zeros(4, 6, 3))
    with pytest.raises(DataError, match="unknown animation format"):
        reel.write(tmp_path / "x.avi", 24.0)
