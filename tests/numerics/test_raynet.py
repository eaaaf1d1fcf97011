"""Colours that vary per pixel, :class:`RayNet`: the cpu backend against the float64 reference, the reference against
finite differences."""

from __future__ import annotations

import pytest
import torch

from neuprim.core.render import RenderSettings, render_lowered
from tests import scenes
from tests.backends import BACKENDS, FAST, by
from tests.numerics.equivalence import draw

NET = ("Wx", "bias", "Wout", "base")
ORDERS = ("center", "entry")


# ---------------------------------------------------------------- constants


@pytest.mark.parametrize("sort", ORDERS)
@pytest.mark.parametrize("hidden", [0, 3])
def test_without_units_or_weights_it_is_the_constant(hidden: int, sort: str) -> None:
    t = scenes.tensors(40, 4, seed=2, hidden=hidden)
    t["Wout"] *= 0
    camera, plain = scenes.camera(33, 25), {k: v for k, v in t.items() if k not in NET}
    plain["colors"] = t["base"].clamp_min(0)
    assert 0.02 < (t["base"] < 0).float().mean() < 0.5
    for backend in BACKENDS:
        net, constant = (draw(backend, x, camera, RenderSettings(sort=sort)) for x in (t, plain))  # type: ignore[arg-type]
        assert (net.output.rgb - constant.output.rgb).abs().max() < 1e-6
        for name in ("means", "log_scales", "quats", "W1", "b1", "w2", "b2", "viewmat"):
            assert torch.allclose(net.grads[name], constant.grads[name], rtol=1e-3, atol=1e-5), name
        shown = t["base"] >= 0
        assert torch.allclose(net.grads["base"], constant.grads["colors"] * shown, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("sort", ORDERS)
@pytest.mark.parametrize("backend", BACKENDS)
def test_negative_colours_are_black_and_pass_no_gradient(backend: str, sort: str) -> None:
    t = scenes.tensors(40, 4, seed=2, hidden=5)
    t["base"] -= 10.0
    leaves = {k: v.requires_grad_() for k, v in t.items()}
    out = render_lowered(scenes.lowered(leaves), scenes.camera(33, 25), RenderSettings(**by(backend), sort=sort))  # type: ignore[arg-type]
    assert out.alpha.max() > 0.3 and out.rgb.abs().max() == 0
    out.rgb.sum().backward()
    assert all(v.grad is not None and v.grad.abs().max() == 0 for v in leaves.values())


# ---------------------------------------------------------------- choice and refusals


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("name", NET)
def test_denormals_and_huge_phases_are_drawn(name: str, backend: str) -> None:
    for value in (1e-42, 1e30 if name in ("Wx", "bias") else 1e6):
        leaves = {k: v.requires_grad_() for k, v in scenes.tensors(20, hidden=3).items()}
        with torch.no_grad():
            leaves[name][5] = value
        out = render_lowered(scenes.lowered(leaves), scenes.camera(20, 20), RenderSettings(**by(backend)))
        assert torch.isfinite(out.rgb).all() and out.alpha.max() > 0.2
        out.rgb.sum().backward()
        assert all(v.grad is not None and torch.isfinite(v.grad).all() for v in leaves.values())


@pytest.mark.parametrize("backend", FAST)
def test_double_precision_models(backend: str) -> None:
    t, camera = scenes.tensors(30, 3, seed=5, hidden=4), scenes.camera(30, 22)
    wide = {k: v.double().requires_grad_() for k, v in t.items()}
    out = render_lowered(scenes.lowered(wide), camera, RenderSettings(**by(backend)))
    assert out.rgb.dtype == torch.float64
    out.rgb.sum().backward()
    assert wide["Wx"].grad is not None and wide["Wx"].grad.dtype == torch.float64
    assert (out.rgb - render_lowered(scenes.lowered(t), camera, RenderSettings(**by(backend))).rgb).abs().max() < 2e-6
