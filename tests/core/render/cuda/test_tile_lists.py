"""The tile lists of the cuda backend are those of the numba backend, pair for pair."""

from __future__ import annotations

import warnings
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
    assert (numpy(own.starts) == theirs.starts).all()
    assert (numpy(own.ids) == theirs.ids).all()
    assert (numpy(own.first) == theirs.first).all()
    assert (numpy(own.slots_of) == theirs.slots).all()
    assert (numpy(own.tile_of) == np.repeat(np.arange(len(theirs.starts) - 1), np.diff(theirs.starts))).all()
    assert {x.dtype for x in (own.starts, own.ids, own.tile_of, own.first, own.slots_of, frame.slots, frame.which)} == {
        torch.int32
    }


@pytest.mark.parametrize("device", DEVICES)
def test_equal_depths_keep_their_order(device: str) -> None:
    case = Case(0)
    t = {name: value[:1].repeat(case.count, *[1] * (value.ndim - 1)) for name, value in case.tensors().items()}
    t["means"] *= 0.1
    lists = frame_of(case, t, device).lists
    starts = lists.starts.tolist()
    filled = [lists.ids[a:b].tolist() for a, b in pairwise(starts) if b > a]
    assert filled and all(ids == list(range(case.count)) for ids in filled)


@pytest.mark.parametrize("device", DEVICES)
def test_large_primitives_fill_every_tile(device: str) -> None:
    case = Case(0)
    t = case.tensors()
    t["log_scales"][:], t["b2"] = 3.0, t["b2"].abs() + 0.01  # all of them can be seen
    lists = frame_of(case, t, device).lists
    tiles = -(-150 // L.TILE) * -(-110 // L.TILE)
    assert lists.pairs == case.count * tiles
    assert (lists.starts == torch.arange(tiles + 1, device=device) * case.count).all()
    assert (lists.ids.view(tiles, -1).sort(1)[0] == torch.arange(case.count, device=device)).all()


@pytest.mark.parametrize("device", DEVICES)
def test_nothing_is_seen(device: str) -> None:
    case = Case(2, near=50.0)
    frame = frame_of(case, case.tensors(), device)
    assert frame.lists.pairs == 0 and frame.which.numel() == 0
    assert not frame.lists.starts.any() and not frame.lists.first.any() and (frame.slots == -1).all()


def test_more_pairs_than_their_index_can_count_are_refused() -> None:
    counts = torch.tensor([[2**30, 2**30], [0, 0]], dtype=torch.int32)
    with pytest.raises(BackendUnavailable, match=r"reach 2147483648 tiles"):
        binning.count_tiles(counts, torch.tensor([2], dtype=torch.int32))


@pytest.mark.skipif("cuda" not in DEVICES, reason="whether the host waits shows on a card alone")
def test_the_host_waits_once() -> None:
    case = CASES["inside"]
    t = {key: value.cuda() for key, value in case.tensors().items()}
    frame_of(case, t, "cuda")
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always")
            frame_of(case, t, "cuda")
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert len([w for w in said if "synchroniz" in str(w.message)]) == 1
