"""How often the CPU waits for a GPU in a frame: whatever makes a Python number, or a shape, of a tensor."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.render import RenderSettings
from neuprim.core.render.cuda import backend
from neuprim.core.render.cuda.backend import render, render_slabs
from tests import scenes

SETTINGS = RenderSettings(backend="cuda", device="cpu", depth=True)
SHAPES = ("aten::nonzero", "aten::masked_select", "aten::equal", "aten::_local_scalar_dense")


@contextmanager
def counted(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """What waited, by name."""
    waits: list[str] = []

    class Operations(TorchDispatchMode):
        def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
            name = func._schema.name
            mask = name == "aten::index" and any(x is not None and x.dtype == torch.bool for x in args[1])
            sized = name == "aten::repeat_interleave" and "output_size" not in (kwargs or {})
            if name in SHAPES or mask or sized:
                waits.append(name)
            return func(*args, **(kwargs or {}))

    genuine = Tensor.tolist
    with monkeypatch.context() as patch, Operations():
        patch.setattr(Tensor, "tolist", lambda self: waits.append("tolist") or genuine(self))
        yield waits


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
