"""The model's extinction on a grid, against the fields' own density point by point."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from neuprim.core.errors import ConfigError
from neuprim.core.model.fields import Conditions
from neuprim.core.model.gaussian import GaussianDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext
from neuprim.core.volumes.density_grid import density_at, density_grid
from neuprim.tasks.static import SphericalHarmonics
from tests import timed_models
from tests.cosine_models import model

SHAPE = (13, 9, 11)


def spaced(step: float) -> Tensor:
    return torch.diag(torch.tensor([step, step, step, 1.0], dtype=torch.float64))


def reference(m: Primitives, matrix: Tensor, conditions: Conditions | None = None) -> Tensor:
    index = torch.cartesian_prod(*(torch.arange(n, dtype=torch.float64) for n in SHAPE))
    return density_at(m, conditions or {}, index @ matrix[:3, :3].T + matrix[:3, 3]).reshape(SHAPE)


def test_the_reference_is_the_sum_over_primitives_one_by_one() -> None:
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
    m, matrix = model(edge=edge), spaced(0.15)
    matrix[:3, 3] = torch.tensor([-0.9, -0.6, -0.8])
    if sheared:
        matrix[0, 1], matrix[2, 0] = 0.07, -0.05
    expected = reference(m, matrix)
    assert float(expected.max()) > 0.5 and (edge == 0) == torch.equal(expected, reference(model(), matrix))
    found = density_grid(m, {}, matrix, SHAPE)
    assert torch.allclose(found.double(), expected, rtol=1e-5, atol=1e-5)
    assert torch.equal(found, density_grid(m, {}, matrix, SHAPE, threads=2))


def test_primitives_far_away_or_huge_are_no_trouble() -> None:
    m = model(0)
    m.params["means"][0], m.params["log_scales"][1] = torch.tensor([1e30, 0.0, 0.0]), torch.tensor([60.0, 60.0, 60.0])
    assert bool(torch.isfinite(density_grid(m, {}, spaced(0.2), SHAPE)).all())


def test_any_other_density_is_evaluated_in_torch_code(monkeypatch: pytest.MonkeyPatch) -> None:
    generator = torch.Generator().manual_seed(0)
    context = InitContext(
        0.3 * torch.rand(5, 3, generator=generator), torch.full((5,), 0.4), torch.zeros(5, 3), generator
    )
    m = Primitives.initialise(GaussianDensity(), SphericalHarmonics(0), context)
    expected, whole = reference(m, spaced(0.1)), density_grid(m, {}, spaced(0.1), SHAPE)
    assert float(expected.max()) > 0.1 and torch.allclose(whole.double(), expected, rtol=1e-5, atol=1e-6)
    monkeypatch.setattr("neuprim.core.volumes.density_grid._PAIRS", 20)  # blocks of single planes
    assert torch.equal(density_grid(m, {}, spaced(0.1), SHAPE, threads=2), whole)


def test_a_moving_density_is_where_it_has_moved_to() -> None:
    m, (early, late) = timed_models.model("window+motion"), ({"time": torch.tensor(t)} for t in (0.4, 0.6))
    expected = reference(m, spaced(0.1), late)
    assert float(expected.max()) > 0.1 and not torch.allclose(expected, reference(m, spaced(0.1), early))
    assert torch.allclose(density_grid(m, late, spaced(0.1), SHAPE).double(), expected, rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize(("scale", "shape"), [(0.0, SHAPE), (float("nan"), SHAPE), (0.1, (1 << 12, 1 << 12, 1 << 12))])
def test_impossible_grids_are_refused(scale: float, shape: tuple[int, int, int]) -> None:
    with pytest.raises(ConfigError, match="expected"):
        density_grid(model(0), {}, spaced(scale), shape)
