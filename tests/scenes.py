"""Random models and cameras for tests."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.model.cosine import apply_density_gain
from neuprim.core.model.fields import Constant, Cosine, LoweredColour, RayNet
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives


def camera(
    width: int = 64, height: int = 48, distance: float = 3.0, fov: float = 40.0, shift: tuple[float, float] = (0.0, 0.0)
) -> Camera:
    """A camera on the diagonal, looking at the origin; ``shift`` moves the principal point off centre, in pixels."""
    eye = torch.tensor([0.5, -0.4, 0.77], dtype=torch.float64)
    view = look_at(eye / eye.norm() * distance, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    f = 0.5 * width / math.tan(math.radians(fov) / 2)
    return Camera(view, f, f * 1.05, width / 2 + shift[0], height / 2 + shift[1], width, height)


def tensors(
    count: int = 60,
    neurons: int = 8,
    channels: int = 3,
    seed: int = 0,
    radius: float = 0.25,
    frequency: float = 1.0 / 3.0,
    dtype: torch.dtype = torch.float32,
    hidden: int | None = None,
    colour_frequency: float = 2.0,
) -> dict[str, Tensor]:
    """Random primitives in the unit cube: overlapping, anisotropic, of positive and negative density.

    Their colours are constant, or with ``hidden`` networks of so many units, clamped here and there.
    """
    g = torch.Generator().manual_seed(seed)

    def u(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=g, dtype=torch.float64) * 2 - 1

    values = {
        "means": u(count, 3) * 0.6,
        "log_scales": math.log(radius) + 0.6 * u(count, 3),
        "quats": u(count, 4),
        "W1": u(count, neurons, 3) * frequency,
        "b1": u(count, neurons),
        "w2": u(count, neurons) * 0.3,
        "b2": 0.3 + 0.4 * u(count, 1),
        "colors": u(count, channels) * 0.5 + 0.5,
    }
    if hidden is not None:
        base = values.pop("colors")
        values |= {
            "Wx": u(count, hidden, 3) * colour_frequency,
            "bias": u(count, hidden) * 3.0,
            "Wout": u(count, channels, hidden) * 0.8 / max(hidden, 1) ** 0.5,
            "base": base - 0.1,
        }
    return {k: v.to(dtype) for k, v in values.items()}


def colour(t: dict[str, Tensor]) -> LoweredColour:
    """The colour form that a dictionary of :func:`tensors` holds."""
    return Constant(t["colors"]) if "colors" in t else RayNet(t["Wx"], t["bias"], t["Wout"], t["base"])


def channels(t: dict[str, Tensor]) -> int:
    return int(t["colors" if "colors" in t else "base"].shape[1])


_EDGE: ContextVar[int] = ContextVar("edge", default=0)


@contextmanager
def soft(edge: int) -> Iterator[None]:
    """Every model that :func:`lowered` makes in this block has this edge."""
    token = _EDGE.set(edge)
    try:
        yield
    finally:
        _EDGE.reset(token)


def lowered(t: dict[str, Tensor]) -> LoweredPrimitives:
    """The renderer's input from a dictionary of :func:`tensors`, which may hold a ``log_gain``."""
    w2, b2 = apply_density_gain(t["w2"], t["b2"], t.get("log_gain"))
    density = Cosine(t["W1"], t["b1"], w2, b2, edge=_EDGE.get())
    return LoweredPrimitives(Geometry(t["means"], t["log_scales"], t["quats"]), density, colour(t))
