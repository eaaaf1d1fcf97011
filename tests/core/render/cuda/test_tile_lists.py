"""The tile lists of the cuda backend are those of the numba backend, pair for pair."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import torch

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.errors import BackendUnavailable
from neuprim.core.render.cuda import binning
from neuprim.core.render.cuda import layout as L
from tests.core.render.cuda.twin import CASES, DEVICES, Case, both, frame_of, numpy


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", CASES)
def test_lists_are_numbas(name: str, device: str) -> None:
    numba, frame = both(name, device)
    theirs, own = numba.lists, frame.lists
    assert own.pairs == theirs.pairs > 10
    for found, wanted in (
        (own.starts, theirs.starts),
        (own.ids, theirs.ids),
        (own.first, theirs.first),
        (own.slots_of, theirs.slots),
        (own.tile_of, np.repeat(np.arange(len(theirs.starts) - 1), np.diff(theirs.starts))),
    ):
        assert found.dtype == torch.int32 and (numpy(found) == wanted).all()


@pytest.mark.parametrize("device", DEVICES)
def test_primitives_of_one_depth_and_primitives_that_fill_the_image(device: str) -> None:
    case = Case(0)
    t = {name: value[:1].repeat(case.count, *[1] * (value.ndim - 1)) for name, value in case.tensors().items()}
    t["means"] *= 0.1
    lists = frame_of(case, t, device).lists
    filled = [lists.ids[a:b].tolist() for a, b in pairwise(lists.starts.tolist()) if b > a]
    assert filled and all(ids == list(range(case.count)) for ids in filled)
    t = case.tensors()
    t["log_scales"][:], t["b2"] = 3.0, t["b2"].abs() + 0.01
    lists = frame_of(case, t, device).lists
    tiles = -(-150 // L.TILE) * -(-110 // L.TILE)
    assert lists.pairs == case.count * tiles
    assert (lists.ids.view(tiles, -1).sort(1)[0] == torch.arange(case.count, device=device)).all()
    nothing = frame_of(Case(2, near=50.0), Case(2, near=50.0).tensors(), device)
    assert nothing.lists.pairs == 0 and not nothing.lists.starts.any() and (nothing.slots == -1).all()


def test_more_pairs_than_their_index_can_count_are_refused() -> None:
    counts = torch.tensor([[2**30, 2**30], [0, 0]], dtype=torch.int32)
    with pytest.raises(BackendUnavailable, match=r"reach 2147483648 tiles"):
        binning.count_tiles(counts, torch.tensor([2], dtype=torch.int32))
