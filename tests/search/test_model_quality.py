"""Which held-out views models are compared on, and volumes that are known inside: what images do not show counts."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch

from neuprim.core.data import Dataset, PointSamples, PointSupervision
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.core.train.sensitivity import inner_sensitivity, sensitivity
from neuprim.core.volumes.points import volume_values_at
from neuprim.search.model_quality import SearchQuality, choose_trial_views, fill_masked
from neuprim.search.pruning_cuts import cut_to_loss, price_cuts
from neuprim.tasks.static import SphericalHarmonics
from tests.core import tiny


@pytest.mark.parametrize(
    ("asked", "found"),
    [(2, ["v0", "v3"]), (3, ["v0", "v2", "v4"]), (6, [f"v{i}" for i in range(6)]), (9, [f"v{i}" for i in range(6)])],
)
def test_evenly_spread_and_all_where_more_are_asked_for(asked: int, found: list[str]) -> None:
    dataset = tiny.two_primitives()
    assert [truth.view.name for truth in choose_trial_views(replace(dataset, test=dataset.train), asked)] == found


def test_none_of_no_views_and_over_the_background() -> None:
    dataset = tiny.two_primitives()
    assert choose_trial_views(replace(dataset, test=tiny.Views(0, 0.0)), 4) == []
    assert torch.equal(choose_trial_views(dataset, 1)[0].image, dataset.test.pixels(0).over(dataset.background))


def test_where_pixels_do_not_count_the_truth_stands() -> None:
    dataset = tiny.two_primitives()
    mask = torch.zeros(tiny.SIZE, tiny.SIZE, dtype=torch.bool)
    mask[3, 4] = True
    dataset.test.images = [replace(pixels, mask=mask) for pixels in dataset.test.images]  # type: ignore[attr-defined]
    truth = choose_trial_views(dataset, 1)[0]
    drawn = fill_masked(torch.full_like(truth.image, 7.0), truth)
    assert drawn[3, 4].tolist() == [7.0] * 3 and torch.equal(drawn[4:], truth.image[4:])


# ---------------------------------------------------------------- inside volumes

SETTINGS = RenderSettings(threads=1)


def hidden() -> Primitives:
    """An opaque ball, and ten smaller ones inside that no image shows."""
    generator = torch.Generator().manual_seed(2)
    means = torch.cat([torch.zeros(1, 3), 0.3 * (torch.rand(10, 3, generator=generator) - 0.5)])
    sizes = torch.tensor([[0.9]] + [[0.15]] * 10).expand(11, 3)
    params = {
        "means": means,
        "log_scales": sizes.log(),
        "quats": torch.tensor([[1.0, 0.0, 0.0, 0.0]]).repeat(11, 1),
        "W1": torch.zeros(11, 0, 3),
        "b1": torch.zeros(11, 0),
        "w2": torch.zeros(11, 0),
        "b2": torch.tensor([[60.0]] + [[20.0]] * 10),
        "sh_dc": torch.zeros(11, 3),
    }
    return Primitives(CosineDensity(0, edge=2), SphericalHarmonics(0), params)


class Known(PointSupervision):
    """Extinction of a model, in frames of the names that are given."""

    def __init__(self, model: Primitives, names: tuple[str, ...] = ("a", "b", "c")) -> None:
        self.model, self.names = model, names

    def draw(self, count: int, generator: torch.Generator) -> PointSamples:
        name = self.names[int(torch.randint(len(self.names), (), generator=generator))]
        points = 0.5 * (torch.rand(count, 3, generator=generator) - 0.5)
        with torch.no_grad():
            sigma = volume_values_at(self.model, {}, points, False, 1).sigma
        return PointSamples(name, {}, points, sigma, None, float(sigma.max()))


def known() -> tuple[Primitives, Dataset]:
    model = hidden()
    return model, tiny.two_primitives(points=Known(model))


def without(model: Primitives, rows: list[int]) -> Primitives:
    kept = torch.tensor([i for i in range(model.count) if i not in rows])
    return Primitives(model.density, model.colour, model.rows(kept))


def test_frames_decide_once_each() -> None:
    _, dataset = known()
    assert [draw.name for draw in SearchQuality(dataset, SETTINGS, inside=True).draws] == ["a", "b", "c"]
    assert SearchQuality(dataset, SETTINGS).draws == []


def test_what_is_lost_inside_counts_as_what_is_lost_in_images() -> None:
    model, dataset = known()
    off = Primitives(model.density, model.colour, {**model.params, "b2": 1.01 * model.params["b2"]})
    quality = SearchQuality(dataset, SETTINGS, inside=True)
    start = quality(off)
    assert start == pytest.approx(quality.image_quality(off))
    less = without(off, [3, 4])
    assert abs(quality.image_quality(less) - quality.image_quality(off)) < 0.01  # no image shows them
    assert quality(less) < start - 3.0
    assert quality(less) == pytest.approx(start + quality.inside_quality(less) - quality.inside_quality(off))
    worse = Primitives(model.density, model.colour, {**off.params, "sh_dc": off.params["sh_dc"] - 1.0})
    assert quality(worse) == pytest.approx(quality.image_quality(worse))  # inside nothing changed


def test_inside_the_signs_find_each_primitive_s_share() -> None:
    model, dataset = known()
    draws = SearchQuality(dataset, SETTINGS, inside=True).draws
    found = torch.stack([inner_sensitivity(model, draws, seed, 1).whole for seed in range(40)]).mean(0)
    for row in range(model.count):
        true = 0.0
        for samples in draws:
            with torch.no_grad():
                both = [volume_values_at(m, {}, samples.points, False, 1).sigma for m in (model, without(model, [row]))]
            true += float(((both[0] - both[1]) / samples.sigma_scale).square().mean()) / len(draws)
        assert math.isclose(float(found[row]), true, rel_tol=0.5)


def test_primitives_that_no_image_shows_go_only_where_nothing_is_known_inside() -> None:
    model, dataset = known()
    seen = sensitivity(model, dataset, list(range(len(dataset.train))), SETTINGS)
    plain, quality = SearchQuality(dataset, SETTINGS), SearchQuality(dataset, SETTINGS, inside=True)
    off = Primitives(model.density, model.colour, {**model.params, "b2": 1.01 * model.params["b2"]})
    quality(off)
    inside = inner_sensitivity(off, quality.draws, 0, 1)
    blind = cut_to_loss(off, price_cuts(off, seen, None, plain), plain.image_quality, 0.1)
    knowing = cut_to_loss(off, price_cuts(off, seen, inside, quality), quality, 0.1)
    assert blind.count < knowing.count == model.count


def test_what_no_view_shows_is_left_alone() -> None:
    """A primitive behind all cameras: nothing is known of it, so it is not for pruning to say that it is worth
    nothing."""
    model, dataset = known()
    params = {name: value.clone() for name, value in model.params.items()}
    params["means"][5] = torch.tensor([0.0, 0.0, 50.0])
    aside = Primitives(model.density, model.colour, params)
    views = list(range(len(dataset.train)))
    found = sensitivity(aside, dataset, views, SETTINGS)
    assert int(found.seen[5]) == 0 and float(found.whole[5]) == 0.0 and int(found.seen[0]) == len(views)
    quality = SearchQuality(dataset, SETTINGS)
    left = cut_to_loss(aside, price_cuts(aside, found, None, quality), quality.image_quality, 1.0)
    assert bool((left.params["means"][:, 2] == 50.0).any())
