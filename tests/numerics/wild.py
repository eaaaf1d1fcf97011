"""Wild but finite primitives: every parameter over many decades."""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.render import RenderSettings, render_lowered
from tests import scenes
from tests.backends import by

BLOCK = 2000


def wild(seed: int, count: int = BLOCK) -> dict[str, Tensor]:
    """Every parameter over many decades, signs at random; a third of the blocks has everyday densities, so that light
    gets through."""
    g = torch.Generator().manual_seed(seed)

    def u(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(count, *shape, generator=g, dtype=torch.float64) * (high - low) + low

    def spread(low: float, high: float, *shape: int) -> Tensor:
        return 10 ** u(low, high, *shape) * torch.sign(u(-1, 1, *shape))

    neurons = (0, 1, 3, 8)[seed % 4]
    dense = (-3.0, 0.0) if seed % 3 == 0 else (-8.0, 8.0)
    t = {
        "means": spread(-3, 5, 3),
        "log_scales": u(-30, 12, 1) + u(-12, 0, 3),
        "quats": spread(-2, 0, 4) * 10 ** u(-15, 15, 1),
        "W1": spread(-8, 6, neurons, 3),
        "b1": spread(-6, 7, neurons),
        "w2": spread(*dense, neurons),
        "b2": spread(*dense, 1),
        "colors": spread(-3, 4, 3),
    }
    near = torch.rand(count, generator=g) < 0.5  # half of them around the origin, where the camera looks
    t["means"][near] = u(-1, 1, 3)[near]
    return {k: v.float() for k, v in t.items()}


def render_block(seed: int, backend: str = "cpu") -> float:
    """Draw a block from inside or outside and go back; returns the largest opacity."""
    t = {k: v.requires_grad_() for k, v in wild(seed).items()}
    camera = scenes.camera(40, 32, distance=(0.1, 3.0, 50.0)[seed % 3], fov=(40.0, 120.0)[seed % 2])
    knobs = {"alpha_min": 0.0, "transmittance_min": 0.0} if seed % 5 == 0 else {}
    out = render_lowered(scenes.lowered(t), camera, RenderSettings(**by(backend), depth=seed % 2 == 0, **knobs))
    assert torch.isfinite(out.rgb).all() and torch.isfinite(out.alpha).all(), f"image of block {seed}"
    total = out.rgb.sum() + out.alpha.sum()
    if out.depth is not None:
        assert torch.isfinite(out.depth).all(), f"depth of block {seed}"
        total = total + out.depth.sum()
    total.backward()
    for name, value in t.items():
        if value.numel():
            assert value.grad is not None
            bad = (~torch.isfinite(value.grad.reshape(len(value), -1)).all(dim=1)).nonzero().flatten()
            assert not len(bad), (
                f"gradient of {name} of primitive {int(bad[0])} of block {seed} ({len(bad)} of {len(value)})"
            )
    return float(out.alpha.detach().max())
