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
from neuprim.core.render.cuda.frame import Frame
from neuprim.core.render.cuda.passes import Composited
from tests import scenes
from tests.backends import by
from tests.numerics.equivalence import assert_same_frame

FRAMES: dict[str, tuple[int, int, int, dict[str, Any], dict[str, Any]]] = {
    "K=0": (0, 0, 3, {}, {"depth": True}),
    "K=2 p=2 C=5": (2, 2, 5, {"width": 61, "height": 47}, {}),
    "K=8 p=1 C=1, inside": (8, 1, 1, {"distance": 0.15, "fov": 70.0}, {"near": 0.05}),
    "K=16 p=2": (16, 2, 3, {"distance": 2.0}, {}),
    "K=8 p=2, entry": (8, 2, 3, {}, {"sort": "entry"}),
}


@pytest.mark.parametrize("name", FRAMES)
def test_a_frame_is_the_references(name: str) -> None:
    neurons, edge, channels, view, knobs = FRAMES[name]
    t = scenes.tensors(500, neurons, channels, seed=13, radius=0.15)
    t["w2"] *= 0.5
    camera, settings = scenes.camera(**{"width": 64, "height": 64, **view}), RenderSettings(**knobs)
    with scenes.soft(edge):
        fast, slow = assert_same_frame(t, camera, settings, backend="cuda")
    assert slow.output.alpha.mean() > 0.1 and fast.output.stats.pairs > 1000
    for a, b in ((fast.tally.weight, slow.tally.weight), (fast.tally.error_weight, slow.tally.error_weight)):
        assert (a - b).abs().max() <= 2e-5 * b.max() + 4 / 255


def frames_alive() -> int:
    gc.collect()
    return sum(type(x) in (Composited, Frame) for x in gc.get_objects())


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


@pytest.mark.parametrize("part", ["alpha", "depth"])
def test_gradients_of_one_image_alone(part: str) -> None:
    grads = []
    for backend in ("cuda", "cpu"):
        out, means = frame(backend, depth=True)
        (getattr(out, part) * (out.alpha.detach() > 0.1)).sum().backward()
        grads.append(means.grad)
    assert bool(grads[1].any()) and (grads[0] - grads[1]).norm() <= 1e-4 * grads[1].norm()  # type: ignore[union-attr, operator]


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
