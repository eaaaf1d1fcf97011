"""Densities with a soft edge on the fast backends, in every case that hard ones are tested in, and the reference's own
gradients."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import pytest
import torch
from torch import Tensor

from neuprim.core.render import RenderSettings, render_lowered
from tests import scenes
from tests.backends import FAST, by
from tests.numerics.cases import CASES, case
from tests.numerics.compare import assert_same_frame
from tests.numerics.wild import render_block

EDGES = (1, 2)


@pytest.mark.parametrize(("edge", "name"), list(product(EDGES, CASES)))
@pytest.mark.parametrize("backend", FAST)
def test_equals_reference(backend: str, edge: int, name: str) -> None:
    t, camera, settings = case(name)
    t["w2"], t["b2"] = t["w2"] * 1.5, t["b2"] * 1.5  # about as opaque as with a hard edge
    with scenes.soft(edge):
        _, slow = assert_same_frame(t, camera, settings, backend=backend)
    assert slow.output.alpha.max() > 0.05, "the view must show something"


@pytest.mark.parametrize(("edge", "name"), list(product(EDGES, ["K=3 C=5", "inside", "near plane"])))
@pytest.mark.parametrize("backend", FAST)
def test_equals_reference_in_the_order_of_entries(backend: str, edge: int, name: str) -> None:
    t, camera, settings = case(name)
    with scenes.soft(edge):
        assert_same_frame(t, camera, replace(settings, sort="entry"), backend=backend)


@pytest.mark.parametrize(("edge", "view"), list(product(EDGES, [{}, {"distance": 0.15, "fov": 70.0}])))
@pytest.mark.parametrize("sort", ["center", "entry"])
@pytest.mark.parametrize("backend", FAST)
def test_equals_reference_under_colour_networks(backend: str, sort: str, edge: int, view: dict[str, float]) -> None:
    """Inside, where the near plane cuts chords, a colour moves with its chord's middle, and the density does not."""
    t = scenes.tensors(40, 3, seed=7, hidden=5)
    settings = RenderSettings(sort=sort, depth=True, near=0.05)  # type: ignore[arg-type]
    with scenes.soft(edge):
        fast, slow = assert_same_frame(t, scenes.camera(33, 25, **view), settings, backend=backend)
    assert slow.output.alpha.max() > 0.3 and (fast.output.stats.extra["float64"] > 3) == bool(view)


@pytest.mark.parametrize(
    ("edge", "neurons", "distance", "near"),
    [(1, 2, 3.0, 0.01), (2, 2, 3.0, 0.01), (2, 0, 0.4, 0.05), (1, 2, 0.4, 0.05), (2, 3, 3.0, 2.9)],
)
def test_reference_gradients_are_finite_differences(edge: int, neurons: int, distance: float, near: float) -> None:
    """Without a floor on grazing rays: a soft edge needs none."""
    t = scenes.tensors(5, neurons, seed=11, radius=0.4, dtype=torch.float64)
    t["b2"] = t["b2"] + 0.5
    camera = scenes.camera(7, 5, distance=distance, fov=50 if distance > 1 else 80, shift=(0.37, -0.21))
    settings = RenderSettings(
        backend="reference", near=near, alpha_min=1e-4, depth=True
    )  # the depth of a thin chord that is cut has no bounds
    g = torch.Generator().manual_seed(0)
    names = [k for k in t if t[k].numel()]
    w_rgb, w_z = (
        torch.randn(5, 7, 3, generator=g, dtype=torch.float64),
        torch.randn(5, 7, generator=g, dtype=torch.float64),
    )

    def functional(view: Tensor, *values: Tensor) -> Tensor:
        with scenes.soft(edge):
            low = scenes.lowered({**t, **dict(zip(names, values, strict=True))})
        out = render_lowered(low, replace(camera, viewmat=view), settings)
        assert out.depth is not None
        return (out.rgb * w_rgb).sum() + (out.alpha * w_z).sum() + (out.depth * w_z.flip(0)).sum()

    inputs = [camera.viewmat.clone(), *(t[k].clone() for k in names)]
    assert torch.autograd.gradcheck(functional, [x.requires_grad_() for x in inputs], eps=1e-7, atol=2e-6, rtol=1e-5)


def test_silhouettes_have_finite_gradients_without_a_floor() -> None:
    """dI/dD goes as D^(p - 1/2): the floor that tames a hard edge changes nothing."""
    t, camera, settings = case("many small")
    for backend in ("reference", *FAST):
        for edge in (0, 1, 2):
            grads = []
            for floor in (1e-12, 1e-2):
                leaves = {k: v.clone().requires_grad_() for k, v in t.items()}
                with scenes.soft(edge):
                    out = render_lowered(
                        scenes.lowered(leaves), camera, replace(settings, **by(backend), depth=False, depth_floor=floor)
                    )
                out.rgb.sum().backward()
                assert leaves["means"].grad is not None and bool(torch.isfinite(leaves["means"].grad).all())
                grads.append(leaves["means"].grad)
            assert torch.equal(*grads) == (edge > 0), (backend, edge)


@pytest.mark.parametrize("edge", EDGES)
@pytest.mark.parametrize("backend", FAST)
def test_wild_primitives_stay_finite(backend: str, edge: int) -> None:
    with scenes.soft(edge):
        assert max(render_block(seed, backend) for seed in range(6)) > 0.3
