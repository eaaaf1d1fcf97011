"""The ground truth of volumes by the kernels of a card, on Warp's CPU blocks."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch

pytest.importorskip("warp", reason="the kernels of a card are written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.cameras import Camera
from neuprim.core.compute import device
from neuprim.core.data.dataset import SceneContext
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.tasks.dynamic.time_density import TimeDensity
from neuprim.tasks.dynamic.volume.capture_density import compare_capture_extinction
from neuprim.tasks.dynamic.volume.raymarch import render_medium
from neuprim.tasks.dynamic.volume.volume_scene import open_volume_source
from neuprim.tasks.static import SphericalHarmonics
from tests.tasks.dynamic.sequences import dataset, recorded, write_blobs
from tests.tasks.dynamic.volumes import camera, ragged


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return write_blobs(tmp_path / "files", {number: 6.0 + 3 * number for number in (1, 2, 3)})


def on_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "has_warp", lambda where: True)


def test_a_sequence_is_the_processors_and_lies_in_a_folder_of_its_own(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a light, glow and shadows; within the half floats that images are stored in."""
    light = {"direction": [0.3, -0.5, 0.8], "irradiance": [3.0, 3.0, 3.0]}
    changes = {"size": 32, "samples": 2, "optics": {"light": light}}
    own = dataset(folder, tmp_path, **changes)
    with monkeypatch.context() as patch:
        on_blocks(patch)
        other = dataset(folder, tmp_path, **changes)
        again = dataset(folder, tmp_path / "again", **changes)
    mine, theirs = (Path(recorded(data).folder.address) for data in (own, other))
    assert mine != theirs and mine.parent == theirs.parent
    assert own.exposure == pytest.approx(other.exposure, rel=1e-3)
    for i in range(len(own.test)):
        mine, theirs, rerun = (data.test.pixels(i) for data in (own, other, again))
        assert mine.alpha is not None and theirs.alpha is not None
        assert float(mine.alpha.max()) > 0.3
        assert torch.allclose(mine.rgb, theirs.rgb, rtol=2e-3, atol=1e-4)
        assert torch.allclose(mine.alpha, theirs.alpha, rtol=2e-3, atol=1e-4)
        assert torch.equal(theirs.rgb, rerun.rgb) and torch.equal(theirs.alpha, rerun.alpha)  # type: ignore[arg-type]


def test_pixels_do_not_depend_on_those_beside_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nor on which comes first: any part of an image has the bits of the whole."""
    on_blocks(monkeypatch)
    medium, view = ragged(3), camera((2.0, 1.0, 1.5), 24)
    whole = render_medium(medium, view, 2)
    part = Camera(view.viewmat, view.fx, view.fy, view.cx, view.cy - 9, view.width, 7)
    assert bool(whole[9:16].any()) and torch.equal(render_medium(medium, part, 2), whole[9:16])


def test_errors_of_a_model_are_the_processors(folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    settings = {"vdb": str(folder), "size": 24, "cameras": 4, "look": "smoke_fire"}
    capture = open_volume_source(settings, SceneContext(0, tmp_path)).capture
    generator = torch.Generator().manual_seed(0)
    means = 0.4 * torch.rand(30, 3, generator=generator) - 0.2
    times = {"time": torch.rand(30, generator=generator)}
    made = InitContext(means, torch.full((30,), 0.15), torch.zeros(30, 3), generator, conditions=times)
    model = Primitives.initialise(TimeDensity(2, "window+motion"), SphericalHarmonics(0), made)
    wanted = compare_capture_extinction(model, capture, [0.0, 0.5, 1.0])
    on_blocks(monkeypatch)
    found = compare_capture_extinction(model, replace(capture), [0.0, 0.5, 1.0])
    assert len(wanted["sigma_frames"]) == 3 and abs(wanted["sigma_correlation_middle"]) > 0.05
    del wanted["sigma_frames"], found["sigma_frames"]
    assert found == pytest.approx(wanted, rel=1e-5)
