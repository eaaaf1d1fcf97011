"""The data set that Mitsuba path traces, where it is installed."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from neuprim.core.task import SceneContext
from neuprim.tasks.relight.datasets import load_olat

ROOT = Path(__file__).parents[2]


def test_its_images_show_the_solids_under_their_lights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("mitsuba", reason="path tracing needs neuprim[path-tracing]")
    monkeypatch.syspath_prepend(str(ROOT / "benchmarks"))
    from path_traced import PathTracedSettings, write_images

    folder = tmp_path / "traced"
    folder.mkdir()
    write_images(folder, PathTracedSettings(size=40, train=6, test=3, samples=16))
    found = load_olat({"path": str(folder), "falloff": "inverse_square"}, SceneContext(0, tmp_path))
    assert (len(found.train), len(found.test)) == (6, 3)
    for i in range(6):
        pixels = found.train.pixels(i)
        assert pixels.alpha is not None and 0.15 < float(pixels.alpha.mean()) < 0.9
        assert float(pixels.rgb.max()) > 0.2 and not pixels.rgb[pixels.alpha == 0].any()
    bright = torch.stack([found.train.pixels(i).rgb.mean() for i in range(6)])
    assert 0.005 < float(bright.min()) and float(bright.max()) < 0.5
