"""Emission and absorption of a volume, against every chord by brute force."""

from __future__ import annotations

import torch

from neuprim.core.render import RenderSettings
from neuprim.core.render.layer_frame import LayerFrame
from neuprim.tasks.dynamic import TASK
from tests import scenes
from tests.chords import chords
from tests.timed_models import model

CAMERA = scenes.camera(20, 16, distance=2.6)


def test_beauty_is_what_is_emitted_less_what_is_absorbed() -> None:
    settings = RenderSettings(alpha_min=0.0, transmittance_min=0.0, alpha_max=0.9999)
    frame = LayerFrame(
        model("window+motion", count=16, dtype=torch.float32), CAMERA, {"time": torch.tensor(0.4)}, settings
    )
    found = chords(frame.lowered, CAMERA)
    colours = frame.lowered.colour.flat
    assert colours is not None and colours.min() >= 0
    emitted = torch.einsum("nhw,nc->hwc", found.tau, colours.double())
    arrived = torch.einsum("nhw,nc->hwc", found.weight, colours.double())
    layers = {spec.name: spec.draw(frame) for spec in TASK.layers}
    assert list(layers) == ["emission", "absorption"] and all(spec.light for spec in TASK.layers)
    assert (layers["emission"] - emitted).abs().max() < 1e-5 * emitted.max()
    assert (layers["absorption"] - (emitted - arrived)).abs().max() < 1e-5 * emitted.max()
    assert (layers["emission"] - layers["absorption"] - arrived).abs().max() < 1e-5 * emitted.max()
    assert (emitted - arrived).max() > 0.05 * emitted.max(), "something is absorbed"
