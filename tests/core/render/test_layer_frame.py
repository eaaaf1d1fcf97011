"""What a frame's layers are made of, against every chord by brute force."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.errors import ConfigError
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import Constant, DensityField
from neuprim.core.model.gaussian import GaussianDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.core.render.layer_frame import COMMON, LayerFrame, LayerSpec, select_layers
from neuprim.tasks.static import SphericalHarmonics
from tests import scenes
from tests.chords import chords

COUNT = 14
CAMERA = scenes.camera(22, 17, distance=2.4, shift=(1.5, -2.0))
EXACT = RenderSettings(alpha_min=0.0, transmittance_min=0.0, alpha_max=0.9999)


def frame(settings: RenderSettings = EXACT, thick: float = 1.0, density: DensityField | None = None) -> LayerFrame:
    """Random primitives of ``thick`` times their usual density."""
    generator, t = torch.Generator().manual_seed(2), scenes.tensors(COUNT, 3, seed=4)
    density, colour = density or CosineDensity(3), SphericalHarmonics(1)
    params = {k: v for k, v in t.items() if k != "colors"}
    for spec in (*density.parameters(), *colour.parameters()):
        if spec.name not in params:
            params[spec.name] = 0.4 * torch.randn((COUNT, *spec.shape), generator=generator)
    names = {"means", "log_scales", "quats"} | {s.name for s in (*density.parameters(), *colour.parameters())}
    params = {k: v * thick if k in ("w2", "b2") else v for k, v in params.items() if k in names}
    return LayerFrame(Primitives(density, colour, params), CAMERA, {}, settings)


def off(found: Tensor, expected: Tensor) -> float:
    """Largest error as a part of the image's largest value."""
    return float((found.double() - expected).abs().max() / expected.abs().max())


@pytest.mark.parametrize("thick", [1.0, 40.0, 3000.0])
@pytest.mark.parametrize(
    "settings", [EXACT, RenderSettings(), RenderSettings(backend="reference")], ids=["exact", "usual", "reference"]
)
def test_the_density_integral_is_the_sum_of_whole_chords(thick: float, settings: RenderSettings) -> None:
    one = frame(settings, thick)
    tau = chords(one.lowered, CAMERA).tau.sum(0)
    assert tau.max() > thick / 4 and (tau == 0).any()
    assert thick == 1.0 or tau.max() > 10, "more than one primitive can absorb where it is clamped"
    assert off(one.integral(), tau) < 1e-5


def test_weights_and_code_of_a_density_of_its_own() -> None:
    weights = torch.rand(COUNT, generator=torch.Generator().manual_seed(1)) * (torch.arange(COUNT) % 3)
    for one in (frame(), frame(density=GaussianDensity())):
        tau = chords(one.lowered, CAMERA).tau
        assert tau.max() > 0.1
        assert off(one.integral(weights), (weights.double()[:, None, None] * tau).sum(0)) < 1e-5


def test_several_rays_per_pixel_are_averaged_as_depths_not_as_light() -> None:
    one = frame(replace(EXACT, samples=2), thick=40.0)
    tau = chords(one.lowered, CAMERA.resized(44, 34)).tau.sum(0).reshape(17, 2, 22, 2).mean((1, 3))
    assert off(one.integral(), tau) < 1e-5


def test_other_colours_depth_and_alpha() -> None:
    one = frame()
    found = chords(one.lowered, CAMERA)
    colours = torch.rand(COUNT, 5, generator=torch.Generator().manual_seed(3))
    seen = torch.einsum("nhw,nc->hwc", found.weight, colours.double())
    assert off(one.composite(Constant(colours)), seen) < 1e-5
    alpha = found.weight.sum(0)
    assert off(one.drawn.alpha, alpha) < 1e-5 and one.shading is None
    assert one.drawn.depth is not None
    depth = torch.where(alpha > 0, (found.weight * found.middle).sum(0) / alpha.clamp_min(1e-30), 0.0)
    clear = alpha > 1e-3  # a mean over next to nothing has no digits
    assert off(torch.where(clear, one.drawn.depth, 0.0), torch.where(clear, depth, 0.0)) < 1e-4


HEAT = LayerSpec("heat", "temperature, kelvin", lambda frame: None, ("K",))
GLOW = LayerSpec("glow", "light of the glow", lambda frame: None)
USUAL = ["beauty", "alpha", "depth", "density"]


def names(text: str | None, several: bool = False) -> list[str]:
    return [spec.name for spec in select_layers(text, (HEAT, GLOW), several)]


def test_all_without_a_word_and_in_one_order_with() -> None:
    assert [spec.name for spec in COMMON] == USUAL
    assert names(None) == [*USUAL, "heat", "glow"] and names(None, several=True) == [*USUAL, "glow"]
    assert names("glow, depth ,beauty") == ["beauty", "depth", "glow"]
    assert names("beauty,lights", several=True) == ["beauty"], "lights are drawn beside the others"


@pytest.mark.parametrize(
    ("text", "several"),
    [("depht", False), ("lights", False), ("heat", True), ("", False), (",", False), ("beauty depth", False)],
)
def test_other_names_are_refused_with_those_that_there_are(text: str, several: bool) -> None:
    with pytest.raises(ConfigError, match=r"--layers .*; expected some of beauty, alpha, depth, density, .*glow"):
        select_layers(text, (HEAT, GLOW), several)
