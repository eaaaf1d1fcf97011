"""Cosines have many sets of numbers; folding takes one of them, and nobody sees which."""

from __future__ import annotations

import math

import pytest
import torch

from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render
from tests import scenes
from tests.compressing import FIELDS, example

CONDITIONS = {
    "static": {},
    "dynamic": {"time": torch.tensor(0.37)},
    "relight": {"light": torch.tensor([1.0, 2.0, 3.0]), "light_intensity": torch.tensor([1.0])},
}


def folded(model: Primitives) -> Primitives:
    params = dict(model.params)
    for field in (model.density, model.colour):
        params |= field.canonicalize(model.of(field))
    return Primitives(model.density, model.colour, params)


@pytest.mark.parametrize("name", FIELDS)
def test_images_do_not_change(name: str) -> None:
    task, model = example(name)
    settings, camera = RenderSettings(backend="reference"), scenes.camera(24, 20)
    with torch.no_grad():
        a, b = (render(m, camera, CONDITIONS[task.name], settings) for m in (model, folded(model)))
    assert float(a.alpha.max()) > 0.1
    assert torch.allclose(a.rgb, b.rgb, atol=2e-5) and torch.allclose(a.alpha, b.alpha, atol=2e-5)


@pytest.mark.parametrize("name", FIELDS)
def test_folding_twice_changes_no_bit(name: str) -> None:
    once = folded(example(name, 300)[1])
    assert all(torch.equal(value, folded(once).params[key]) for key, value in once.params.items())


def test_numbers_lie_where_they_are_said_to() -> None:
    for name, rate, phase, weights in (
        ("static", 30.0, "b1", "w2"),
        ("dynamic", 30.0, "b1", "w2"),
        ("additive", 3.0, "net_phase", "net_out"),
    ):
        model = example(name, 500)[1]
        made = folded(model).params
        first = made[weights] if made[weights].dim() == 2 else made[weights][:, 0]
        assert float(first.min()) >= 0 and float(model.params[weights].min()) < 0
        assert float(made[phase].min()) >= 0 and float(made[phase].max()) <= math.pi / rate * (1 + 1e-5)
        assert float(model.params[phase].abs().max()) > math.pi / rate


def test_one_number_says_how_strong_a_density_without_neurons_is() -> None:
    model = example("volume", 300)[1]
    model.params["b2"][::3] *= -1.0
    made = folded(model).params
    assert set(made["b2"].flatten().tolist()) == {-1.0, 1.0} and len(model.params["b2"].unique()) > 200
    before, after = (p["b2"].double() * p["log_gain"].double().exp() for p in (model.params, made))
    assert torch.allclose(after, before, rtol=1e-6)
    for several in ("soft", "dynamic"):  # neurons, or terms in time, have strengths of their own
        whole = example(several)[1]
        assert torch.equal(folded(whole).params["log_gain"], whole.params["log_gain"])
