"""Diagnostic: the value of the closed form. The same model with the density of every chord sampled, as a splatter
without the closed form would do it.

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


@dataclass(frozen=True)
class Quadrature:
    """One way to integrate: errors are of the image against that of the closed form."""

    samples: int  # per chord; 0 is the closed form
    psnr: float  # dB; infinite for the closed form itself
    max_abs: float
    seconds: float  # that the integrals of all chords of the image take, median of all rounds
    chords: int


def sampled_depth(form: Cosine, pairs: Pairs, samples: int) -> Tensor:
    """Return (M,) float64 integrals of sigma along chords by the midpoint rule."""
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
    """The same density, integrated with ``samples``; adds the chords of each call to ``chords``."""

    samples: int = 0
    chords: list[Pairs] | None = None

    def optical_depth(self, pairs: Pairs) -> Tensor:
        if self.chords is not None:
            self.chords.append(pairs)
        return sampled_depth(self, pairs, self.samples) if self.samples else super().optical_depth(pairs)


@torch.no_grad()
def compare_quadrature(
    lowered: Lowered,
    camera: Camera,
    settings: RenderSettings,
    samples: Sequence[int] = (1, 2, 4, 8, 16, 32, 64),
    rounds: int = 5,
) -> list[Quadrature]:
    """Compare the closed form, which comes first, with each number of samples: an image of each, and the time of its
    integrals, in turns, on the same chords.

    Raises:
        ConfigError: the model's density is no sum of cosines, which alone can be done both ways.
    """
    form = lowered.density
    if not isinstance(form, Cosine):
        raise ConfigError(
            f"density {type(form).__name__} has no closed form that sampling could be compared with; expected Cosine"
        )
    chords: list[Pairs] = []
    densities, images = [], []
    for count in (0, *samples):
        density = _Sampled(form.W1, form.b1, form.w2, form.b2, form.omega0, form.edge, count, None if count else chords)
        images.append(render(replace(lowered, density=density, shade=None), camera, None, settings).rgb.double())
        densities.append(replace(density, chords=None))
    names = [field.name for field in fields(Pairs) if field.name != "origin"]
    columns = {name: torch.cat([getattr(p, name) for p in chords]) for name in names}
    all_chords = Pairs(**columns, origin=camera.position.double())
    seconds: list[list[float]] = [[] for _ in densities]
    for number in range(rounds):
        first = number % len(densities)
        for i in (*range(first, len(densities)), *range(first)):
            start = time.perf_counter()
            densities[i].optical_depth(all_chords)
            seconds[i].append(time.perf_counter() - start)
    return [
        Quadrature(
            density.samples,
            psnr(image, images[0]),
            float((image - images[0]).abs().max()),
            median(took),
            len(all_chords),
        )
        for density, image, took in zip(densities, images, seconds, strict=True)
    ]
