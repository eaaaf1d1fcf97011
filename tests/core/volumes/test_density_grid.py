"""The model's extinction on a grid, against the fields' own density point by point."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.errors import ConfigError
from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.densities.gaussian import GaussianDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.volumes.grid import agreement, density_at, density_grid
from neuprim.tasks.dynamic.density import TimeDensity
from neuprim.tasks.static.fields import SphericalHarmonics
from tests import scenes

pytestmark = pytest.mark.usefixtures("either_kernel")

SHAPE = (13, 9, 11)


def model(neurons: int = 5, edge: int = 0) -> Primitives:
    t = scenes.tensors(40, neurons, seed=2)
    return Primitives(
        CosineDensity(neurons, edge=edge),
        SphericalHarmonics(0),
        {**{k: v for k, v in t.items() if k != "colors"}, "sh_dc": t["colors"]},
    )


def oracle(m: Primitives, matrix: Tensor) -> Tensor:
    """Every primitive at every point, each clamped at zero inside its ellipsoid."""
    index = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) for n in SHAPE))
    return density_at(m, {}, index @ matrix[:3, :3].T + matrix[:3, 3]).reshape(SHAPE)


def test_the_oracle_is_the_sum_over_primitives_one_by_one() -> None:
    m, points = model(), torch.rand(50, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5
    params, total = {k: v.double() for k, v in m.params.items()}, torch.zeros(50, dtype=torch.float64)
    g = Geometry(params["means"], params["log_scales"], params["quats"])
    for n in range(m.count):
        for i, x in enumerate(points):
            local = x - g.means[n]
            y, u = (local @ g.rotations[n]) / g.scales[n], local / g.scales[n].max()
            f = (params["w2"][n] * (30 * (params["W1"][n] @ u + params["b1"][n])).cos()).sum() + params["b2"][n, 0]
            total[i] += f.clamp_min(0) / g.scales[n].max() * (y.norm() < 1)
    assert float(total.max()) > 0.5
    assert torch.allclose(density_at(m, {}, points), total, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("edge", [0, 1, 2])
@pytest.mark.parametrize("sheared", [False, True])
def test_it_equals_the_sum_of_clamped_densities(sheared: bool, edge: int) -> None:
    m = model(edge=edge)
    matrix = torch.eye(4, dtype=torch.float64) * 0.15
    matrix[:3, 3] = torch.tensor([-0.9, -0.6, -0.8])
    matrix[3, 3] = 1
    if sheared:
        matrix[0, 1], matrix[2, 0] = 0.07, -0.05
    expected = oracle(m, matrix)
    assert float(expected.max()) > 0.5 and (edge == 0) == torch.equal(expected, oracle(model(), matrix))
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


def gaussians() -> Primitives:
    generator = torch.Generator().manual_seed(0)
    means = 0.3 * torch.rand(5, 3, generator=generator)
    return Primitives.initialise(
        GaussianDensity(),
        SphericalHarmonics(0),
        InitContext(means, torch.full((5,), 0.4), torch.zeros(5, 3), generator),
    )


def test_a_density_in_torch_code_is_asked_point_by_point(monkeypatch: pytest.MonkeyPatch) -> None:
    m, matrix = gaussians(), torch.diag(torch.tensor([0.1, 0.1, 0.1, 1.0], dtype=torch.float64))
    expected = oracle(m, matrix)
    assert float(expected.max()) > 0.1
    whole = density_grid(m, {}, matrix, SHAPE)
    assert torch.allclose(whole.double(), expected, rtol=1e-5, atol=1e-6)
    monkeypatch.setattr("neuprim.core.volumes.grid._PAIRS", 20)  # blocks of single planes
    assert torch.equal(density_grid(m, {}, matrix, SHAPE, threads=2), whole)


def test_a_moving_density_is_where_it_has_moved_to() -> None:
    density = TimeDensity(2, "window+motion")
    generator = torch.Generator().manual_seed(3)
    context = InitContext(
        torch.zeros(3, 3),
        torch.full((3,), 0.4),
        torch.zeros(3, 3),
        generator,
        conditions={"time": torch.full((3,), 0.5)},
    )
    m = Primitives.initialise(density, SphericalHarmonics(0), context)
    m.params["velocity"][:] = torch.tensor([1.0, 0.5, 0.0])
    matrix, frame = torch.diag(torch.tensor([0.1, 0.1, 0.1, 1.0], dtype=torch.float64)), {"time": torch.tensor(0.6)}
    index = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) for n in SHAPE))
    expected = density_at(m, frame, index @ matrix[:3, :3].T).reshape(SHAPE)
    assert float(expected.max()) > 0.1 and not torch.allclose(
        expected, density_at(m, {"time": torch.tensor(0.5)}, index @ matrix[:3, :3].T).reshape(SHAPE)
    )
    assert torch.allclose(density_grid(m, frame, matrix, SHAPE).double(), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("scale", "shape"), [(0.0, SHAPE), (float("nan"), SHAPE), (0.1, (1 << 12, 1 << 12, 1 << 12))])
def test_impossible_grids_are_refused(scale: float, shape: tuple[int, int, int]) -> None:
    with pytest.raises(ConfigError, match="expected"):
        density_grid(model(0), {}, torch.diag(torch.tensor([scale] * 3 + [1.0], dtype=torch.float64)), shape)


def test_agreement_of_two_grids() -> None:
    a = np.array([0.0, 1.0, 2.0, 5.0], np.float32)
    assert agreement(a, 2 * a) == pytest.approx({"correlation": 1.0, "relative_l2": 1.0})
    assert agreement(a, np.zeros(4)) == {"correlation": 0.0, "relative_l2": 1.0}
    assert agreement(np.ones(4), a) is None
