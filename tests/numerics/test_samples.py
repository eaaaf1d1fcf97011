"""Several rays per pixel: the mean of a finer image, with gradients and training statistics."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.render import RenderOutput, RenderSettings, render_lowered
from tests import scenes
from tests.backends import BACKENDS, by

SETTINGS = RenderSettings(depth=True)
SKY = torch.tensor([0.3, 0.6, 0.1])
CAMERA = scenes.camera(20, 15, shift=(2.3, -1.1))


def frame(t: dict[str, Tensor], settings: RenderSettings, scale: int = 1) -> RenderOutput:
    return render_lowered(scenes.lowered(t), CAMERA.resized(20 * scale, 15 * scale), settings, SKY)


def leaves() -> dict[str, Tensor]:
    return {k: v.requires_grad_() for k, v in scenes.tensors(40, seed=6).items()}


def blocks(image: Tensor, n: int) -> Tensor:
    """(15, 20, n * n) sub-pixels of every pixel."""
    return torch.stack([image[a::n, b::n] for a in range(n) for b in range(n)], -1)


@pytest.mark.parametrize("sort", ["center", "entry"])
@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("n", [2, 3])
def test_means_of_a_finer_image(backend: str, sort: str, n: int) -> None:
    settings = replace(SETTINGS, **by(backend), sort=sort)  # type: ignore[arg-type]
    first, second = leaves(), leaves()
    out, fine = frame(first, replace(settings, samples=n)), frame(second, settings, n)
    assert (
        out.rgb.shape == (15, 20, 3)
        and out.alpha.shape == (15, 20)
        and out.depth is not None
        and fine.depth is not None
    )
    rgb, alpha = torch.stack([blocks(fine.rgb[..., c], n).mean(-1) for c in range(3)], -1), blocks(fine.alpha, n)
    depth = (blocks(fine.depth, n) * alpha).sum(-1) / alpha.sum(-1).clamp_min(1e-30)
    assert (out.rgb - rgb).abs().max() < 1e-6 and (out.alpha - alpha.mean(-1)).abs().max() < 1e-6
    assert (out.depth - depth).abs().max() < 2e-6
    plain = frame(leaves(), settings)
    assert (plain.rgb - out.rgb).abs().max() > 0.02, "edges must be smoother than with one ray"
    weight = torch.randn(15, 20, 3, generator=torch.Generator().manual_seed(0))
    error = torch.rand(15, 20, generator=torch.Generator().manual_seed(1))
    a = out.request_contributions(error)
    b = fine.request_contributions(error.repeat_interleave(n, 0).repeat_interleave(n, 1))
    (out.rgb * weight).sum().backward()
    (rgb * weight).sum().backward()
    for k in first:
        assert torch.allclose(first[k].grad, second[k].grad, rtol=1e-4, atol=1e-6), k  # type: ignore[arg-type]
    assert a.weight.max() > 1
    assert torch.allclose(a.weight, b.weight / n**2) and torch.allclose(a.error_weight, b.error_weight / n**2)
    assert out.stats.backend == backend and out.stats.pairs == fine.stats.pairs


@pytest.mark.parametrize("backend", BACKENDS)
def test_only_what_is_watched_is_summed(backend: str) -> None:
    """A tally is zeros until the backward pass; a second one takes the place of the first."""
    out = frame(leaves(), replace(SETTINGS, **by(backend), samples=2))
    first = out.request_contributions(torch.ones(15, 20))
    second = out.request_contributions(torch.full((15, 20), 0.25, requires_grad=True))
    assert second.weight.shape == second.error_weight.shape == (40,) and second.weight.abs().max() == 0
    out.rgb.sum().backward()
    assert first.weight.abs().max() == 0 and second.weight.max() > 1
    assert torch.allclose(second.error_weight, 0.25 * second.weight) and not second.error_weight.requires_grad
