"""The backward pass takes the forward pass's optical depths: they are there, they are of the same lanes, and nothing
else is saved."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import pytest
import torch
from numba import njit

from neuprim.core.compute import views
from neuprim.core.compute.views import borrow_array, compress16, copy16
from neuprim.core.render import RenderOutput, RenderSettings, render_lowered
from neuprim.core.render.cpu import backend
from neuprim.core.render.cpu.forward import SavedForBackward
from neuprim.core.render.layout import TILE
from tests import scenes
from tests.numerics.compare import assert_same_frame, draw

SETTINGS = RenderSettings(backend="cpu", threads=1, alpha_max=0.98)  # 0.99 twice would be transmittance_min itself


def wall(neurons: int = 2) -> dict[str, torch.Tensor]:
    """Twelve opaque primitives in front of the upper half of the image, twelve faint ones behind them everywhere."""
    t = scenes.tensors(24, neurons=neurons, seed=5)
    front, towards = (torch.arange(24) < 12)[:, None], scenes.camera().position.float() / 3
    t["means"] = torch.where(front, 0.1 * t["means"] + towards + torch.tensor([0.0, 0.0, 0.5]), t["means"] * 0.5)
    t["log_scales"] = torch.where(front, 0.7 + t["log_scales"], 0.2 + 0.2 * t["log_scales"])
    t["b2"] = torch.where(front, 9.0, 0.2)
    t["w2"] = t["w2"] * 0.1
    return t


def saved_of(t: dict[str, torch.Tensor], monkeypatch: pytest.MonkeyPatch) -> tuple[SavedForBackward, RenderOutput]:
    found: list[SavedForBackward] = []

    def allocate(pairs: int) -> SavedForBackward:
        found.append(SavedForBackward(np.zeros(pairs, np.uint16), np.zeros(pairs, np.int32)))
        return found[-1]

    with monkeypatch.context() as patch:
        patch.setattr(backend.SavedForBackward, "allocate", allocate)
        leaves = {k: v.clone().requires_grad_() for k, v in t.items()}
        out = render_lowered(scenes.lowered(leaves), scenes.camera(), SETTINGS)
    return found[0], out


def test_there_is_room_for_the_depths_of_tiles_that_are_filled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Primitives that fill their tiles have 256 lanes a pair, as many as there is room for, and no lane is lost."""
    t = scenes.tensors(16, seed=2)
    t["log_scales"] = 0.9 + 0.3 * t["log_scales"]
    saved, out = saved_of(t, monkeypatch)
    lanes = out.stats.extra["forward_lanes"]
    assert lanes > 100 * out.stats.pairs, "the scene does not fill its tiles"
    assert sum(len(d) for d in saved.depths) >= lanes
    # one ray near a hard edge decides the error of a gradient, by D^-1/2: over seeds 2 to 9 it is 2e-5 to 2e-3
    assert_same_frame(t, scenes.camera(), SETTINGS, grad_bound=3e-3)


@pytest.mark.parametrize("neurons", [0, 1, 2, 3, 8])
def test_gradients_where_rows_die_early(neurons: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also twice, and on any number of threads."""
    t = wall(neurons)
    saved, out = saved_of(t, monkeypatch)
    assert ((saved.live != 0) & (saved.live != 2**TILE - 1)).any(), "no row dies"
    # behind walls that let a fiftieth through, float32 is a little coarser than elsewhere
    fast, _ = assert_same_frame(t, scenes.camera(), SETTINGS, image_bound=1e-4, grad_bound=2e-3)
    extra = fast.output.stats.extra
    assert 0 < extra["backward_lanes"] < 0.9 * extra["forward_lanes"], "lanes of opaque pixels get no gradient"
    leaves = {k: v.clone().requires_grad_() for k, v in t.items()}
    out = render_lowered(scenes.lowered(leaves), scenes.camera(), SETTINGS)
    wanted = [leaves[k] for k in ("means", "log_scales", "quats", "b2", "colors")]
    first, second = (torch.autograd.grad(out.rgb.sum(), wanted, retain_graph=True) for _ in range(2))
    assert all(torch.equal(a, b) for a, b in zip(first, second, strict=True)) and first[0].abs().sum() > 0
    grads = [draw("cpu", t, scenes.camera(), RenderSettings(backend="cpu", threads=n)).grads for n in (1, 2, 3)]
    assert all(torch.equal(grads[0][k], g[k]) for g in grads[1:] for k in g)


def test_nothing_is_saved_where_no_gradient_can_be_asked(monkeypatch: pytest.MonkeyPatch) -> None:
    t = scenes.tensors(8)
    saved, _ = saved_of(t, monkeypatch)
    assert len(saved.live) == len(saved.first_lane) > 0 and sum(len(d) for d in saved.depths) > 0
    with torch.no_grad():
        saved, _ = saved_of(t, monkeypatch)
    assert len(saved.live) == len(saved.first_lane) == sum(len(d) for d in saved.depths) == 0


def test_sixteen_floats_are_read_before_they_are_written() -> None:
    @njit
    def copy(target: Any, at: Any, source: Any, first: Any) -> None:
        copy16(target, at, source, first)

    numbers = np.arange(40, dtype=np.float32)
    copy(numbers, 5, numbers, 3)
    assert numbers.tolist() == [*range(5), *range(3, 19), *range(21, 40)]


@pytest.mark.parametrize("compresses", [True, False])
def test_those_of_sixteen_floats_that_count_are_moved_together(
    compresses: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the instruction and one by one, in place, and whatever the flags: not numbers count, and zeros of either sign
    do not."""
    if compresses and not views._COMPRESSES:
        pytest.skip("this version of LLVM is not asked for the instruction")
    monkeypatch.setattr(views, "_COMPRESSES", compresses)

    @njit
    def keep(array: Any, at: Any, first: Any, flags: Any) -> Any:
        return compress16(array, at, first, flags)

    g = np.random.default_rng(0)
    special, zeros = [1e-40, -2.0, np.nan, np.inf], [0.0, -0.0]
    for chance in (0.0, 0.1, 0.5, 0.9, 1.0):
        for at in (0, 3, 16):
            array = g.normal(size=64).astype(np.float32)
            array[32:48] = np.where(g.random(16) < chance, g.choice(special, 16), g.choice(zeros, 16))
            chosen = array[16:32][array[32:48] != 0]
            expected = array.copy()
            expected[at : at + 16] = [*chosen, *[0.0] * (16 - len(chosen))]
            assert keep(array, at, 16, 32) == len(chosen)
            np.testing.assert_array_equal(array, expected)


def test_a_lent_array_is_the_same_array_and_its_owner_keeps_it() -> None:
    @njit
    def total(array: Any) -> float:
        view, result = borrow_array(array), 0.0
        view[0, 0] = 7
        for row in range(view.shape[0]):
            result += view[row].sum()
        return result

    array = np.ones((3, 4), np.float32)
    before = sys.getrefcount(array)
    assert [total(array) for _ in range(100)] == [18.0] * 100
    assert array[0, 0] == 7 and sys.getrefcount(array) == before
