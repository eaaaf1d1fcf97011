"""The backward pass takes the forward pass's optical depths: they are there, they are of the same lanes, and nothing
else is saved."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from neuprim.core.render import RenderOutput, RenderSettings, render_lowered
from neuprim.core.render.cpu import backend
from neuprim.core.render.cpu.forward import SavedForBackward
from neuprim.core.render.layout import TILE
from tests import scenes
from tests.numerics.equivalence import assert_same_frame, draw

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
