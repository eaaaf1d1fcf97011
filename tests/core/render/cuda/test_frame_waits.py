"""How often the processor would wait for a card in a frame: whatever makes a number of Python's, or a shape, of a
tensor."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.model.primitives import Lowered
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


def scene(hidden: int | None = None, distance: float = 2.0) -> tuple[Lowered, Any]:
    """Without primitives in float64, but for cameras near them."""
    t = scenes.tensors(60, 0, seed=5, **({} if hidden is None else {"hidden": hidden}))
    return scenes.lowered(t), scenes.camera(32, 32, distance=distance)


def test_a_frame_without_gradients_waits_once(monkeypatch: pytest.MonkeyPatch) -> None:
    low, camera = scene()
    with torch.no_grad(), counted(monkeypatch) as waits:
        output = render(low, camera, None, SETTINGS)
    assert output.stats.extra["float64"] == 0 and len(waits) == 1, waits


def test_one_with_gradients_twice_and_its_backward_pass_never(monkeypatch: pytest.MonkeyPatch) -> None:
    low, camera = scene()
    low.geometry.means.requires_grad_()
    with counted(monkeypatch) as waits:
        output = render(low, camera, None, SETTINGS)
        assert len(waits) == 2, waits
        output.rgb.sum().backward()
        assert len(waits) == 2, waits
    assert low.geometry.means.grad is not None and bool(low.geometry.means.grad.any())


def test_primitives_in_float64_and_colour_networks_add_one_each(monkeypatch: pytest.MonkeyPatch) -> None:
    low, camera = scene(distance=0.15)
    with torch.no_grad(), counted(monkeypatch) as waits:
        output = render(low, camera, None, SETTINGS)
    assert output.stats.extra["float64"] > 0 and len(waits) == 2, waits
    low, camera = scene(hidden=3)
    with torch.no_grad(), counted(monkeypatch) as waits:
        render(low, camera, None, SETTINGS)
    assert len(waits) == 2, waits


def test_parts_in_one_frame_wait_once(monkeypatch: pytest.MonkeyPatch) -> None:
    low, camera = scene()
    parts = torch.arange(60) % 4
    with torch.no_grad(), counted(monkeypatch) as waits:
        render_slabs(low, parts, 4, camera, SETTINGS)
    assert len(waits) == 1, waits


def test_a_wait_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    low, camera = scene()
    genuine = backend.forward

    def waiting(frame: Any, *rest: Any) -> Any:
        assert float(frame.rows.sum()) != 0.5 and len(frame.rows[frame.rows > 0]) > 0
        return genuine(frame, *rest)

    monkeypatch.setattr(backend, "forward", waiting)
    with torch.no_grad(), counted(monkeypatch) as waits:
        render(low, camera, None, SETTINGS)
    assert len(waits) == 3, waits
