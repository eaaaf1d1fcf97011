"""What the cpu backend keeps: no state for a backward pass that will not come, no compiled code beside the sources."""

from __future__ import annotations

import gc
from pathlib import Path

import torch

import neuprim
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.cpu import backend
from neuprim.core.render.cpu.backward import backward_tiles
from neuprim.core.render.cpu.compile import cache_directory
from neuprim.core.render.cpu.forward import composite_tiles
from tests import scenes


def frames() -> int:
    gc.collect()
    return sum(type(x) is backend._Frame for x in gc.get_objects())


def test_a_frame_without_gradients_keeps_nothing() -> None:
    t = scenes.tensors(20)
    leaves = {k: v.requires_grad_() for k, v in t.items()}
    before = frames()
    with torch.no_grad():
        out = render_lowered(scenes.lowered(leaves), scenes.camera(24, 20), RenderSettings(backend="cpu"))
    assert frames() == before and out.rgb.grad_fn is None
    kept = render_lowered(scenes.lowered(leaves), scenes.camera(24, 20), RenderSettings(backend="cpu"))
    assert frames() == before + 1 and kept.rgb.grad_fn is not None


def test_compiled_kernels_lie_in_the_users_cache() -> None:
    """So that an installation nobody may write to keeps them too."""
    package = Path(neuprim.__file__).parent
    for kernel in (composite_tiles, backward_tiles):
        place = Path(kernel._cache.cache_path)
        assert place.is_relative_to(cache_directory()) and not place.is_relative_to(package)
