"""Smooth random fields over space and time, fixed by a seed: the turbulence in sources."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

__all__ = ["Noise"]

PERIOD = 16
"""Lattice nodes per axis before the pattern repeats."""


class Noise:
    """Value noise (random numbers on a lattice, smoothly interpolated) with mean 0 and about unit variance at the
    nodes.

    A pure function of seed, channel, place and time, so that it is the same however a frame is divided into steps, and
    at any resolution the same pattern.
    """

    def __init__(self, seed: int) -> None:
        self._lattice = lru_cache(maxsize=64)(self._draw)
        self._seed = seed

    def _draw(self, channel: int, key: int) -> Tensor:
        numbers = np.random.default_rng([self._seed, channel, key]).standard_normal((PERIOD,) * 3)
        return torch.from_numpy(numbers.astype(np.float32))

    def field(
        self, channel: int, axes: tuple[Tensor, Tensor, Tensor], cells: float, tempo: float, time: float
    ) -> Tensor:
        """(X, Y, Z) values.

        Args:
            channel: different ones are independent.
            axes: world coordinates (X, 1, 1), (1, Y, 1), (1, 1, Z).
            cells: lattice cells per world unit.
            tempo: how often per second the field is another one; in between, one turns into the next.
        """
        phase = max(time, 0.0) * tempo
        key = math.floor(phase)
        angle = (phase - key) * math.pi / 2
        lattice = math.cos(angle) * self._lattice(channel, key) + math.sin(angle) * self._lattice(channel, key + 1)
        x, y, z = (_weights(axis.reshape(-1) * cells) for axis in axes)
        return torch.matmul(x, torch.matmul(y, torch.matmul(lattice, z.T)).reshape(PERIOD, -1)).reshape(
            len(x), len(y), len(z)
        )

    def fractal(
        self,
        channel: int,
        axes: tuple[Tensor, Tensor, Tensor],
        cells: float,
        tempo: float,
        time: float,
        octaves: int = 3,
    ) -> Tensor:
        """Octaves of :meth:`field`, each twice as fine, half as strong and faster by half."""
        parts = [
            self.field(channel + 101 * k, axes, cells * 2**k, tempo * 1.5**k, time) * 0.5**k for k in range(octaves)
        ]
        return torch.stack(parts).sum(0)

    def vector(
        self,
        channel: int,
        axes: tuple[Tensor, Tensor, Tensor],
        cells: float,
        tempo: float,
        time: float,
        octaves: int = 2,
    ) -> Tensor:
        """(3, X, Y, Z): three independent :meth:`fractal` fields."""
        return torch.stack(
            [self.fractal(channel + 1009 * (k + 1), axes, cells, tempo, time, octaves) for k in range(3)]
        )


def _weights(places: Tensor) -> Tensor:
    """(n, PERIOD) what each lattice node counts at each place; cubic fade, so that slopes are continuous."""
    lower = places.floor()
    part = places - lower
    part = part * part * (3 - 2 * part)
    index = lower.long() % PERIOD
    weights = torch.zeros(len(places), PERIOD)
    rows = torch.arange(len(places))
    weights[rows, index] = 1 - part
    weights[rows, (index + 1) % PERIOD] = part
    return weights
