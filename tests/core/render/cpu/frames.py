"""What the cpu backend keeps of a frame for its backward pass."""

from __future__ import annotations

import torch

from neuprim.core.cameras import Camera
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.cpu.backend import _PreparedFrame
from tests import scenes


def frame_of(t: dict[str, torch.Tensor], camera: Camera, threads: int = 1) -> _PreparedFrame:
    leaves = {k: v.clone().requires_grad_() for k, v in t.items()}
    node = render_lowered(scenes.lowered(leaves), camera, RenderSettings(backend="cpu", threads=threads)).rgb.grad_fn
    while not hasattr(node, "frame"):
        assert node is not None
        node = node.next_functions[0][0]
    frame: _PreparedFrame = node.frame
    return frame
