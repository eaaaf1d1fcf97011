"""Wild but finite primitives by the thousand, every parameter over many decades: images and gradients stay finite."""

from __future__ import annotations

import sys

import pytest
import torch
from torch import Tensor

from neuprim.core.render import RenderSettings, render_lowered
from tests import scenes
from tests.backends import FAST, SLOW_HERE, by

BLOCK = 2000


def wild_primitives(seed: int) -> dict[str, Tensor]:
    """Half of them lie around the origin, where the camera looks. Every third block has everyday densities."""
    g = torch.Generator().manual_seed(seed)

    def u(low: float, high: float, *shape: int) -> Tensor:
        return torch.rand(BLOCK, *shape, generator=g, dtype=torch.float64) * (high - low) + low

    def spread(low: float, high: float, *shape: int) -> Tensor:
        return 10 ** u(low, high, *shape) * torch.sign(u(-1, 1, *shape))

    neurons = (8, 8, 0, 1, 3)[seed % 5]
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
    near = torch.rand(BLOCK, generator=g) < 0.5
    t["means"][near] = u(-1, 1, 3)[near]
    return {k: v.float() for k, v in t.items()}


def largest_opacity(seed: int, backend: str) -> float:
    """Draw a block from inside or outside, differentiate it, and check that every number is finite."""
    t = {k: v.requires_grad_() for k, v in wild_primitives(seed).items()}
    camera = scenes.camera(40, 32, distance=(0.1, 3.0, 50.0)[seed % 3], fov=(40.0, 120.0)[seed % 2])
    knobs = {"alpha_min": 0.0, "transmittance_min": 0.0} if seed % 4 == 0 else {}
    out = render_lowered(scenes.lowered(t), camera, RenderSettings(**by(backend), depth=seed % 2 == 0, **knobs))
    images = [image for image in (out.rgb, out.alpha, out.depth) if image is not None]
    assert all(bool(torch.isfinite(image).all()) for image in images), f"image of block {seed}"
    torch.stack([image.sum() for image in images]).sum().backward()
    for name, value in t.items():
        if value.numel():
            assert value.grad is not None
            bad = (~torch.isfinite(value.grad.reshape(BLOCK, -1)).all(dim=1)).nonzero().flatten().tolist()
            assert not bad, f"gradient of {name} of {len(bad)} primitives of block {seed}, the first is {bad[0]}"
    return float(out.alpha.detach().max())


@pytest.mark.parametrize("edge", [0, pytest.param(1, marks=pytest.mark.slow), 2])
@pytest.mark.parametrize("backend", FAST)
def test_twenty_thousand_wild_primitives(backend: str, edge: int) -> None:
    """A GPU's backend on a CPU draws blocks of 8 neurons alone, for which other tests compile kernels too."""
    with scenes.soft(edge):
        blocks = [seed for seed in range(10) if backend not in SLOW_HERE or seed % 5 < 2]
        assert max(largest_opacity(seed, backend) for seed in blocks) > (0.3 if edge else 0.5)


@pytest.mark.slow
@pytest.mark.parametrize("backend", [b for b in FAST if b not in SLOW_HERE])
def test_a_million_wild_primitives(backend: str) -> None:
    assert max(largest_opacity(seed, backend) for seed in range(500)) > 0.5
    if sys.platform == "linux":
        import resource

        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss < 4 * 2**20, "KiB"
