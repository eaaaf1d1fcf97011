"""Slabs of a set of primitives are drawn as if each were alone, in one frame where the backend can."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from neuprim.core.errors import NonFiniteError
from neuprim.core.model.fields import Constant
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import RenderSettings, render_lowered, render_slabs
from tests import scenes
from tests.backends import BACKENDS

COUNT = 4


def scene(distance: float, fov: float) -> tuple[LoweredPrimitives, Tensor, Any]:
    """Before the camera, or around it, where many are drawn in float64; slab 2 has no primitives."""
    low = scenes.lowered(scenes.tensors(80, seed=5))
    slabs = torch.randint(0, COUNT, (80,), generator=torch.Generator().manual_seed(1))
    slabs[slabs == 2] = 3
    return low, slabs, scenes.camera(37, 29, distance=distance, fov=fov)


@pytest.mark.parametrize(("distance", "fov"), [(3.0, 45.0), (0.15, 70.0)])
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("sort", ["center", "entry"])
def test_each_is_what_it_is_alone(
    backend: str, sort: Any, distance: float, fov: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    low, slabs, camera = scene(distance, fov)
    settings = RenderSettings(backend=backend, device="cpu", depth=True, sort=sort)
    wanted = []
    for slab in (0, 1, 3):
        rows = (slabs == slab).nonzero()[:, 0]
        alone = LoweredPrimitives(
            low.geometry[rows], low.density.primitive_rows(rows), Constant(torch.zeros(len(rows), 1))
        )
        wanted.append(render_lowered(alone, camera, settings))
    frames = []
    genuine = render_lowered
    monkeypatch.setattr("neuprim.core.render.render_lowered", lambda *a: frames.append(1) or genuine(*a))
    alphas, depths = render_slabs(low.geometry, low.density, slabs, COUNT, camera, settings)
    if backend != "reference" and sort == "center":
        assert not frames and not alphas[2].any() and not depths[2].any()
        alphas, depths = alphas[[0, 1, 3]], depths[[0, 1, 3]]
    assert len(alphas) == len(depths) == 3 and all(float(one.alpha.max()) > 0.3 for one in wanted)
    assert torch.equal(alphas, torch.stack([one.alpha for one in wanted]))
    assert torch.equal(depths, torch.stack([one.depth for one in wanted if one.depth is not None]))


@pytest.mark.parametrize("backend", BACKENDS)
def test_what_is_not_finite_has_its_number_among_all(backend: str) -> None:
    low, slabs, camera = scene(3.0, 45.0)
    slabs[41], low.geometry.means[41, 0] = 3, torch.nan
    settings = RenderSettings(backend=backend, device="cpu", depth=True)
    with pytest.raises(NonFiniteError, match=r"^means of primitive 41 is not finite"):
        render_slabs(low.geometry, low.density, slabs, COUNT, camera, settings)
