"""Silhouettes of the visible extent: nothing that is drawn is lost by them, and what is invisible is not evaluated."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from numba import njit
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.edge import NORMS
from neuprim.core.model.geometry import quaternion_to_matrix
from neuprim.core.render import RenderSettings, render_lowered
from neuprim.core.render.cpu.prepare import _is_too_faint_to_draw, _visible_square
from neuprim.core.render.layout import MIN_RIM
from tests import scenes
from tests.numerics.equivalence import assert_same_frame

SETTINGS = RenderSettings(backend="cpu")
ALPHA_MIN = SETTINGS.alpha_min


square = njit(lambda most, longest, edge, least: _visible_square(most, longest, edge, least))
faint = njit(lambda most, edge, least: _is_too_faint_to_draw(most, edge, least))


def half_chords(t: dict[str, Tensor], camera: Camera) -> Tensor:
    """(N,) half chords of the rays through the centres, in units of the longest semi-axis."""
    eye = -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]
    towards = torch.nn.functional.normalize(t["means"].double() - eye, dim=-1)
    scales = t["log_scales"].double().exp()
    whitened = torch.einsum("nij,ni->nj", quaternion_to_matrix(t["quats"].double()), towards) / scales
    return 1.0 / (whitened.norm(dim=-1) * scales.amax(-1))


def barely_visible(
    camera: Camera, edge: int, neurons: int, seed: int, alpha_min: float, spread: float
) -> dict[str, Tensor]:
    """Needles, discs and balls whose deepest rays have 1.03 to 4 times the optical depth of ``alpha_min``, so that some
    or few of them count."""
    t = scenes.tensors(40, neurons, seed=seed, dtype=torch.float64)
    g = torch.Generator().manual_seed(seed)
    t["log_scales"] += spread * (torch.rand(40, 3, generator=g, dtype=torch.float64) - 0.7)
    t["W1"] *= 0.02  # cosines that are nearly constant: the bound is nearly met
    t["b1"] *= 0.01
    t["w2"] = t["w2"].abs()
    wanted = 1.03 + 3.0 * torch.rand(40, generator=g, dtype=torch.float64) ** 3
    most = -math.log1p(-alpha_min) * wanted / (NORMS[edge] * half_chords(t, camera))
    share = most / (t["b2"].abs()[:, 0] + t["w2"].sum(-1))
    t["b2"], t["w2"] = t["b2"].abs() * share[:, None], t["w2"] * share[:, None]
    return {name: value.float() for name, value in t.items()}


@pytest.mark.parametrize("edge", [0, 1, 2])
@pytest.mark.parametrize(
    ("view", "neurons", "alpha_min", "spread", "sort"),
    [
        ({}, 2, ALPHA_MIN, 5.0, "center"),
        ({"distance": 1.3, "fov": 90.0}, 8, ALPHA_MIN, 5.0, "center"),
        ({"fov": 12.0, "shift": (40.0, -30.0), "distance": 6.0}, 0, ALPHA_MIN, 3.0, "center"),
        ({}, 2, 0.2, 2.0, "center"),
        ({"distance": 2.0}, 2, ALPHA_MIN, 3.0, "entry"),
    ],
)
def test_rays_that_count_are_drawn(
    edge: int, view: dict[str, float], neurons: int, alpha_min: float, spread: float, sort: str
) -> None:
    camera = scenes.camera(96, 72, **view)  # type: ignore[arg-type]
    settings = RenderSettings(backend="cpu", alpha_min=alpha_min, sort=sort)
    for seed in range(2):
        t = barely_visible(camera, edge, neurons, seed, alpha_min, spread)
        with scenes.soft(edge):
            fast, _ = assert_same_frame(t, camera, settings, grad_bound=5e-3 if edge == 0 else 1e-3)
            whole = render_lowered(scenes.lowered(t), camera, RenderSettings(backend="cpu", alpha_min=0.0, sort=sort))
        assert (fast.output.alpha > 0).float().mean() > 0.003
        assert 0 < fast.output.stats.extra["forward_lanes"] < whole.stats.extra["forward_lanes"]


@pytest.mark.parametrize("edge", [0, 1, 2])
def test_what_cannot_be_seen_costs_nothing(edge: int) -> None:
    camera = scenes.camera()
    t = barely_visible(camera, edge, 2, 0, ALPHA_MIN, 1.0)
    t["b2"], t["w2"] = t["b2"] * 0.05, t["w2"] * 0.05
    leaves = {name: value.requires_grad_() for name, value in t.items()}
    with scenes.soft(edge):
        out = render_lowered(scenes.lowered(leaves), camera, SETTINGS)
    out.rgb.sum().backward()
    assert out.stats.pairs == 0 and not out.alpha.any()
    assert all(not leaf.grad.any() for leaf in leaves.values() if leaf.grad is not None)


@pytest.mark.parametrize("edge", [0, 1, 2])
def test_the_radius_is_where_the_bound_meets_the_depth(edge: int) -> None:
    for inner in np.linspace(1.5 * MIN_RIM, 0.99, 20):
        least = 0.7 * NORMS[edge] * 0.3 * inner ** (edge + 0.5)
        assert square(0.7, 0.3, edge, least) == pytest.approx(1.0 - inner, abs=1e-6)
    assert square(0.7, 0.3, edge, 0.7 * NORMS[edge] * 0.3 * 1.0001) == 0.0
    assert square(0.7, 0.3, edge, 0.7 * NORMS[edge] * 0.3 * (0.9 * MIN_RIM) ** (edge + 0.5)) == 1.0
    assert square(0.7, 0.3, edge, 0.0) == 1.0


@pytest.mark.parametrize("edge", [0, 1, 2])
def test_what_is_too_faint_wherever_it_is(edge: int) -> None:
    assert faint(0.0, edge, 0.0) and faint(-1.0, edge, 0.0) and not faint(1e-30, edge, 0.0)
    assert faint(0.01 / NORMS[edge], edge, 0.01) and not faint(0.0101 / NORMS[edge], edge, 0.01)
    assert not faint(math.nan, edge, 0.01) and not faint(math.inf, edge, 0.01)
