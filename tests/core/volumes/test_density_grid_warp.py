"""The GPU kernel that fills a grid, on Warp's CPU blocks: the order and size of blocks change no bit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from torch import Tensor

pytest.importorskip("warp", reason="GPU kernels are written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.compute import device
from neuprim.core.model.primitives import Primitives
from neuprim.core.volumes import density_grid_warp
from neuprim.core.volumes.density_grid import density_grid
from tests.cosine_models import model as cosine_model

SHAPE = (21, 18, 25)
MATRIX = torch.diag(torch.tensor([0.08, 0.09, 0.07, 1.0], dtype=torch.float64))
MATRIX[:3, 3] = torch.tensor([-0.8, -0.8, -0.85])


@pytest.fixture(autouse=True)
def on_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(device, "has_warp", lambda where: True)


def model(neurons: int = 3, edge: int = 2) -> Primitives:
    """Small and large ones, one around the whole grid, and some beside it."""
    m = cosine_model(neurons, edge, seed=4, count=60)
    m.params["log_scales"][:5] += 2.0
    m.params["log_scales"][5] += 6.0
    m.params["means"][6:9] += 5.0
    return m


def filled() -> Tensor:
    return density_grid(model(), {}, MATRIX, SHAPE)


@pytest.mark.parametrize("edge", [0, 1, 2])
@pytest.mark.parametrize("neurons", [0, 8])
def test_it_is_the_cpus(edge: int, neurons: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sums of the same float32 numbers in the same order: most points have the same bits."""
    m = model(neurons, edge)
    found = density_grid(m, {}, MATRIX, SHAPE)
    monkeypatch.setattr(device, "has_warp", lambda where: False)
    wanted = density_grid(m, {}, MATRIX, SHAPE)
    assert float(wanted.max()) > 1.0 and torch.allclose(found, wanted, rtol=1e-6, atol=1e-6)
    assert float((found == wanted).float().mean()) > 0.99


@pytest.mark.parametrize(("name", "most"), [("_PAIRS", 1), ("_PAIRS", 40), ("_POINTS", 1), ("_POINTS", 8 * 18 * 25)])
def test_any_part_at_a_time_gives_the_same_bits(name: str, most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = filled()
    monkeypatch.setattr(density_grid_warp, name, most)
    assert bool(whole.any()) and torch.equal(filled(), whole)


def test_blocks_may_come_in_any_order(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last first, each as if it were alone."""
    whole, genuine, blocks = filled(), density_grid_warp.launch_kernel, []

    def one_by_one(kernel: Any, dim: Any, inputs: Sequence[Any], where: torch.device, block: int) -> None:
        starts = inputs[0].tensor
        for tile in reversed(range(dim[0])):
            alone = torch.where(torch.arange(len(starts)) <= tile, starts[tile], starts[tile + 1])
            genuine(kernel, dim, (density_grid_warp.array(alone, inputs[0].dtype), *inputs[1:]), where, block)
            blocks.append(tile)

    monkeypatch.setattr(density_grid_warp, "launch_kernel", one_by_one)
    assert torch.equal(filled(), whole) and len(blocks) == 6 * 3 * 4


def test_numbers_that_are_not_finite_reach_nothing_else() -> None:
    m, bad = model(), model()
    bad.params["means"][9] = torch.nan
    bad.params["log_scales"][10] = torch.inf
    for name in ("means", "log_scales"):
        m.params[name][9:11] = 100.0 if name == "means" else -5.0
    assert torch.equal(density_grid(bad, {}, MATRIX, SHAPE), density_grid(m, {}, MATRIX, SHAPE))
