"""Training settings, as they stand in a run's configuration under ``train`` and ``model``."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from neuprim.core.errors import ConfigError

__all__ = ["ModelSettings", "PopulationSettings", "TrainSettings"]


@dataclass
class ModelSettings:
    """What is fitted.

    Attributes:
        primitives: primitives at the start (and throughout, unless population control grows them).
        density: which density the task builds; the task says what there is to choose, see its presets.
        colour: the same for the colour.
        neurons: hidden width K of the cosine density, 0..16; 0 is a constant density. A Gaussian has none.
        sh_degree: spherical-harmonics degree of the colour, 0..3.
        sh_every: fraction of the budget after which one more SH band is unlocked; 0 unlocks all at once.
        init: free settings of the fields' initialisers, see the preset files.
    """

    primitives: int = 2000
    density: dict[str, Any] = field(default_factory=dict)
    colour: dict[str, Any] = field(default_factory=dict)
    neurons: int = 8
    sh_degree: int = 3
    sh_every: float = 0.1
    init: dict[str, Any] = field(default_factory=dict)

    def check(self) -> None:
        for name, ok, expected in (
            ("primitives", self.primitives >= 1, "at least 1"),
            ("neurons", 0 <= self.neurons <= 16, "0 to 16"),
            ("sh_degree", 0 <= self.sh_degree <= 3, "0 to 3"),
            ("sh_every", self.sh_every >= 0, "a fraction of the budget, 0 for all bands at once"),
        ):
            if not ok:
                raise ConfigError(f"model.{name}={getattr(self, name)}: expected {expected}")


@dataclass
class PopulationSettings:
    """How primitives are born, moved and removed. ``start`` and ``stop`` are fractions of the training budget.

    Attributes:
        strategy: "fixed", "relocate" (constant count: the least used move to where the error is) or "gradient" (clone,
            split and prune by the density network's gradient norm, as the authors do).
        every: steps between two interventions.
        fraction: relocate: the largest share of primitives moved at once.
        grow_threshold, prune_threshold: gradient: on the mean norm of the density gradient.
        clone_scale, prune_scale: gradient: in units of the scene's extent.
        max_primitives: growth cap.
    """

    strategy: str = "relocate"
    every: int = 200
    start: float = 0.02
    stop: float = 0.6
    fraction: float = 0.05
    grow_threshold: float = 1e-5
    prune_threshold: float = 1e-6
    clone_scale: float = 0.01
    prune_scale: float = 0.5
    max_primitives: int = 1_000_000


@dataclass
class TrainSettings:
    """How it is fitted. Every schedule runs on the used fraction of the budget: the larger of step/iterations and
    elapsed/max_seconds.

    Attributes:
        iterations: steps, one view each.
        max_seconds: stop after this many seconds of training, if given (such a run is not bit-reproducible).
        rates: learning rate by parameter name, over the specs' own.
        final_rate: the rates decay exponentially to this fraction of themselves at the end of the budget; 1 is constant.
        adam_beta2: decay of Adam's second moment per step, in [0, 1).
        warmup_steps: steps over which the rates rise linearly from zero.
        loss: name of a loss that a package provides (``neuprim tasks`` lists them), or null for the task's own.
        ssim_weight: lambda in (1 - lambda) L1 + lambda (1 - SSIM).
        anisotropy_weight, anisotropy_from: weight of mean(std over axes of s / min s), and the step it starts at.
        background: "white", "black", "random" or "auto" (the data set's own choice).
        checkpoint_every_seconds: a checkpoint is written at the first step after this many seconds, and at the end.
        log_every: steps between two lines of metrics.jsonl.
        eval_every: fraction of the budget between two evaluations on a few held-out views for the curve; 0 for none.
    """

    iterations: int = 30_000
    max_seconds: float | None = None
    rates: dict[str, float] = field(default_factory=dict)
    final_rate: float = 0.05
    adam_beta2: float = 0.999
    warmup_steps: int = 0
    loss: str | None = None
    ssim_weight: float = 0.2
    anisotropy_weight: float = 0.0
    anisotropy_from: int = 100
    background: str = "auto"
    checkpoint_every_seconds: float = 60.0
    log_every: int = 20
    eval_every: float = 0.1
    population: PopulationSettings = field(default_factory=PopulationSettings)

    def check(self) -> None:
        for name, ok, expected in (
            ("iterations", self.iterations >= 0, "0 or more"),
            ("max_seconds", self.max_seconds is None or self.max_seconds > 0, "a positive number of seconds, or null"),
            ("final_rate", 0 < self.final_rate <= 1, "a number in (0, 1]"),
            ("adam_beta2", 0 <= self.adam_beta2 < 1, "a number in [0, 1)"),
            ("ssim_weight", 0 <= self.ssim_weight <= 1, "a number in [0, 1]"),
            ("log_every", self.log_every >= 1, "at least 1"),
            ("background", self.background in ("auto", "white", "black", "random"), "auto, white, black or random"),
        ):
            if not ok:
                raise ConfigError(f"train.{name}={getattr(self, name)!r}: expected {expected}")
        p = self.population
        for name, ok, expected in (
            ("every", p.every >= 1, "at least 1"),
            ("fraction", 0 <= p.fraction <= 1, "a number in [0, 1]"),
            ("start", 0 <= p.start <= 1, "a fraction of the budget"),
            ("stop", 0 <= p.stop <= 1, "a fraction of the budget"),
        ):
            if not ok:
                raise ConfigError(f"train.population.{name}={getattr(p, name)!r}: expected {expected}")
