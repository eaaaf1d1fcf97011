"""What the cpu backend keeps: no state for a backward pass that will not come, no compiled code beside the sources."""

from __future__ import annotations

import gc
import shutil
from pathlib import Path

import torch

import neuprim
from neuprim.core.compute.kernels import cache_directory, kernel_sources, sources_hash
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.cpu import backend
from neuprim.core.render.cpu.backward import backward_tiles
from neuprim.core.render.cpu.forward import composite_tiles
from tests import scenes
from tests.kernels import PACKAGE, frozen_into_kernels, kernel_modules


def frames() -> int:
    gc.collect()
    return sum(type(x) is backend._PreparedFrame for x in gc.get_objects())


def test_a_frame_without_gradients_keeps_nothing() -> None:
    t = scenes.tensors(20)
    leaves = {k: v.requires_grad_() for k, v in t.items()}
    before = frames()
    with torch.no_grad():
        out = render_lowered(scenes.lowered(leaves), scenes.camera(24, 20), RenderSettings(backend="cpu"))
    assert frames() == before and out.rgb.grad_fn is None
    kept = render_lowered(scenes.lowered(leaves), scenes.camera(24, 20), RenderSettings(backend="cpu"))
    assert frames() == before + 1 and kept.rgb.grad_fn is not None


def test_the_key_of_compiled_kernels_covers_all_that_is_in_them(tmp_path: Path) -> None:
    """An edit of any source that is compiled, inlined or frozen as a constant must not meet code compiled before."""
    uncovered, everything = {}, set()
    for module in kernel_modules():
        frozen = frozen_into_kernels(module)
        everything |= frozen
        if missing := frozen - kernel_sources(Path(module.__file__ or "")):
            uncovered[module.__name__] = missing
    assert uncovered == {}
    names = ("render/cpu/layout.py", "model/colour_constants.py", "model/edge.py")
    assert {PACKAGE / "core" / name for name in names} <= everything

    copy = tmp_path / "neuprim"
    shutil.copytree(PACKAGE, copy, ignore=lambda folder, names: {n for n in names if n.startswith("__pycache__")})
    forward = copy / "core" / "render" / "cpu" / "forward.py"

    def key() -> str:
        return sources_hash(forward, copy)

    before = key()
    assert before == sources_hash(PACKAGE / forward.relative_to(copy)), "it does not depend on the place"
    for name, changes in (
        ("core/model/edge.py", True),
        ("core/render/cpu/backend.py", False),
        ("tasks/static/__init__.py", False),
    ):
        file = copy / name
        text = file.read_bytes() if file.exists() else b""
        file.write_bytes(text + b"\n")
        assert (key() != before) is changes, name
        file.write_bytes(text)


def test_compiled_kernels_lie_in_the_users_cache() -> None:
    """So that an installation nobody may write to keeps them too."""
    package = Path(neuprim.__file__).parent
    for kernel in (composite_tiles, backward_tiles):
        place = Path(kernel._cache.cache_path)
        assert place.is_relative_to(cache_directory()) and not place.is_relative_to(package)
