"""Random frames of 500 primitives against the float64 reference: images, gradients and contributions; and the memory of
a frame."""

from __future__ import annotations

import gc
import subprocess
import sys
from typing import Any

import pytest
import torch

pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")

from neuprim.core.render import RenderOutput, RenderSettings, render_lowered
from neuprim.core.render.cuda.backend import CompositedFrame
from neuprim.core.render.cuda.frame import Frame
from tests import scenes
from tests.backends import by


def frames_alive() -> int:
    gc.collect()
    return sum(type(x) in (CompositedFrame, Frame) for x in gc.get_objects())


def frame(backend: str = "cuda", **knobs: Any) -> tuple[RenderOutput, torch.Tensor]:
    leaves = {k: v.requires_grad_() for k, v in scenes.tensors(20).items()}
    settings = RenderSettings(**by(backend), **knobs)
    return render_lowered(scenes.lowered(leaves), scenes.camera(24, 20), settings), leaves["means"]


def test_a_frame_serves_one_backward_pass_and_then_frees_its_memory() -> None:
    before = frames_alive()
    with torch.no_grad():
        out, _ = frame()
    assert frames_alive() == before and out.rgb.grad_fn is None and out.stats.extra["hits"] == 0
    out, means = frame()
    assert frames_alive() == before + 2 and out.stats.extra["hits"] > 100
    out.rgb.sum().backward(retain_graph=True)
    assert frames_alive() == before + 1, "what the forward pass saved for each hit"
    assert means.grad is not None and bool(means.grad.any())
    with pytest.raises(RuntimeError, match="it runs once per frame"):
        out.rgb.sum().backward()
    del out
    assert frames_alive() == before


def test_without_warp_the_backend_says_how_to_install_it_and_the_others_draw() -> None:
    program = """
import sys
sys.modules["warp"] = None
from neuprim.core.errors import BackendUnavailable
from neuprim.core.render import RenderSettings, find_backend, render_lowered
from tests import scenes
low, camera = scenes.lowered(scenes.tensors(3)), scenes.camera(8, 8)
assert render_lowered(low, camera, RenderSettings()).stats.backend == "cpu"
assert find_backend("cuda").missing() == "Warp is not installed: pip install 'neuprim[cuda]'"
try:
    render_lowered(low, camera, RenderSettings(backend="cuda", device="cpu"))
except BackendUnavailable as error:
    assert "Warp is not installed: pip install 'neuprim[cuda]'" in str(error) and "\\n" not in str(error)
else:
    raise AssertionError("drawn")
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
