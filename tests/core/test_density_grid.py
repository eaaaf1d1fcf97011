"""The model's extinction on a grid, against the fields' own density point by point."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from neuprim.core.cosine import CosineDensity
from neuprim.core.density_grid import density_grid
from neuprim.core.errors import ConfigError
from neuprim.core.gaussian import GaussianDensity
from neuprim.core.primitives import Primitives
from neuprim.core.schema import InitContext
from neuprim.tasks.static.fields import SphericalHarmonics
from tests import scenes

SHAPE = (13, 9, 11)


def model(neurons: int = 5) -> Primitives:
    t = scenes.tensors(40, neurons, seed=2)
    return Primitives(
        CosineDensity(neurons), SphericalHarmonics(0), {**{k: v for k, v in t.items() if k != "colors"}, "sh_dc": t["colors"]}
    )


def oracle(m: Primitives, matrix: Tensor) -> Tensor:
    """Every primitive at every point, each clamped at zero inside its ellipsoid."""
    index = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) for n in SHAPE))
    points = index @ matrix[:3, :3].T + matrix[:3, 3]
    params = {k: v.double() for k, v in m.of(m.density).items()}
    wide = Primitives(m.density, m.colour, {k: v.double() for k, v in m.params.items()})
    total = torch.zeros(len(points), dtype=torch.float64)
    for n in range(m.count):
        prim = torch.full((len(points),), n)
        y = ((points - wide.geometry.means[n]) @ wide.geometry.rotations[n]) / wide.geometry.scales[n]
        sigma = m.density.density(params, wide.geometry, prim, points, {}).clamp_min(0)
        total += torch.where(y.square().sum(1) < 1, sigma, 0.0)
    return total.reshape(SHAPE)


@pytest.mark.parametrize("sheared", [False, True])
def test_it_equals_the_sum_of_clamped_densities(sheared: bool) -> None:
    m = model()
    matrix = torch.eye(4, dtype=torch.float64) * 0.15
    matrix[:3, 3] = torch.tensor([-0.9, -0.6, -0.8])
    matrix[3, 3] = 1
    if sheared:
        matrix[0, 1], matrix[2, 0] = 0.07, -0.05
    expected = oracle(m, matrix)
    assert float(expected.max()) > 0.5
    found = density_grid(m, {}, matrix, SHAPE)
    assert torch.allclose(found.double(), expected, rtol=1e-5, atol=1e-5)


def test_it_does_not_depend_on_the_number_of_threads() -> None:
    m, matrix = model(), torch.diag(torch.tensor([0.2, 0.2, 0.2, 1.0], dtype=torch.float64))
    one, two = (density_grid(m, {}, matrix, SHAPE, threads) for threads in (1, 2))
    assert torch.equal(one, two) and bool(one.any())


def test_primitives_far_away_or_huge_are_no_trouble() -> None:
    m = model(0)
    m.params["means"][0], m.params["log_scales"][1] = torch.tensor([1e30, 0.0, 0.0]), torch.tensor([60.0, 60.0, 60.0])
    grid = density_grid(m, {}, torch.diag(torch.tensor([0.2, 0.2, 0.2, 1.0], dtype=torch.float64)), SHAPE)
    assert bool(torch.isfinite(grid).all())


def test_other_densities_are_refused() -> None:
    generator = torch.Generator().manual_seed(0)
    context = InitContext(torch.zeros(2, 3), torch.ones(2), torch.zeros(2, 3), generator)
    with pytest.raises(ConfigError, match="Opaque density cannot be put on a grid"):
        density_grid(Primitives.initialise(GaussianDensity(), SphericalHarmonics(0), context), {}, torch.eye(4).double(), SHAPE)
