"""The per-primitive stage in Warp makes what numba makes, and so does its chain rule; on Warp's CPU blocks, and on a
card where there is one."""

from __future__ import annotations

import numpy as np
import pytest
import torch

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

import pytest

from neuprim.core.errors import BackendUnavailable
from neuprim.core.render import layout as P
from neuprim.core.render.cuda import binning
from neuprim.core.render.cuda import layout as L
from neuprim.core.render.cuda.prepare import Frame
from tests.core.render.cuda.twin import CASES, DEVICES, Array, both, frame_of, numpy, ulps

PLACES = {
    P.E0: (L.E0, 0), P.EX: (L.EX, 0), P.EY: (L.EY, 0), P.XA: (L.XA, 0), P.XU: (L.XU, 0), P.XV: (L.XV, 0),
    P.TC: (L.REST, 0), P.TU: (L.XU, 3), P.TV: (L.XV, 3), P.UX: (L.E0, 3), P.UY: (L.EX, 3), P.NEAR: (L.EY, 3),
    P.OFFSET: (L.XA, 3), P.UNIT: (L.REST, 1), P.ANCHOR_Z: (L.REST, 2),
}  # fmt: skip
"""Column of a number of the numba backend's rows -> its float4 and place in it; vectors have three."""


def geometry(frame: Frame) -> Array:
    """The numbers of the rows before the neurons, as the numba backend orders them."""
    rows = numpy(frame.rows)
    out = np.empty((len(rows), P.NEURONS), np.float32)
    for column, (four, place) in PLACES.items():
        width = 3 if place == 0 and column < P.TC else 1
        out[:, column : column + width] = rows[:, four, place : place + width]
    return out


def neurons(frame: Frame) -> Array:
    """(N, K, 5)."""
    rows, K = numpy(frame.rows), frame.neurons
    amplitudes = rows[:, L.rasterizer_amplitude_column(K) : L.rasterizer_colour_column(K)].reshape(len(rows), -1)[
        :, :K, None
    ]
    return np.concatenate([rows[:, L.NEURONS : L.NEURONS + K], amplitudes], 2)


def norm(rows: Array) -> Array:
    """(n,) length of each row."""
    length: Array = np.linalg.norm(rows, axis=1)
    return length


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", CASES)
def test_rows_are_numbas(name: str, device: str) -> None:
    numba, frame = both(name, device)
    seen = numba.visible
    assert seen.sum() > 10
    assert (numpy(frame.status) == numba.projected.status).all()
    assert (numpy(frame.boxes) == numba.projected.boxes).all()
    assert np.abs(numpy(frame.depth) - numba.projected.depth).max() < 1e-12 * np.abs(numba.projected.depth).max()
    assert ulps(numpy(frame.spans)[seen], numba.projected.spans[seen]).max() <= 1
    assert ulps(geometry(frame)[seen], numba.projected.rows[seen, : P.NEURONS]).max() <= 1
    assert (
        ulps(neurons(frame)[seen], numba.neurons(numba.projected.rows, np.arange(len(seen)))[seen]).max(initial=0) <= 1
    )
    painted = numpy(frame.rows)[seen, L.rasterizer_colour_column(frame.neurons) :].reshape(seen.sum(), -1)
    palette = CASES[name].tensors()["colors"].float().numpy()
    assert (painted[:, : CASES[name].channels] == palette[seen]).all()
    assert (painted[:, CASES[name].channels :] == 0).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", CASES)
def test_float64_rows_are_numbas(name: str, device: str) -> None:
    numba, frame = both(name, device)
    assert numpy(frame.which).tolist() == numba.which.tolist()
    slots = np.full(len(numba.projected.status), -1)
    slots[numba.which] = np.arange(len(numba.which))
    assert (numpy(frame.slots) == slots).all()
    assert (numpy(frame.rows)[numba.visible, L.REST, 3] == (slots >= 0)[numba.visible]).all()
    wide = numpy(frame.wide)
    assert wide.shape == (len(numba.which), L.wide_width(frame.neurons))
    # what float64 leaves of differences: of points at the anchor's depth, of the steps between them, of directions
    # nearly orthogonal
    tc, e0, step = numba.wide[:, P.TC], norm(numba.wide[:, P.E0 : P.EX]), norm(numba.wide[:, P.EX : P.XA])
    cancels = {P.XA: tc * e0, P.XU: tc * step, P.XV: tc * step, P.TU: tc * step / e0, P.TV: tc * step / e0}
    for column in PLACES:
        columns = slice(column, column + (3 if column < P.TC else 1))
        own, theirs = wide[:, columns], numba.wide[:, columns]
        scale = norm(theirs) + cancels.get(column, 0.0)
        assert (np.abs(own - theirs) <= 1e-14 * scale[:, None]).all(), column
    ordered = numba.neurons(numba.wide, numba.which).reshape(len(wide), L.PER_NEURON * frame.neurons)
    assert np.abs(wide[:, P.NEURONS :] - ordered).max(initial=0) <= 1e-14 * np.abs(ordered).max(initial=0)


@pytest.mark.parametrize("device", DEVICES)
def test_forced_primitives_are_drawn_in_float64(device: str) -> None:
    case = CASES["K=8"]
    t = case.tensors()
    forced = torch.arange(case.count, device=device) % 3 == 0
    free, frame = frame_of(case, t, device), frame_of(case, t, device, forced)
    assert free.which.numel() == 0
    wanted = (forced & (free.boxes[:, 2] > 0)).nonzero()[:, 0]
    assert frame.which.tolist() == wanted.tolist() and wanted.numel() > 100
    assert (frame.rows[wanted][:, [L.XU, L.XV], 3] == 0).all(), "float64 does not slide"
    assert torch.equal(frame.rows[~forced], free.rows[~forced])
    assert torch.equal(frame.lists.ids, free.lists.ids)


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
