"""Settings of a run under ``model`` and ``train``, and checks that tasks and losses declare which settings they read.

The settings in :data:`OPTIONAL` are read only by the ``build`` function of a task or by a loss. A task or loss lists in
``uses`` the optional settings that it reads, and gets only these. If the user sets an optional setting that neither the
task nor the loss lists, this is an error.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Annotated, Any, Literal

from neuprim.core.errors import ConfigError
from neuprim.core.model.schema import RateUnit
from neuprim.core.validation import Accepts, Range, nonempty_text, validate_fields

Share = Annotated[float, Range(0, 1, says="a fraction of the budget, 0 to 1")]
NotNegative = Annotated[float, Range(at_least=0)]
MIN_COOLDOWN = 0.02  # smallest factor of the learning rates in a cool-down


def _are_training_reductions(words: list[Any]) -> bool:
    return all(isinstance(word, str) and re.fullmatch(r"(density|colour)\.\w+=\d{1,4}", word) for word in words)


@dataclass
class ModelSettings:
    """Settings of the model: number of primitives, density and colour.

    Attributes:
        primitives: number of primitives. "auto" chooses ``auto_primitives`` times the square root of the number of
            steps. With ``train.max_seconds``, a short trial training estimates how many steps fit in this time. A run
            stores the chosen number.
        auto_primitives: the factor of ``primitives=auto``.
        density: settings of the density that the task builds; the presets of a task show the settings that exist.
        colour: settings of the colour that the task builds; the presets of a task show the settings that exist.
        neurons: number of neurons K of the cosine density, 0 to 16; 0 is a constant density. A Gaussian density has no
            neurons.
        sh_degree: degree of the spherical harmonics of the colour, 0 to 3.
        sh_every: fraction of the budget after which one more band of spherical harmonics is trained; 0 trains all
            bands from the start.
        init: settings of the starting values of the density and colour; the presets of a task show the settings that
            exist.
        reduced: reductions of the density and colour to simpler forms, applied in this order, such as
            ``density.neurons=0`` and ``colour.degree=1``. ``neuprim prune`` writes the reductions that a scene permits.
    """

    primitives: Annotated[int, Range(at_least=1)] | Literal["auto"] = 2000
    auto_primitives: Annotated[float, Range(above=0)] = 250.0
    density: dict[str, Any] = field(default_factory=dict)
    colour: dict[str, Any] = field(default_factory=dict)
    neurons: Annotated[int, Range(0, 16)] = 8
    sh_degree: Annotated[int, Range(0, 3)] = 3
    sh_every: Annotated[float, Range(at_least=0, says="a fraction of the budget, 0 for all bands at once")] = 0.1
    init: dict[str, Any] = field(default_factory=dict)
    reduced: Annotated[
        list, Accepts(_are_training_reductions, "a list such as [density.neurons=0, colour.degree=1]")
    ] = field(default_factory=list)

    def __post_init__(self) -> None:
        validate_fields(self, "model")

    @property
    def count(self) -> int:
        """Number of primitives, as an integer.

        Raises:
            ConfigError: ``primitives`` is "auto", because only the start of a training chooses the number.
        """
        if self.primitives == "auto":
            raise ConfigError(
                "model.primitives=auto: only a training can choose the number of primitives; expected a number"
            )
        return self.primitives

    def with_count_for(self, train: TrainSettings, pace: float | None = None) -> ModelSettings:
        """Return the settings with ``primitives="auto"`` replaced by the number for the budget in ``train``.

        If both steps and seconds are limited, the smaller number is taken.

        Args:
            pace: measured seconds per step, divided by the number of primitives. Without it, "auto" stays "auto" if
                ``train.max_seconds`` is set.
        """
        if self.primitives != "auto" or (pace is None and train.max_seconds is not None):
            return self
        found = [] if train.iterations is None else [self.auto_primitives * math.sqrt(train.iterations)]
        if train.max_seconds is not None and pace is not None:  # n = a sqrt(steps) and steps = seconds / (pace n)
            found.append((self.auto_primitives**2 * train.max_seconds / pace) ** (1 / 3))
        return replace(self, primitives=max(round(min(found)), 1))


@dataclass
class PopulationSettings:
    """How primitives are added, moved and removed during a training (population control).

    Attributes:
        strategy: "fixed" (no change), "relocate" (move the least used primitives to where the error is largest; their
            number is constant after it has reached ``grow_to``) or "gradient" (clone, split and prune by the norm of
            the density gradient, as the authors of the method do).
        every: steps between two interventions (changes of the primitives).
        start: fraction of the budget at which interventions begin.
        stop: fraction of the budget at which interventions end.
        fraction: relocate: largest share of primitives moved at once.
        idle: relocate: move only primitives whose weight in the images since the last intervention is below this share
            of the mean weight. null moves the primitives with the least weight, whatever the weight is.
        grow_to: relocate: number of primitives to reach. If the training starts with fewer, the primitives with the
            largest error split. null means ``model.primitives``.
        grow_from: relocate: share of ``model.primitives`` at the start; the other primitives are added where the error
            is largest. 1 starts with all primitives, or with fewer if the data offer fewer starting points.
        grow_threshold: gradient: mean norm of the density gradient from which primitives are cloned or split.
        prune_threshold: gradient: mean norm of the density gradient below which primitives are removed.
        clone_scale: gradient: largest size of a primitive that is cloned, in units of the scene's extent.
        prune_scale: gradient: size from which primitives are removed, in units of the scene's extent.
        max_primitives: gradient: upper bound of the number of primitives.
    """

    strategy: str = "relocate"
    every: Annotated[int, Range(at_least=1)] = 200
    start: Share = 0.02
    stop: Share = 0.6
    fraction: Annotated[float, Range(0, 1)] = 0.05
    idle: NotNegative | None = None
    grow_to: Annotated[int, Range(at_least=1)] | None = None
    grow_from: Annotated[
        float, Range(above=0, at_most=1, says="a share of model.primitives, above 0 and at most 1")
    ] = 1.0
    grow_threshold: NotNegative = 1e-5
    prune_threshold: NotNegative = 1e-6
    clone_scale: NotNegative = 0.01
    prune_scale: NotNegative = 0.5
    max_primitives: Annotated[int, Range(at_least=1)] = 1_000_000

    def __post_init__(self) -> None:
        validate_fields(self, "train.population")
        if self.grow_from < 1 and self.strategy != "relocate":
            raise ConfigError(
                f"train.population.grow_from={self.grow_from:g}: strategy={self.strategy} does not use this setting; "
                "expected train.population.strategy=relocate, or grow_from=1"
            )


@dataclass
class TrainSettings:
    """How a model is trained. Schedules run on the used fraction of the budget: the larger of step/iterations and
    elapsed/max_seconds.

    Attributes:
        iterations: number of steps, each of ``views_per_step`` views; null leaves the budget to ``max_seconds``. A
            command line with ``max_seconds`` alone sets ``iterations`` to null, so that all the seconds are used.
        views_per_step: number of views that a step renders. The gradient of a step is the mean over its views. Several
            small images use a GPU better than a single one.
        stride: a step renders every stride-th pixel of a view in x and y, from a random first pixel; 1 renders whole
            views. "auto" chooses the stride so that the pixels and the primitives take equal time, and lowers the
            stride towards the end.
        angular_size: upper bound of the ratio of a primitive's largest semi-axis to its distance from the nearest
            training camera; null for no bound.
        exposure_rate: learning rate of the exposure: a factor per training view and colour channel, updated in the
            steps that use the view. Set this for photographs with different exposures; 0 learns no exposures. Held-out
            views are rendered with the mean exposure.
        max_seconds: budget of training time in seconds; null for none. Such a run is not bit-reproducible.
        rates: learning rates by parameter name, which replace the default rates of the density and colour fields.
        rate_units: parameter name -> unit of its learning rate, which replaces the default unit. "absolute" uses the
            rate as it is (for positions: scene units per step). "extent" multiplies the rate by the scene's extent, so
            that the rate does not depend on the scale. "pixel" multiplies the rate by the size of a pixel at the median
            depth of the starting points (at most 1/250 of the extent), because sharper images need smaller steps.
        final_rate: learning rates decay exponentially to this fraction of their initial values; 1 keeps them constant.
        cooldown: last share of the budget, in which learning rates also fall linearly to 2 %; 0 for no cool-down.
        adam_beta2: decay of Adam's second moment per step, at least 0 and below 1.
        warmup_steps: steps in which learning rates rise linearly from zero.
        supervision: what the model is compared with: "images", "voxels" (points in the volume files from which the
            images were rendered), "both", or "auto" ("both" if the data set has volume files, else "images").
        voxels_per_step: number of points in a step, all from one frame.
        voxels_every: with supervision=both: every ``voxels_every``-th step uses points; all steps use images.
        voxel_weight: with supervision=both: weight of the loss of the points, relative to the loss of the images.
        voxel_colour: weight of the source radiance at the points, relative to the extinction; 0 trains colours only by
            the images.
        loss: name of a loss that a package provides (``neuprim tasks`` lists the names); null for the task's own loss.
        ssim_weight: lambda in (1 - lambda) L1 + lambda (1 - SSIM).
        size_weight: weight of a regulariser in the loss, the mean semi-axis divided by the scene's extent. Smaller
            primitives overlap less, so steps are faster; primitives that no view needs vanish (3DGS-MCMC, Kheradmand et
            al. 2024).
        anisotropy_weight: weight of a second regulariser, the mean over primitives of std(s / min s), where s are the
            three semi-axes.
        anisotropy_from: step at which the anisotropy regulariser begins.
        background: "white", "black", "random" or "auto" (the choice of the data set).
        checkpoint_every_seconds: seconds between two checkpoints; the end of the training writes one too.
        log_every: steps between two lines of metrics.jsonl.
        eval_every: fraction of the budget between two measurements of the PSNR on a few held-out views; 0 for none.
    """

    iterations: Annotated[int, Range(at_least=0)] | None = 30_000
    views_per_step: Annotated[int, Range(1, 1024)] = 1
    stride: Annotated[int, Range(1, 64)] | Literal["auto"] = 1
    angular_size: Annotated[float, Range(above=0)] | None = None
    exposure_rate: NotNegative = 0.0
    max_seconds: Annotated[float, Range(above=0, says="a positive number of seconds")] | None = None
    rates: dict[str, NotNegative] = field(default_factory=dict)
    rate_units: dict[str, RateUnit] = field(default_factory=dict)
    final_rate: Annotated[float, Range(above=0, at_most=1)] = 0.05
    cooldown: Share = 0.0
    adam_beta2: Annotated[float, Range(at_least=0, below=1)] = 0.999
    warmup_steps: Annotated[int, Range(at_least=0)] = 0
    supervision: Literal["auto", "images", "voxels", "both"] = "images"
    voxels_per_step: Annotated[int, Range(1, 1_000_000)] = 8192
    voxels_every: Annotated[int, Range(at_least=1)] = 1
    voxel_weight: NotNegative = 0.1
    voxel_colour: NotNegative = 0.1
    loss: Annotated[str, nonempty_text("the name of a loss")] | None = None
    ssim_weight: Annotated[float, Range(0, 1)] = 0.2
    size_weight: NotNegative = 0.0
    anisotropy_weight: NotNegative = 0.0
    anisotropy_from: Annotated[int, Range(at_least=0)] = 100
    background: Literal["auto", "white", "black", "random"] = "auto"
    checkpoint_every_seconds: NotNegative = 60.0
    log_every: Annotated[int, Range(at_least=1)] = 20
    eval_every: Annotated[float, Range(at_least=0, says="a fraction of the budget, 0 for no evaluations")] = 0.1
    population: PopulationSettings = field(default_factory=PopulationSettings)

    def __post_init__(self) -> None:
        validate_fields(self, "train")
        if self.iterations is None and self.max_seconds is None:
            raise ConfigError(
                "train.iterations and train.max_seconds are both null; expected a number of steps, of seconds, or both"
            )

    def rate_factor(self, step: int, progress: float) -> float:
        """Return the factor of learning rates at ``progress`` of the budget: warm-up, exponential decay, cool-down."""
        factor = self.final_rate**progress
        if self.cooldown and progress > 1 - self.cooldown:
            factor *= max((1 - progress) / self.cooldown, MIN_COOLDOWN)
        return factor * (step + 1) / self.warmup_steps if step < self.warmup_steps else factor


if TYPE_CHECKING:
    from neuprim.core.extensions import LossExtension
    from neuprim.core.task import TaskSpec

__all__ = ["ModelSettings", "OPTIONAL", "PopulationSettings", "TrainSettings"]

OPTIONAL = ("model.neurons", "model.sh_degree", "model.sh_every", "train.ssim_weight")
"""Shared settings that a task or loss gets only if its ``uses`` lists them."""


class TrackedMapping(dict[str, Any]):
    """Mapping of settings that is passed to a function of a plugin (a task or a loss).

    If the function reads a setting that the plugin did not declare, the mapping raises ConfigError.

    Args:
        owner: the plugin, for messages, e.g. ``"task 'glow'"``.
        group: dotted name of the group of settings, e.g. ``"model"``.
        member: attribute of the plugin that declares the settings it reads, "uses" or "options".
    """

    def __init__(self, values: Mapping[str, Any], owner: str, group: str, member: str) -> None:
        super().__init__(values)
        self.owner, self.group, self.member = owner, group, member

    def __missing__(self, key: str) -> Any:
        if self.member == "uses" and f"{self.group}.{key}" not in OPTIONAL:
            raise KeyError(key)
        raise ConfigError(
            f"{self.owner} reads {self.group}.{key}, which its {self.member!r} does not declare; declare it there"
        )


def build_settings(task: TaskSpec, model: ModelSettings, options: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the mapping for a task's ``build`` and ``check``: model settings that the task uses, and "options".

    Args:
        options: the task's own options by name; missing ones take their defaults, unknown ones are ignored.
    """
    return _track_used_settings("model", vars(model), task, options, f"task {task.name!r}")


def loss_settings(
    owner: TaskSpec | LossExtension, train: TrainSettings, options: Mapping[str, Any]
) -> Mapping[str, Any]:
    """Return the mapping for the loss of ``owner``: the settings under ``train`` that ``owner`` uses, and "options".

    ``owner`` is the task or loss plugin that declares what it uses.
    """
    who = f"the loss of task {owner.name!r}" if hasattr(owner, "build") else f"loss {owner.name!r}"
    return _track_used_settings("train", vars(train), owner, options, who)


def _track_used_settings(
    group: str, values: Mapping[str, Any], spec: TaskSpec | LossExtension, options: Mapping[str, Any], owner: str
) -> TrackedMapping:
    used = {k: v for k, v in values.items() if f"{group}.{k}" not in OPTIONAL or f"{group}.{k}" in spec.uses}
    declared = {key: options.get(key, option[0]) for key, option in spec.options.items()}
    own = TrackedMapping(declared, owner, "task.options", "options")
    return TrackedMapping({**used, "options": own}, owner, group, "uses")
