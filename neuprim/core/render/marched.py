"""Diagnostic: what the closed form is worth. The same model with the density of every chord sampled, as a splatter
without the closed form would.

A chord's optical depth is 2 half times the mean of f over it. The closed form gives that mean by one (cos, sinc) pair
per neuron; sampling gives it by n cosines per neuron, at the middles of n equal parts. All else is the same, in float64
torch: rays, chords, compositing.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from statistics import median

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.errors import ConfigError
from neuprim.core.metrics import psnr
from neuprim.core.model.forms import Cosine
from neuprim.core.model.pairs import Pairs
from neuprim.core.model.primitives import Lowered
from neuprim.core.render.reference.backend import render
from neuprim.core.settings import RenderSettings

__all__ = ["Sampling", "compare_sampling", "sampled_depth"]


@dataclass(frozen=True)
class Sampling:
    """One way to integrate.

    Attributes:
        samples: per chord; 0 is the closed form.
        psnr: of the image against that of the closed form, dB; infinite for the closed form itself.
        max_abs: largest difference of a colour.
        seconds: that the integrals of all chords of the image take, median of all rounds.
        chords: how many these are.
    """

    samples: int
    psnr: float
    max_abs: float
    seconds: float
    chords: int


def sampled_depth(form: Cosine, pairs: Pairs, samples: int) -> Tensor:
    """(M,) float64 integrals of sigma along chords by the midpoint rule."""
    prim = pairs.prim
    W1, w2, b2 = form.W1.double()[prim], form.w2.double()[prim], form.b2.double().reshape(-1)[prim]
    phase = form.omega0 * ((W1 * pairs.local[:, None, :]).sum(-1) + form.b1.double()[prim])
    step = form.omega0 * (W1 * pairs.direction[:, None, :]).sum(-1) * pairs.half[:, None]
    c0, c1, c2 = pairs.support if form.edge else (None, None, None)
    total = torch.zeros_like(pairs.half)
    for i in range(samples):
        u = (2 * i + 1) / samples - 1
        f = (w2 * (phase + u * step).cos()).sum(-1) + b2
        if c0 is not None and c1 is not None and c2 is not None:
            f = f * (c0 + c1 * u + c2 * u * u).clamp_min(0) ** form.edge
        total = total + f
    return 2 * pairs.half * total / samples


@dataclass(frozen=True)
class _Sampled(Cosine):
    """The same density, integrated in some way; keeps the chords that it is asked for."""

    samples: int = 0
    asked: tuple[list[Pairs], ...] = ()

    def optical_depth(self, pairs: Pairs) -> Tensor:
        for asked in self.asked:
            asked.append(pairs)
        return sampled_depth(self, pairs, self.samples) if self.samples else super().optical_depth(pairs)


@torch.no_grad()
def compare_sampling(
    lowered: Lowered,
    camera: Camera,
    settings: RenderSettings,
    samples: Sequence[int] = (1, 2, 4, 8, 16, 32, 64),
    rounds: int = 5,
) -> list[Sampling]:
    """The closed form first, then each number of samples: an image of each, and the time of its integrals, in turns, on
    the same chords.

    Raises:
        ConfigError: the model's density is no sum of cosines, which alone can be done both ways.
    """
    form = lowered.density
    if not isinstance(form, Cosine):
        raise ConfigError(
            f"density {type(form).__name__} has no closed form that sampling could be compared with; expected Cosine"
        )
    asked: list[Pairs] = []
    ways, images = [], []
    for count in (0, *samples):
        kept = () if count else (asked,)
        own = _Sampled(form.W1, form.b1, form.w2, form.b2, form.omega0, form.edge, count, kept)
        images.append(render(replace(lowered, density=own, shade=None), camera, None, settings).rgb.double())
        ways.append(replace(own, asked=()))
    names = [field.name for field in fields(Pairs) if field.name != "origin"]
    all_at_once = Pairs(
        **{name: torch.cat([getattr(p, name) for p in asked]) for name in names}, origin=camera.position.double()
    )
    seconds: list[list[float]] = [[] for _ in ways]
    for number in range(rounds):
        for i in (*range(number % len(ways), len(ways)), *range(number % len(ways))):
            start = time.perf_counter()
            ways[i].optical_depth(all_at_once)
            seconds[i].append(time.perf_counter() - start)
    return [
        Sampling(
            way.samples, psnr(image, images[0]), float((image - images[0]).abs().max()), median(took), len(all_at_once)
        )
        for way, image, took in zip(ways, images, seconds, strict=True)
    ]
