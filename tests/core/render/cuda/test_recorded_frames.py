"""Recorded frames, run here on Warp's CPU blocks without a graph: the bits of frames that are not recorded."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.compute import device
from neuprim.core.errors import FormError, NonFiniteError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderOutput, RenderSettings, render
from neuprim.core.render.cuda import binning, recorded_frames
from neuprim.core.render.cuda.recorded_frames import FrameRecorder, frame_recorder
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.static import SphericalHarmonics
from tests import scenes

pytestmark = pytest.mark.filterwarnings("ignore:renderer.backend=cuda is slow on the cpu")
SETTINGS = RenderSettings(backend="cuda", device="cpu", near=0.1, depth=True)
GREY = torch.full((3,), 0.5)


def scene(count: int = 40, timed: bool = False) -> Primitives:
    t = scenes.tensors(count, 2, seed=3)
    params = {name: t[name].detach() for name in ("means", "log_scales", "quats", "W1", "b1", "w2")}
    colours = {"sh_dc": t["colors"].detach(), "sh_rest": 0.1 * torch.randn(count, 3, 3)}
    if timed:
        colours["time_poly"] = torch.randn(count, 1, 3)
    colour = TimeHarmonics(1, powers=1, waves=0) if timed else SphericalHarmonics(1)
    return Primitives(CosineDensity(2, edge=1), colour, {**params, "b2": t["b2"].detach().reshape(-1, 1), **colours})


@pytest.fixture
def recorder(monkeypatch: pytest.MonkeyPatch) -> list[FrameRecorder]:
    """Every model is recorded; holds the recorders."""
    found: list[FrameRecorder] = []

    def own(model: Primitives, camera: object, settings: RenderSettings) -> FrameRecorder:
        found.append(frame_recorder(model))
        return found[-1]

    monkeypatch.setattr("neuprim.core.render._frame_recorder", own)
    monkeypatch.setattr(device, "on_numba", lambda *tensors: False)
    monkeypatch.setattr(device, "on_warp", lambda *tensors: True)
    return found


def drawn(model: Primitives, distance: float, **conditions: torch.Tensor) -> RenderOutput:
    with torch.no_grad():
        return render(model, scenes.camera(32, 32, distance=distance), conditions, SETTINGS, GREY)


def assert_same(one: RenderOutput, other: RenderOutput) -> None:
    assert torch.equal(one.rgb, other.rgb) and torch.equal(one.alpha, other.alpha)
    assert one.depth is not None and other.depth is not None and torch.equal(one.depth, other.depth)


@pytest.mark.parametrize("distances", [(2.0, 2.2, 1.8, 2.1), (0.4, 0.5, 0.45, 2.0)], ids=["far", "with float64"])
def test_a_replayed_frame_has_the_bits_of_any_other(
    distances: tuple[float, ...], recorder: list[FrameRecorder], monkeypatch: pytest.MonkeyPatch
) -> None:
    model = scene()
    found = [drawn(model, distance) for distance in distances]
    assert recorder[-1].replayed >= 2
    before = recorder[-1].replayed
    monkeypatch.setattr("neuprim.core.render._frame_recorder", lambda *frame: None)
    for output, distance in zip(found, distances, strict=True):
        assert_same(output, drawn(model, distance))
    assert recorder[-1].replayed == before


def test_conditions_and_changed_parameters_are_seen(recorder: list[FrameRecorder]) -> None:
    model = scene(timed=True)
    first, *_, later = [drawn(model, 2.0, time=torch.tensor(time)) for time in (0.2, 0.2, 0.2, 0.9)]
    assert recorder[-1].replayed == 2 and not torch.equal(first.rgb, later.rgb)
    model.params["sh_dc"] += 1.0
    assert float(drawn(model, 2.0, time=torch.tensor(0.9)).rgb.mean()) > float(later.rgb.mean()) + 0.05
    assert recorder[-1].replayed == 3
    model.params = {name: value.clone() for name, value in model.params.items()}
    assert_same(drawn(model, 2.0, time=torch.tensor(0.2)), drawn(model, 2.0, time=torch.tensor(0.2)))


def test_a_frame_that_does_not_fit_is_rendered_again(
    recorder: list[FrameRecorder], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(binning, "_MARGIN", 1.0)
    monkeypatch.setattr(binning, "_SPARE", 0)
    model = scene()
    far, _, _ = (drawn(model, 8.0) for _ in range(3))
    assert recorder[-1].replayed == 1
    near = drawn(model, 2.0)
    assert recorder[-1].replayed == 1 and near.stats.pairs > far.stats.pairs
    monkeypatch.setattr("neuprim.core.render._frame_recorder", lambda *frame: None)
    assert_same(near, drawn(model, 2.0))


def test_errors_are_those_of_any_frame(recorder: list[FrameRecorder]) -> None:
    model = scene()
    for _ in range(3):
        drawn(model, 2.0)
    assert recorder[-1].replayed == 1
    camera = scenes.camera(32, 32, distance=2.0)
    with torch.no_grad(), pytest.raises(FormError, match="background"):
        render(model, camera, {}, SETTINGS, torch.zeros(4))
    model.params["means"][7] = torch.nan
    with pytest.raises(NonFiniteError, match="means of primitive 7"):
        drawn(model, 2.0)
    model.params["means"][7] = 0.0
    assert bool(drawn(model, 2.0).rgb.isfinite().all())


def test_frames_are_not_recorded_where_they_may_differ() -> None:
    model, camera = scene(), scenes.camera(32, 32, distance=2.0)
    can = recorded_frames.can_record_frame
    with torch.no_grad():
        assert can(model, camera, SETTINGS) and not can(model, camera, replace(SETTINGS, sort="entry"))
        assert not can(model, camera, replace(SETTINGS, near="auto"))
        model.density.stage = None
        assert not can(model, camera, SETTINGS)
    assert not can(scene(), camera, SETTINGS), "with gradients"
