"""What images would lose: random signs against the change itself."""

from __future__ import annotations

from dataclasses import replace

import torch

from neuprim.core.data import Dataset
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import prunable_units_of_model
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import zero_units
from neuprim.core.render import RenderSettings, render
from neuprim.core.train.sensitivity import sensitivity
from neuprim.tasks.static import SphericalHarmonics
from tests.core import tiny
from tests.core.model.shaken import made

SETTINGS = RenderSettings(threads=1, alpha_min=0.0, transmittance_min=0.0)


def model() -> Primitives:
    """Twelve primitives whose colours are far from where they are cut at zero, so that bands are linear in them."""
    whole = made(CosineDensity(1, edge=2, gain=True), SphericalHarmonics(1), noise=0.1)
    small = Primitives(whole.density, whole.colour, whole.rows(torch.arange(12)))
    small.params["sh_dc"] = small.params["sh_dc"] * 0 + 4.0
    small.params["log_scales"] = small.params["log_scales"] * 0 - 1.2
    return small


def images(one: Primitives, dataset: Dataset, views: list[int]) -> torch.Tensor:
    with torch.no_grad():
        drawn = [dataset.train.view(i) for i in views]
        return torch.stack([render(one, v.camera, v.conditions, SETTINGS, dataset.background).rgb for v in drawn])


def test_signs_find_the_mean_squared_change_of_every_piece() -> None:
    one, dataset = model(), tiny.two_primitives()
    views = list(range(len(dataset.train)))[:4]
    whole = images(one, dataset, views)
    trials = [sensitivity(one, dataset, views, SETTINGS, seed) for seed in range(60)]
    pieces = prunable_units_of_model(one.density, one.colour)
    for name in ("colour.coefficient 1 -1, channel 0", "colour.coefficient 1 +0, channel 2"):
        found = torch.stack([t.pieces[name] for t in trials]).mean(0)
        for row in range(one.count):
            only = torch.arange(one.count) == row
            less = Primitives(one.density, one.colour, zero_units({"": (pieces[name], only)}, one.params))
            true = float((images(less, dataset, views) - whole).square().mean())
            assert abs(float(found[row]) - true) < 0.5 * true + 1e-9
    assert torch.isfinite(torch.stack([t.pieces["density.neuron 0"] for t in trials])).all()


def test_whole_primitives_count_by_the_squares_of_their_weights() -> None:
    """Its image, white among black ones on black, is its weights."""
    one, dataset = model(), tiny.two_primitives()
    views = list(range(len(dataset.train)))[:4]
    mean = torch.stack([sensitivity(one, dataset, views, SETTINGS, seed).whole for seed in range(60)]).mean(0)
    plain = {name: value for name, value in one.params.items() if name != "sh_rest"}
    for row in range(one.count):
        lit = torch.full((one.count, 3), -0.5 / 0.28209479177387814)  # black
        lit[row] = 0.5 / 0.28209479177387814  # white: its image is its weights
        weights = images(
            Primitives(one.density, SphericalHarmonics(0), {**plain, "sh_dc": lit}),
            replace(dataset, background=torch.zeros(3)),
            views,
        )
        true = float(weights.square().mean())
        assert abs(float(mean[row]) - true) < 0.5 * true + 1e-9


def test_columns_are_the_mean_squared_change_by_independent_amounts() -> None:
    """Numbers of one parameter move at random by little; quaternions turn by as much whatever their norm."""
    one, dataset = model(), tiny.two_primitives()
    one.params["quats"] = one.params["quats"] * torch.linspace(0.2, 5.0, one.count)[:, None]
    one.params["log_scales"] = one.params["log_scales"] + torch.tensor([0.4, 0.0, -0.4])
    views = list(range(len(dataset.train)))[:4]
    whole = images(one, dataset, views)
    trials = [sensitivity(one, dataset, views, SETTINGS, seed).columns for seed in range(80)]
    generator = torch.Generator().manual_seed(1)
    for name, size in (("log_scales", 1e-3), ("sh_dc", 1e-3), ("means", 1e-4), ("quats", 1e-3), ("log_gain", 1e-3)):
        value = one.params[name]
        found = float(torch.stack([t[name] for t in trials]).mean(0).sum())
        changes = []
        for _ in range(40):
            amount = size * torch.randn(value.shape, generator=generator)
            moved = value + amount
            if name == "quats":
                unit = value / value.norm(dim=1, keepdim=True)
                moved = value + (amount - (amount * unit).sum(1, keepdim=True) * unit) * value.norm(dim=1, keepdim=True)
            changed = Primitives(one.density, one.colour, {**one.params, name: moved})
            changes.append(float((images(changed, dataset, views) - whole).square().mean()) / size**2)
        true = sum(changes) / len(changes)
        assert abs(found - true) < 0.3 * true, name


def test_effects_beside_others_are_weighted_sums() -> None:
    one, dataset = model(), tiny.two_primitives()
    a, b = (sensitivity(one, dataset, [view], SETTINGS) for view in (0, 1))
    both = a.combine(b, 3.0)
    assert torch.allclose(both.whole, a.whole + 3 * b.whole) and torch.equal(both.seen, a.seen + b.seen)
    assert all(torch.allclose(both.pieces[n], a.pieces[n] + 3 * b.pieces[n]) for n in a.pieces)
    assert all(torch.allclose(both.columns[n], a.columns[n] + 3 * b.columns[n]) for n in a.columns)
