"""Lights, images and losses at their extremes: the kernels against float64 autograd through the whole field, and
training that survives."""

from __future__ import annotations

import math
from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core.data import Pixels, View
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import RayNet
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.light import normalize_direction
from neuprim.core.train.initial_model import initial_model_to_train
from neuprim.core.train.losses import compressed_loss, l1, relative_loss
from neuprim.core.train.settings import ModelSettings, PopulationSettings, TrainSettings
from neuprim.core.train.trainer import Trainer
from neuprim.tasks.relight.colour import LightHarmonics, LightNetwork
from neuprim.tasks.relight.surface import SurfaceColour
from tests import scenes
from tests.core import tiny
from tests.numerics.equivalence import row_errors, undecided, weights

LOSSES = {"l1": l1, "compressed": compressed_loss, "relative": relative_loss}
COUNT = 20
UNSHADOWED, SHADOWED = "none", "pixel"  # LightNetwork's ``visibility``
Field = LightNetwork | LightHarmonics | SurfaceColour


def model(field: Field, dtype: torch.dtype = torch.float32) -> Primitives:
    g = torch.Generator().manual_seed(5)
    t = {k: v for k, v in scenes.tensors(COUNT, 3, seed=3).items() if k != "colors"}
    t |= {s.name: 0.5 * torch.randn((COUNT, *s.shape), generator=g) for s in field.parameters()}
    if "c_dc" in t:
        t["c_dc"] = t["c_dc"].abs() + 0.3
    return Primitives(CosineDensity(3), field, {k: v.to(dtype).requires_grad_() for k, v in t.items()})


def eye() -> Tensor:
    return scenes.camera().position.float()


LIGHTS: dict[str, Tensor] = {
    "near a centre": torch.tensor([1e-3, 0.0, 0.0]),
    "inside": torch.tensor([0.05, 0.02, -0.03]),
    "below the ground": torch.tensor([0.3, 0.2, -5.0]),
    "behind the camera": 10 * eye(),
    "behind everything": -4 * eye(),
    "in the camera": eye(),
    "1e6 away": torch.tensor([6e5, -3e5, 7e5]),
    "1e12 away": torch.tensor([6e11, -3e11, 7e11]),
    "1e18 away": torch.tensor([6e17, -3e17, 7e17]),
}


def picture(
    m: Primitives, backend: str, conditions: dict[str, Tensor], keep: Tensor
) -> tuple[Tensor, dict[str, Tensor]]:
    out = render(m, scenes.camera(33, 25), conditions, RenderSettings(backend=backend))
    (out.rgb * (weights((25, 33, 3), 0) * keep[..., None]).to(out.rgb.dtype)).sum().backward()
    return out.rgb.detach().double(), {k: v.grad for k, v in m.params.items() if v.grad is not None}


@pytest.mark.parametrize("name", LIGHTS)
@pytest.mark.parametrize(
    ("form", "falloff"),
    [("additive", True), ("multiplicative", False), ("H=0", True), ("harmonics", False), ("surface", True)],
)
def test_kernels_equal_float64_under_any_light(form: str, falloff: bool, name: str) -> None:
    """Image within 1e-5 of the colours' size, every parameter's gradient within 1e-3 of its row, as in the tests of
    RayNet alone."""
    if form == "harmonics":
        field: Field = LightHarmonics(3, 3, falloff)
    elif form == "surface":
        field = SurfaceColour(visibility=UNSHADOWED, falloff=falloff)
    else:
        hidden, kind = (0, "additive") if form == "H=0" else (5, form)
        field = LightNetwork(hidden, form=kind, visibility=UNSHADOWED, falloff=falloff)
    fast, slow = model(field), model(field, torch.float64)
    where = LIGHTS[name] + (fast.params["means"][3].detach() if name == "near a centre" else 0)
    power = float(where.norm().square()) if falloff else 1.0  # so that something is seen
    c = {"light": where, "light_intensity": torch.tensor([1.0, 0.6, 0.3]) * power}
    camera = scenes.camera(33, 25)
    lowered = slow.lower(camera, c)
    names = ("means", "log_scales", "quats", "W1", "b1", "w2", "b2")
    values = {name: slow.params[name].detach() for name in names}
    if isinstance(lowered.colour, RayNet):
        values |= {k: getattr(lowered.colour, k).detach() for k in ("Wx", "bias", "Wout", "base")}
        size = float((lowered.colour.base.abs() + lowered.colour.Wout.abs().sum(-1)).detach().max())
    else:
        values["colors"] = lowered.colour.rgb.detach()  # type: ignore[union-attr]
        size = float(values["colors"].max())
    skip = undecided(values, camera, RenderSettings())
    assert skip.float().mean() < 0.05
    keep = (~skip).double()
    (fast_image, fast_grads), (image, grads) = picture(fast, "cpu", c, keep), picture(slow, "reference", c, keep)
    assert image.max() > 0.05 * min(size, 1.0) and all(bool(torch.isfinite(x).all()) for x in (fast_image, image))
    assert float((fast_image - image).abs()[~skip].max()) < 1e-5 * max(size, 1.0)
    for key, expected in grads.items():
        assert float(row_errors(fast_grads[key], expected).max()) < 1e-3, key


@pytest.mark.parametrize("visibility", [UNSHADOWED, SHADOWED])
@pytest.mark.parametrize("falloff", [False, True])
@pytest.mark.parametrize("distance", [1e6, 1e12, 1e18])
def test_lights_at_infinity_have_finite_gradients(distance: float, falloff: bool, visibility: str) -> None:
    m = model(LightNetwork(4, visibility=visibility, falloff=falloff))
    c = {
        "light": distance * torch.tensor([0.6, -0.3, 0.7]),
        "light_intensity": torch.full((3,), distance**2 if falloff else 1.0),
    }
    out = render(m, scenes.camera(), c)
    assert bool(torch.isfinite(out.rgb).all()) and out.rgb.max() > 0.05
    out.rgb.sum().backward()
    assert all(bool(torch.isfinite(v.grad).all()) for v in m.params.values() if v.grad is not None)


@pytest.mark.parametrize(
    "field", [LightNetwork(4, visibility=UNSHADOWED), LightHarmonics(3, 3), SurfaceColour(visibility=UNSHADOWED)]
)
def test_a_distant_light_is_a_direction(field: Field) -> None:
    m = model(field)
    images = []
    for distance in (1e6, 1e9, 1e18):
        c = {"light": distance * torch.tensor([0.6, -0.3, 0.7]), "light_intensity": torch.ones(3)}
        with torch.no_grad():
            images.append(render(m, scenes.camera(), c).rgb)
    assert images[0].max() > 0.1
    assert all(torch.allclose(images[0], other, atol=2e-5) for other in images[1:])


def test_shadows_only_darken_whatever_the_light() -> None:
    shadowed, plain = (model(LightNetwork(0, visibility=v)) for v in (SHADOWED, UNSHADOWED))
    means = plain.params["means"].detach()
    for where in (*LIGHTS.values(), torch.zeros(3), means[3], means.mean(0)):
        c = {"light": where, "light_intensity": torch.ones(3)}
        with torch.no_grad():
            dark, bright = (render(m, scenes.camera(33, 25), c).rgb for m in (shadowed, plain))
        assert bright.max() > 0.2 and bool(((dark >= 0) & (dark <= bright + 1e-6)).all()), where


def test_directions_at_zero_and_at_infinity() -> None:
    v = torch.tensor(
        [[0.0, 0, 0], [1e-30, 0, 0], [1e-6, 0, 0], [3.0, 4.0, 0.0], [3e30, 4e30, 0.0], [0.0, -1e38, 0.0]]
    ).requires_grad_()
    found = normalize_direction(v)
    assert torch.allclose(
        found, torch.tensor([[0.0, 0, 0], [0, 0, 0], [1, 0, 0], [0.6, 0.8, 0], [0.6, 0.8, 0], [0, -1, 0]]), atol=1e-6
    )
    (found * torch.tensor([1.0, -2.0, 3.0])).sum().backward()
    assert v.grad is not None and bool(torch.isfinite(v.grad).all()) and float(v.grad.abs().max()) < 1e7
    w = torch.randn(5, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0)).requires_grad_()
    assert torch.autograd.gradcheck(normalize_direction, (w,))


# ---------------------------------------------------------------- training


class Lit(tiny.Views):
    """The two known primitives under a light each; ``change(index, rgb)`` edits the images in place."""

    def __init__(self, count: int, start: float, change: Any, intensity: float) -> None:
        super().__init__(count, start)
        self.intensity = intensity
        for i, pixels in enumerate(self.images):
            rgb = pixels.rgb.clone()
            change(i, rgb)
            self.images[i] = Pixels(rgb, pixels.alpha)

    def view(self, index: int) -> View:
        light = torch.tensor([2.0 * math.cos(index), 2.0 * math.sin(index), 3.0])
        return View(
            f"v{index}", self.cameras[index], {"light": light, "light_intensity": torch.full((3,), self.intensity)}
        )


def fit(
    loss: str, change: Any, iterations: int = 60, intensity: float = 1.0, start: Primitives | None = None
) -> tuple[Trainer, list[float]]:
    dataset = tiny.two_primitives(train=Lit(6, 0.0, change, intensity), background=torch.zeros(3), color_space="linear")
    field = LightNetwork(3, visibility=UNSHADOWED)
    first = start or initial_model_to_train(
        CosineDensity(2), field, dataset, ModelSettings(primitives=12, neurons=2), 0
    )
    settings = TrainSettings(iterations=iterations, population=PopulationSettings(strategy="fixed"))
    trainer = Trainer(first, dataset, LOSSES[loss]({}), settings, RenderSettings(backend="reference"), 0)
    return trainer, [report.loss for report in trainer.run()]


def blacken(index: int, rgb: Tensor) -> None:
    rgb.zero_()


@pytest.mark.parametrize("loss", LOSSES)
def test_training_survives_dark_images(loss: str) -> None:
    """Black images make a black model, which can still learn that there is light."""
    trainer, values = fit(loss, blacken)
    trainer.model.check_finite()
    assert all(math.isfinite(v) for v in values) and values[-1] < 0.5 * values[0]
    again, later = fit(loss, lambda i, rgb: None, 120, start=trainer.model)
    again.model.check_finite()
    assert sum(later[-6:]) < 0.8 * sum(later[:6]), "black stayed black"


@pytest.mark.parametrize("loss", LOSSES)
def test_training_survives_highlights(loss: str) -> None:
    def gleam(index: int, rgb: Tensor) -> None:
        rgb[12, 12] = 1e4

    trainer, values = fit(loss, gleam)
    trainer.model.check_finite()
    assert all(math.isfinite(v) for v in values)
    view = trainer.dataset.train.view(0)
    with torch.no_grad():
        image = render(trainer.model, view.camera, view.conditions, RenderSettings(backend="reference")).rgb
    assert bool(torch.isfinite(image).all()) and image.max() > 0.05


def test_harmonics_know_the_direction_of_any_light() -> None:
    m = model(LightHarmonics(3, 3))
    lights = ({"light": d * torch.tensor([0.6, -0.3, 0.7]), "light_intensity": torch.ones(3)} for d in (1e6, 1e30))
    with torch.no_grad():
        near, far = (render(m, scenes.camera(), c).rgb for c in lights)
    assert near.max() > 0.1 and torch.allclose(near, far, atol=2e-5)
