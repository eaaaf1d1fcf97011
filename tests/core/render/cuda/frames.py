"""Frames of the cuda backend for tests of its kernels: a scene's image, gradients and sums, and the kernels' launches
on the way."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core.compute.warp import array
from neuprim.core.render import RenderSettings
from neuprim.core.render.cuda import backward, forward
from tests import scenes
from tests.backends import by
from tests.numerics.equivalence import draw

Launch = Callable[..., None]

SCENES: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "center, depth": ({"neurons": 8}, {}, {"depth": True}),
    "soft edge": ({"neurons": 2, "channels": 5, "edge": 2}, {"width": 61, "height": 47}, {}),
    "inside": ({"neurons": 8}, {"distance": 0.15, "fov": 70.0}, {"depth": True}),
    "colour networks": ({"neurons": 3, "hidden": 5}, {"distance": 0.5, "fov": 80.0, "near": 0.05}, {"depth": True}),
    "entry": ({"neurons": 8, "edge": 2}, {"distance": 0.5, "fov": 60.0}, {"sort": "entry", "depth": True}),
}
"""Model, view and settings: pairs in float32 and float64, tiles that end early, sizes that are no multiples of a
tile."""


def everything(name: str, count: int = 300) -> dict[str, Tensor]:
    """All that a frame gives: images, gradients of every tensor, the view and the background, and the sums over what
    was watched."""
    model, view, knobs = (dict(part) for part in SCENES[name])
    edge = model.pop("edge", 0)
    knobs |= {key: view.pop(key) for key in ("near",) if key in view}
    t = scenes.tensors(**{"count": count, "seed": 5, "radius": 0.25, **model})
    camera = scenes.camera(**{"width": 64, "height": 64, **view})
    with scenes.soft(edge):
        frame = draw("cuda", t, camera, replace(RenderSettings(), **by("cuda"), **knobs))
    images = {
        "rgb": frame.output.rgb,
        "alpha": frame.output.alpha,
        **({"depth": frame.output.depth} if "depth" in knobs else {}),
    }
    sums = {"weight": frame.tally.weight, "error": frame.tally.error_weight}
    return {**{k: v.detach() for k, v in images.items() if v is not None}, **frame.grads, **sums}


def assert_same_bits(one: dict[str, Tensor], other: dict[str, Tensor]) -> None:
    assert one.keys() == other.keys()
    different = [name for name, value in one.items() if not torch.equal(value, other[name])]
    assert not different and all(bool(torch.isfinite(value).all()) for value in one.values()), different


class Args:
    """A launch's arguments by the names that its kernel gives them."""

    def __init__(self, kernel: Any, inputs: Sequence[Any]) -> None:
        self.names = [arg.label for arg in kernel.adj.args]
        self.values = list(inputs)
        assert len(self.names) == len(self.values)

    def __contains__(self, name: str) -> bool:
        return name in self.names

    def tensor(self, name: str) -> Tensor:
        found: Tensor = self.values[self.names.index(name)].tensor
        return found

    def with_tensors(self, **tensors: Tensor) -> list[Any]:
        """The same with other memory in the place of some."""
        values = list(self.values)
        for name, tensor in tensors.items():
            at = self.names.index(name)
            assert tensor.is_contiguous() and tensor.shape == values[at].tensor.shape
            values[at] = array(tensor, values[at].dtype)
        return values


def intercept(
    monkeypatch: pytest.MonkeyPatch, wrapped: Callable[[Launch, Any, Any, Sequence[Any], torch.device, int], None]
) -> None:
    """Have every launch of the pixel kernels go through ``wrapped(launch, kernel, dim, inputs, device, block)``."""
    genuine = forward.launch_kernel

    def through(kernel: Any, dim: Any, inputs: Sequence[Any], device: torch.device, block: int = 256) -> None:
        wrapped(genuine, kernel, dim, inputs, device, block)

    for module in (forward, backward):
        monkeypatch.setattr(module, "launch_kernel", through)
