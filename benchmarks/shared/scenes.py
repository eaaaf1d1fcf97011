"""A random scene for renderers, a camera that sees it, and times that can be compared."""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import torch

from neuprim.core.cameras import Camera
from neuprim.core.model.fields import Constant, Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives


def random_scene(count: int, seed: int = 0, overlap: float = 30.0, rate: float = 4.0) -> dict[str, torch.Tensor]:
    """Anisotropic primitives filling a unit cube that cover its face ``overlap`` times; phases turn up to ``rate``
    radians per axis and m."""
    g = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=g, dtype=torch.float64)

    means = uniform(count, 3) - 0.5
    scales = math.sqrt(overlap / (count * math.pi)) * 0.92 * torch.exp(0.45 * normal(count, 3))
    W1, b1 = (2 * uniform(count, 8, 3) - 1) * rate, (2 * uniform(count, 8) - 1) * math.pi
    w2, b2 = normal(count, 8) * 0.12, 0.12 + 0.1 * uniform(count)
    quats, colours = normal(count, 4), uniform(count, 3)
    return {"mean": means, "scale": scales, "quat": quats, "W1": W1, "b1": b1, "w2": w2, "b2": b2, "col": colours}


def lower(p: dict[str, torch.Tensor]) -> LoweredPrimitives:
    t = {k: v.float().requires_grad_() for k, v in p.items()}
    with torch.no_grad():
        log_scales = t["scale"].log()
    geometry = Geometry(t["mean"], log_scales.requires_grad_(), t["quat"])
    return LoweredPrimitives(geometry, Cosine(t["W1"], t["b1"], t["w2"], t["b2"], omega0=1.0), Constant(t["col"]))


def view(size: int, distance: float = 1.7, fov: float = 40.0) -> Camera:
    a, b = 0.5, 0.3
    Ry = torch.tensor([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]], dtype=torch.float64)
    Rx = torch.tensor([[1, 0, 0], [0, math.cos(b), -math.sin(b)], [0, math.sin(b), math.cos(b)]], dtype=torch.float64)
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[2, 3] = Rx @ Ry, distance
    f = 0.5 * size / math.tan(math.radians(fov) / 2)
    return Camera(matrix, f, f, size / 2, size / 2, size, size)


def fastest(pairs: list[Callable[[], None]], rounds: int) -> list[float]:
    """Fastest of ``rounds`` runs of each, taken in turns so that all meet the same noise; one run each beforehand."""
    for run in pairs:
        run()
    times = [math.inf] * len(pairs)
    for _ in range(rounds):
        for i, run in enumerate(pairs):
            start = time.perf_counter()
            run()
            times[i] = min(times[i], time.perf_counter() - start)
    return times
