"""Errors on all points of a truth, summed block by block, against the same numbers of whole arrays."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.model.densities.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.volumes import density_errors
from neuprim.core.volumes.density_errors import (
    NUMBERS,
    Comparison,
    DensityTruth,
    TruthFrame,
    measure_frame_errors,
    split_planes,
)
from neuprim.core.volumes.grid import agreement, density_grid, voxels_within
from neuprim.tasks.static.fields import SphericalHarmonics
from tests import scenes

SHAPE = (20, 14, 17)


def model() -> Primitives:
    t = scenes.tensors(40, 5, seed=2)
    return Primitives(
        CosineDensity(5), SphericalHarmonics(0), {**{k: v for k, v in t.items() if k != "colors"}, "sh_dc": t["colors"]}
    )


class Known(DensityTruth):
    """One frame of numbers on voxels of edge 0.1, another that is empty."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.frames, self.asked = values, [TruthFrame("a", {}), TruthFrame("b", {})], 0
        self.bounds = torch.tensor([[-1.0, -0.7, -0.9], [1.0, 0.7, 0.8]], dtype=torch.float64)
        self.matrix = torch.diag(torch.tensor([0.1, 0.1, 0.1, 1.0], dtype=torch.float64))
        self.matrix[:3, 3] = self.bounds[0] + 0.05

    def points(self, frame: int) -> tuple[Tensor, tuple[int, int, int]] | None:
        return None if frame else (self.matrix, SHAPE)

    def grid(self, frame: int, scene_from_index: Tensor, shape: tuple[int, int, int]) -> Tensor:
        self.asked += 1
        low = ((scene_from_index[:3, 3] - self.matrix[:3, 3]) / 0.1).round().long().tolist()
        return torch.from_numpy(self.values[tuple(slice(a, a + n) for a, n in zip(low, shape, strict=True))].copy())


def ball() -> np.ndarray:
    index = np.indices(SHAPE) - np.array(SHAPE)[:, None, None, None] / 2
    return np.clip(3 - 0.6 * np.linalg.norm(index, axis=0), 0, None).astype(np.float32)


@pytest.mark.parametrize("block", [1, 14 * 17 * 3, 1 << 22])
def test_numbers_are_those_of_the_whole_grids(monkeypatch: pytest.MonkeyPatch, block: int) -> None:
    monkeypatch.setattr(density_errors, "_BLOCK", block)
    truth, m = Known(ball()), model()
    found = measure_frame_errors(m, {}, truth, 0)
    assert found is not None and tuple(found) == NUMBERS
    sigma = density_grid(m, {}, truth.matrix, SHAPE).numpy().astype(float)
    wrong, both = sigma - truth.values, agreement(truth.values, sigma)
    assert both is not None and {k: found[k] for k in both} == pytest.approx(both, rel=1e-6)
    assert found["max_error"] == pytest.approx(np.abs(wrong).max() / truth.values.max(), rel=1e-6)
    active = wrong[truth.values > 0]
    assert 0 < len(active) < truth.values.size
    assert found["psnr_active"] == pytest.approx(-10 * np.log10((active**2).mean() / truth.values.max() ** 2), rel=1e-6)
    assert truth.asked == {1: 20, 714: 7, 1 << 22: 1}[block]


def test_false_matter_in_empty_voxels_counts() -> None:
    a = ball()
    b = a.copy()
    b[0, 0, 0] = 5.0
    here, there = (_numbers(a, x) for x in (a, b))
    assert a[0, 0, 0] == 0 and here["relative_l2"] == here["max_error"] == 0 and here["psnr_active"] == 200
    assert there["relative_l2"] == pytest.approx(5 / np.linalg.norm(a), rel=1e-6) and there[
        "max_error"
    ] == pytest.approx(5 / a.max())
    assert there["psnr_active"] == 200


def _numbers(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    compared = Comparison()
    compared.add(a, b)
    found = compared.numbers()
    assert found is not None
    return found


def test_nothing_to_compare_with() -> None:
    assert measure_frame_errors(model(), {}, Known(ball()), 1) is None
    assert measure_frame_errors(model(), {}, Known(np.zeros(SHAPE, np.float32)), 0) is None
    assert _numbers(ball(), np.zeros(SHAPE))["correlation"] == 0


def test_blocks_are_the_points_in_their_order() -> None:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.tensor([[0.1, 0.02, 0], [0, 0.2, 0], [0.05, 0, 0.1]])
    parts: list[Any] = split_planes(matrix, (5000, 60, 50))
    assert (
        sum(shape[0] for _, shape in parts) == 5000
        and len(parts) > 2
        and all(shape[1:] == (60, 50) for _, shape in parts)
    )
    first = parts[0][1][0]
    assert torch.allclose(
        parts[1][0] @ torch.tensor([0, 1, 2, 1.0]).double(), matrix @ torch.tensor([first, 1, 2, 1.0]).double()
    )


def test_voxels_of_a_box_are_those_whose_centres_lie_in_it() -> None:
    place = np.diag([0.25, 0.5, 1.0, 1.0])
    place[:3, 3] = (0.1, -3.0, 7.0)
    matrix, shape = voxels_within(np.array([[0.1, -4.0, 5.5], [1.1, -2.0, 8.4]]), place)
    assert shape == (5, 5, 3)
    assert matrix[:3, 3].tolist() == pytest.approx([0.1, -4.0, 6.0]) and np.allclose(matrix[:3, :3], place[:3, :3])
