"""The tile lists of the cuda backend are those of the numba backend, pair for pair."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.errors import BackendUnavailable
from neuprim.core.render.cuda import binning
from tests.core.render.cuda.twin import CASES, DEVICES, both, numpy


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


def test_more_pairs_than_their_index_can_count_are_refused() -> None:
    counts = torch.tensor([[2**30, 2**30], [0, 0]], dtype=torch.int32)
    with pytest.raises(BackendUnavailable, match=r"reach 2147483648 tiles"):
        binning.count_tiles(counts, torch.tensor([2], dtype=torch.int32))
