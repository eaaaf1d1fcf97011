"""How far the CUDA backend's images and gradients are from the float64 reference, on small random scenes."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives
from neuprim.core.render import RenderSettings, render_lowered

KINDS = {"thin": (500, 1), "deep": (300, 2), "inside": (200, 3)}
"""Few hits a pixel; many and opaque; around and behind the camera, with fast neurons. Primitives and seed."""
FORMS = ((8, 0), (8, 2), (2, 1), (2, 2), (0, 2), (16, 0))
"""Neurons and edge."""
NAMES = ("means", "log_scales", "quats", "W1", "b1", "w2", "b2", "colours", "view", "background")
SIZE = 64


def small_scene(kind: str, neurons: int) -> list[Tensor]:
    """(means, log_scales, quats, W1, b1, w2, b2, colours), float64 numbers that float32 has, too."""
    count, seed = KINDS[kind]
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    means = (uniform(count, 3) - 0.5) * 2 + torch.tensor([0, 0, 0.8 if kind == "inside" else 4.0])
    scales = math.log(0.12 if kind == "thin" else 0.3) + (uniform(count, 3) - 0.5) * 1.4
    quats = uniform(count, 4) * 2 - 1
    W1 = (uniform(count, neurons, 3) - 0.5) * (1.2 if kind == "inside" else 2 / 3)
    b1, w2 = (uniform(count, neurons) - 0.5) * 2 / 3, (uniform(count, neurons) - 0.5) * 1.2
    b2, colours = uniform(count) * 2.5 + 0.6, uniform(count, 3)
    return [tensor.float().double() for tensor in (means, scales, quats, W1, b1, w2, b2, colours)]


def render_with_gradients(
    values: list[Tensor], edge: int, settings: RenderSettings, dtype: torch.dtype
) -> tuple[Tensor, list[Tensor]]:
    """Image with its alpha and depth, (H, W, 5), and the gradients of NAMES under random weights on all five; float64,
    on the CPU."""
    leaves = [tensor.to(settings.device or "cpu", dtype).requires_grad_() for tensor in values]
    view = torch.eye(4, dtype=torch.float64)
    view[0, 3], view[1, 3] = 0.1, -0.05
    view.requires_grad_()
    background = torch.tensor([0.2, 0.5, 0.8], dtype=torch.float64, requires_grad=True)
    means, log_scales, quats, W1, b1, w2, b2, colours = leaves
    lowered = LoweredPrimitives(
        Geometry(means, log_scales, quats), Cosine(W1, b1, w2, b2, 30.0, edge), Constant(colours)
    )
    out = render_lowered(lowered, Camera(view, 70.0, 72.0, 31.0, 33.0, SIZE, SIZE), settings, background)
    depth = torch.zeros_like(out.alpha) if out.depth is None else out.depth
    image = torch.cat([out.rgb, out.alpha[..., None], depth[..., None]], -1)
    weights = torch.randn(SIZE, SIZE, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    weights[..., 4] *= 0.1
    inputs = [*leaves, view, background]
    grads = torch.autograd.grad((image * weights.to(image)).sum(), inputs, allow_unused=True)
    filled = [torch.zeros(x.shape) if g is None else g for x, g in zip(inputs, grads, strict=True)]
    return image.detach().double().cpu(), [g.double().cpu() for g in filled]


def measure_parity(device: str) -> Iterator[dict[str, Any]]:
    """Errors of the CUDA backend: of images, absolute; of each gradient over its largest number; and whether a rerun is
    the same."""
    for neurons, edge in FORMS:
        for kind in KINDS:
            values, settings = small_scene(kind, neurons), RenderSettings(depth=kind == "deep")
            reference = replace(settings, backend="reference", device="cpu")
            truth, expected = render_with_gradients(values, edge, reference, torch.float64)
            own = replace(settings, backend="cuda", device=device)
            image, found = render_with_gradients(values, edge, own, torch.float32)
            again, refound = render_with_gradients(values, edge, own, torch.float32)
            errors = {
                name: float((a - b).abs().max() / b.abs().max().clamp_min(1e-9)) if b.numel() else 0.0
                for name, a, b in zip(NAMES, found, expected, strict=True)
            }
            same = all(torch.equal(a, b) for a, b in zip([image, *found], [again, *refound], strict=True))
            yield {
                "neurons": neurons,
                "edge": edge,
                "scene": kind,
                "image": float((image - truth).abs().max()),
                "gradients": errors,
                "same": same,
            }
