"""Shadows as layers, against every chord by brute force."""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.model.fields import RayNet
from neuprim.core.render import RenderSettings
from neuprim.core.render.draw import unproject_depth
from neuprim.core.render.layer_frame import LayerFrame
from neuprim.tasks.relight import TASK
from neuprim.tasks.relight.colour import LightHarmonics, LightNetwork
from neuprim.tasks.relight.visibility import light_visibility
from tests import scenes
from tests.chords import chords
from tests.lit_models import light, model

CAMERA = scenes.camera(20, 16, distance=2.6)
EXACT = RenderSettings(alpha_min=0.0, transmittance_min=0.0, alpha_max=0.9999)


def frame(colour: LightNetwork | LightHarmonics) -> LayerFrame:
    return LayerFrame(model(colour, torch.float32), CAMERA, light(1.5, -2.0, 2.0), EXACT)


def layers(one: LayerFrame) -> dict[str, Tensor | None]:
    return {spec.name: spec.draw(one) for spec in TASK.layers}


def test_shadows_of_primitives() -> None:
    one = frame(LightNetwork(3, visibility="primitive"))
    found, drawn = chords(one.lowered, CAMERA), layers(one)
    geometry, density = one.lowered.geometry, one.lowered.density
    V = light_visibility(geometry, density, one.conditions["light"], EXACT)(geometry.means).double()
    assert V.min() < 0.7 < V.max()
    alpha = found.weight.sum(0)
    expected = torch.where(alpha > 0, torch.einsum("nhw,n->hw", found.weight, V) / alpha.clamp_min(1e-30), 0.0)
    clear = alpha > 1e-3
    visibility, unshadowed = drawn["visibility"], drawn["unshadowed"]
    assert visibility is not None and unshadowed is not None
    assert (
        (visibility - expected)[clear].abs().max() < 1e-4
        and visibility.max() <= 1
        and (visibility[alpha == 0] == 0).all()
    )
    plain = LayerFrame(model(LightNetwork(3, visibility="none"), torch.float32), CAMERA, one.conditions, EXACT)
    assert isinstance(plain.lowered.colour, RayNet)
    assert (unshadowed - plain.drawn.rgb).abs().max() < 1e-5 and (unshadowed - one.drawn.rgb).abs().max() > 0.01


def test_shadows_of_pixels_multiply() -> None:
    one = frame(LightNetwork(3, visibility="pixel"))
    drawn = layers(one)
    visibility, unshadowed = drawn["visibility"], drawn["unshadowed"]
    assert visibility is not None and unshadowed is not None and one.drawn.depth is not None
    assert visibility[one.drawn.alpha > 0].min() < 0.6
    assert (unshadowed * visibility[..., None] - one.drawn.rgb).abs().max() < 1e-5
    V = light_visibility(one.lowered.geometry, one.lowered.density, one.conditions["light"], EXACT)
    expected = V(unproject_depth(one.drawn.depth, CAMERA).reshape(-1, 3)).reshape(visibility.shape)
    assert (visibility - torch.where(one.drawn.alpha > 0, expected, 0.0)).abs().max() < 1e-6
