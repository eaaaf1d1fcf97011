"""How often the CPU waits for a GPU in a frame: whatever makes a Python number, or a shape, of a tensor."""

from __future__ import annotations

from typing import Any

import pytest
import torch

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.render import RenderSettings
from neuprim.core.render.cuda import backend
from neuprim.core.render.cuda.backend import render, render_slabs
from tests import scenes
from tests.core.render.cuda.waits import counted

SETTINGS = RenderSettings(backend="cuda", device="cpu", depth=True)


@pytest.mark.parametrize(
    ("kind", "expected"), [("plain", 1), ("float64", 2), ("network", 2), ("gradients", 2), ("slabs", 1), ("reads", 3)]
)
def test_a_frame_waits_this_often(kind: str, expected: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """The backward pass never does. "reads" has two more of the test's own, to show that they are counted."""
    t = scenes.tensors(60, 0, seed=5, **({"hidden": 3} if kind == "network" else {}))
    low, camera = scenes.lowered(t), scenes.camera(32, 32, distance=0.15 if kind == "float64" else 2.0)
    low.geometry.means.requires_grad_(kind == "gradients")
    genuine = backend.composite_frame

    def reading(frame: Any, *rest: Any, **more: Any) -> Any:
        assert float(frame.rows.sum()) != 0.5 and len(frame.rows[frame.rows > 0]) > 0
        return genuine(frame, *rest, **more)

    if kind == "reads":
        monkeypatch.setattr(backend, "composite_frame", reading)
    with torch.set_grad_enabled(kind == "gradients"), counted(monkeypatch) as waits:
        if kind == "slabs":
            render_slabs(low, torch.arange(60) % 4, 4, camera, SETTINGS)
        else:
            output = render(low, camera, None, SETTINGS)
            assert (output.stats.extra["float64"] > 0) == (kind == "float64")
        if kind == "gradients":
            output.rgb.sum().backward()
    assert len(waits) == expected, waits
    assert kind != "gradients" or bool(low.geometry.means.grad.any())  # type: ignore[union-attr]
