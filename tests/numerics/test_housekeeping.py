"""What the cpu backend keeps: no state for a backward pass that will not come, no compiled code beside the sources."""

from __future__ import annotations

import gc
from pathlib import Path

import torch

import neuprim
from neuprim.core.compute.kernels import cache_directory, sources_hash
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.cpu import backend
from neuprim.core.render.cpu.backward import backward_tiles
from neuprim.core.render.cpu.forward import composite_tiles
from tests import scenes
from tests.kernels import PACKAGE, frozen_into_kernels


def frames() -> int:
    gc.collect()
    return sum(type(x) is backend._Prepared for x in gc.get_objects())


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
    frozen = {file.relative_to(PACKAGE) for file in frozen_into_kernels()}
    assert {
        Path(p)
        for p in (
            "core/render/cpu/layout.py",
            "core/model/colours/sh_constants.py",
            "core/model/colours/sh_cpu.py",
            "core/volumes/grid.py",
        )
    } <= frozen
    copy = tmp_path / "neuprim"
    for source in PACKAGE.rglob("*.py"):
        target = copy / source.relative_to(PACKAGE)
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(source.read_bytes())

    def key() -> str:
        sources_hash.cache_clear()
        return sources_hash(copy)

    before = key()
    assert before == sources_hash(PACKAGE)
    unnoticed = []
    for name in sorted(frozen):
        text = (copy / name).read_bytes()
        (copy / name).write_bytes(text + b"\n")
        unnoticed += [str(name)] * (key() == before)
        (copy / name).write_bytes(text)
    assert unnoticed == []
    (copy / "cli" / "__init__.py").write_bytes(b"")
    assert key() == before, "what is not compiled costs nobody a minute"


def test_compiled_kernels_lie_in_the_users_cache() -> None:
    """So that an installation nobody may write to keeps them too."""
    package = Path(neuprim.__file__).parent
    for kernel in (composite_tiles, backward_tiles):
        place = Path(kernel._cache.cache_path)
        assert place.is_relative_to(cache_directory()) and not place.is_relative_to(package)
