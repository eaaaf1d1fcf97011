"""Parts of a set of primitives are drawn as if each were alone, in one frame where the backend can."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core.errors import NonFiniteError
from neuprim.core.model.fields import Constant
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.slabs import render_slabs
from tests import scenes

COUNT = 4


def scene(kind: str) -> tuple[Lowered, Tensor, Any]:
    """Primitives before the camera, or around it, where many are drawn in float64; part 2 has none."""
    low = scenes.lowered(scenes.tensors(80, 1, seed=5))
    parts = torch.randint(0, COUNT, (80,), generator=torch.Generator().manual_seed(1))
    parts[parts == 2] = 3
    return low, parts, scenes.camera(37, 29, **({"distance": 0.15, "fov": 70.0} if kind == "inside" else {}))


def alone(low: Lowered, parts: Tensor, part: int, camera: Any, settings: RenderSettings) -> tuple[Tensor, Tensor]:
    rows = (parts == part).nonzero()[:, 0]
    own = Lowered(low.geometry[rows], low.density.rows(rows), Constant(torch.zeros(len(rows), 1)))
    output = render_lowered(own, camera, settings)
    assert output.depth is not None
    return output.alpha, output.depth


@pytest.mark.parametrize("kind", ["before", "inside"])
@pytest.mark.parametrize("backend", ["cpu", "cuda", "reference"])
@pytest.mark.parametrize("sort", ["center", "entry"])
def test_each_is_what_it_is_alone(backend: str, sort: Any, kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if backend == "cuda":
        pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")
    low, parts, camera = scene(kind)
    settings = RenderSettings(backend=backend, device="cpu", depth=True, sort=sort)
    wanted = [alone(low, parts, part, camera, settings) for part in (0, 1, 3)]
    frames = []
    genuine = render_lowered
    monkeypatch.setattr("neuprim.core.render.slabs.render_lowered", lambda *a: frames.append(1) or genuine(*a))
    alphas, depths = render_slabs(low.geometry, low.density, parts, COUNT, camera, settings)
    together = backend != "reference" and sort == "center"
    assert len(frames) == (0 if together else 3) and len(alphas) == len(depths) == (4 if together else 3)
    if together:
        assert not alphas[2].any() and not depths[2].any()
        alphas, depths = alphas[[0, 1, 3]], depths[[0, 1, 3]]
    assert all(float(alpha.max()) > 0.3 for alpha, _ in wanted)
    assert all(torch.equal(a, b) for a, (b, _) in zip(alphas, wanted, strict=True))
    assert all(torch.equal(a, b) for a, (_, b) in zip(depths, wanted, strict=True))


def test_one_frame_launches_its_kernels_once(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")
    from neuprim.core.render.cuda import passes

    low, parts, camera = scene("before")
    names: list[str] = []
    genuine = passes.launch
    monkeypatch.setattr(passes, "launch", lambda kernel, *rest: names.append(kernel.key) or genuine(kernel, *rest))
    render_slabs(
        low.geometry, low.density, parts, COUNT, camera, RenderSettings(backend="cuda", device="cpu", depth=True)
    )
    assert sum("forward" in name for name in names) == 1 and len(names) <= 3


@pytest.mark.parametrize("backend", ["cpu", "cuda"])
def test_what_is_not_finite_has_its_number_among_all(backend: str) -> None:
    if backend == "cuda":
        pytest.importorskip("warp", reason="the cuda backend is written in Warp: pip install 'neuprim[cuda]'")
    low, parts, camera = scene("before")
    parts[41] = 3
    with torch.no_grad():
        low.geometry.means[41, 0] = torch.nan
    with pytest.raises(NonFiniteError, match=r"^means of primitive 41 is not finite"):
        render_slabs(
            low.geometry, low.density, parts, COUNT, camera, RenderSettings(backend=backend, device="cpu", depth=True)
        )
