"""Specifications of the learnable parameters of primitives, and functions for their start values.

The optimiser, population control (adding and removing primitives), checkpoints and export all use the same list of
:class:`ParameterSpec`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

import torch
from torch import Tensor

from neuprim.core.validation import Range, validate_value

__all__ = ["InitContext", "ParameterSpec", "Params", "RateUnit"]

RateUnit = Literal["absolute", "extent", "pixel"]
"""Unit of a learning rate; see :class:`ParameterSpec`."""

Params = Mapping[str, Tensor]
"""Map from the name of a parameter to its tensor (N, *shape), N primitives; :class:`ParameterSpec` states ``shape``."""


@dataclass
class InitContext:
    """Input of the functions that draw the start values of parameters, for N primitives at N starting points.

    Attributes:
        means: (N, 3) initial centres, scene units.
        scales: (N,) isotropic initial semi-axes, scene units.
        colors: (N, C) initial colours in the data set's own colour space.
        generator: the only source of random numbers.
        settings: settings of the preset under ``model.init``, e.g. ``{"alpha": 0.8}``.
        conditions: condition name -> (N,) value (e.g. time) at which each starting point was observed, if known.
        axes: (N, 3) semi-axes of starting points that are ellipsoids.
        quats: (N, 4) wxyz orientations of starting points that are ellipsoids.
        alphas: (N,) opacities 0..1 of the starting points along a ray through their centres, if known.
        steps: condition name -> difference between the condition's values in neighbouring frames of a sequence.
        velocities: (N, 3) velocities of the starting points, scene units per unit of the condition "time", if known.
    """

    means: Tensor
    scales: Tensor
    colors: Tensor
    generator: torch.Generator
    settings: Mapping[str, object] = field(default_factory=dict)
    conditions: Mapping[str, Tensor] = field(default_factory=dict)
    axes: Tensor | None = None
    quats: Tensor | None = None
    alphas: Tensor | None = None
    steps: Mapping[str, float] = field(default_factory=dict)
    velocities: Tensor | None = None

    @property
    def thickness(self) -> Tensor:
        """Harmonic mean of the three semi-axes divided by the longest semi-axis, (N,) float64; 1 for spheres."""
        if self.axes is None:
            return torch.ones(self.count, dtype=torch.float64)
        axes = self.axes.double()
        return 3 / (axes.amax(1, keepdim=True) / axes).sum(1)

    @property
    def count(self) -> int:
        return int(self.means.shape[0])

    def uniform(self, *shape: int, bound: float = 1.0) -> Tensor:
        """Draw (N, *shape) float32 numbers, uniform from -bound to bound."""
        u = torch.rand((self.count, *shape), generator=self.generator, dtype=torch.float32)
        return (2.0 * u - 1.0) * bound

    def number(self, name: str, default: float, low: float = -math.inf, high: float = math.inf) -> float:
        """Return the number ``settings[name]``; raise ConfigError unless it is above ``low`` and below ``high``."""
        bounds = Range(above=low, below=high)
        return float(validate_value(self.settings.get(name, default), Annotated[float, bounds], f"model.init.{name}"))

    def choice(self, name: str, *offered: str) -> str:
        """Return ``settings[name]``, by default the first of ``offered``; raise ConfigError for any other value."""
        return str(validate_value(self.settings.get(name, offered[0]), Literal[offered], f"model.init.{name}"))


@dataclass(frozen=True)
class ParameterSpec:
    """Description of a parameter: one learnable tensor with one row per primitive.

    Attributes:
        name: unique within a model; the key in checkpoints, learning rates and exports.
        shape: shape per primitive, ``()`` for a scalar.
        lr: learning rate; the setting ``train.rates.NAME`` overrides it. A parameter with rate 0 is a label, which is
            stored in every file but not learned.
        init: function that draws the (N, *shape) float32 start values.
        lr_unit: name of the factor that multiplies the rate. "absolute" is the factor 1. "extent" is the data set's
            :attr:`~neuprim.core.data.Dataset.extent`. "pixel" is the size of a pixel at the median depth of the scene.
            The setting ``train.rate_units.NAME`` overrides ``lr_unit``.
        low: lower bound of the values. Use 0 if the model clamps the values at 0, because values below 0 would get no
            gradient and could not rise again.
    """

    name: str
    shape: tuple[int, ...]
    lr: float
    init: Callable[[InitContext], Tensor]
    lr_unit: RateUnit = "absolute"
    low: float = -math.inf

    @property
    def fixed(self) -> bool:
        """Whether the parameter is a label, which is not learned."""
        return self.lr == 0

    @property
    def size(self) -> int:
        """Number of values per primitive."""
        n = 1
        for s in self.shape:
            n *= s
        return n
