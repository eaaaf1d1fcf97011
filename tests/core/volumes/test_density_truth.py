"""Errors on all points of a truth, summed block by block, against the same numbers of whole arrays."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from neuprim.core.volumes import density_truth
from neuprim.core.volumes.density_grid import density_grid, voxels_in_box
from neuprim.core.volumes.density_truth import (
    DENSITY_ERRORS,
    DensityComparison,
    DensityTruth,
    TruthFrame,
    measure_density_errors,
    split_density_grid_planes,
)
from tests.cosine_models import model

SHAPE = (20, 14, 17)


class Known(DensityTruth):
    """One frame of numbers on voxels of edge 0.1, another that is empty."""

    def __init__(self, values: np.ndarray) -> None:
        self.values, self.frames, self.blocks = values, [TruthFrame("a", {}), TruthFrame("b", {})], 0
        self.bounds = torch.tensor([[-1.0, -0.7, -0.9], [1.0, 0.7, 0.8]], dtype=torch.float64)
        self.matrix = torch.diag(torch.tensor([0.1, 0.1, 0.1, 1.0], dtype=torch.float64))
        self.matrix[:3, 3] = self.bounds[0] + 0.05

    def points(self, frame: int) -> tuple[Tensor, tuple[int, int, int]] | None:
        return None if frame else (self.matrix, SHAPE)

    def grid(
        self, frame: int, scene_from_index: Tensor, shape: tuple[int, int, int], component: str | None = None
    ) -> Tensor:
        self.blocks += 1
        low = ((scene_from_index[:3, 3] - self.matrix[:3, 3]) / 0.1).round().long().tolist()
        return torch.from_numpy(self.values[tuple(slice(a, a + n) for a, n in zip(low, shape, strict=True))].copy())


def ball() -> np.ndarray:
    index = np.indices(SHAPE) - np.array(SHAPE)[:, None, None, None] / 2
    return np.clip(3 - 0.6 * np.linalg.norm(index, axis=0), 0, None).astype(np.float32)


def numbers(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    compared = DensityComparison()
    compared.add_block(a, b)
    found = compared.errors()
    assert found is not None
    return found


@pytest.mark.parametrize(("block", "blocks"), [(1, 20), (14 * 17 * 3, 7), (1 << 22, 1)])
def test_numbers_are_those_of_the_whole_grids(monkeypatch: pytest.MonkeyPatch, block: int, blocks: int) -> None:
    monkeypatch.setattr(density_truth, "_BLOCK_POINTS", block)
    truth, m = Known(ball()), model()
    found = measure_density_errors(m, {}, truth, 0)
    assert found is not None and tuple(found) == DENSITY_ERRORS and truth.blocks == blocks
    a, b = truth.values.astype(float), density_grid(m, {}, truth.matrix, SHAPE).numpy().astype(float)
    active = (b - a)[a > 0]
    assert 0 < len(active) < a.size
    assert found == pytest.approx(
        {
            "correlation": np.corrcoef(a.ravel(), b.ravel())[0, 1],
            "relative_l2": np.linalg.norm(b - a) / np.linalg.norm(a),
            "psnr_active": -10 * np.log10((active**2).mean() / a.max() ** 2),
            "max_error": np.abs(b - a).max() / a.max(),
        },
        rel=1e-6,
    )


def test_false_matter_in_empty_voxels_counts() -> None:
    a = ball()
    b = a.copy()
    b[0, 0, 0] = 5.0
    same, wrong = numbers(a, a), numbers(a, b)
    assert a[0, 0, 0] == 0 and same["relative_l2"] == same["max_error"] == 0 and same["psnr_active"] == 200
    assert wrong["relative_l2"] == pytest.approx(5 / np.linalg.norm(a), rel=1e-6) and wrong["psnr_active"] == 200
    assert wrong["max_error"] == pytest.approx(5 / a.max())


def test_nothing_to_compare_with() -> None:
    assert measure_density_errors(model(), {}, Known(ball()), 1) is None
    assert measure_density_errors(model(), {}, Known(np.zeros(SHAPE, np.float32)), 0) is None
    assert numbers(ball(), np.zeros(SHAPE))["correlation"] == 0


def test_blocks_are_the_points_in_their_order() -> None:
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3] = torch.tensor([[0.1, 0.02, 0], [0, 0.2, 0], [0.05, 0, 0.1]])
    parts = split_density_grid_planes(matrix, (5000, 60, 50))
    assert sum(shape[0] for _, shape in parts) == 5000 and len(parts) > 2
    assert all(shape[1:] == (60, 50) for _, shape in parts)
    point = torch.tensor([parts[0][1][0], 1, 2, 1.0], dtype=torch.float64)
    assert torch.allclose(parts[1][0] @ torch.tensor([0, 1, 2, 1.0]).double(), matrix @ point)


def test_voxels_of_a_box_are_those_whose_centres_lie_in_it() -> None:
    place = np.diag([0.25, 0.5, 1.0, 1.0])
    place[:3, 3] = (0.1, -3.0, 7.0)
    matrix, shape = voxels_in_box(np.array([[0.1, -4.0, 5.5], [1.1, -2.0, 8.4]]), place)
    assert shape == (5, 5, 3)
    assert matrix[:3, 3].tolist() == pytest.approx([0.1, -4.0, 6.0]) and np.allclose(matrix[:3, :3], place[:3, :3])
