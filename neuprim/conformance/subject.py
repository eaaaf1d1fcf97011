"""A task under examination: what the checks build from it, and how they say what is wrong."""

from __future__ import annotations

from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from neuprim.config import RunSettings, preset_settings, task_choices
from neuprim.conformance.example import example
from neuprim.core.cameras.projections import AnyCamera
from neuprim.core.data import Dataset, View
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.fields import ColourField, Conditions, DensityField, LoweredDensity, Shading
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import ParameterSpec, Params
from neuprim.core.render import RenderSettings, render
from neuprim.core.render.backends import REFERENCE
from neuprim.core.task import TaskSpec
from neuprim.core.train.initial_model import initial_model
from neuprim.core.train.settings import PopulationSettings, TrainSettings
from neuprim.core.train.trainer import Trainer
from neuprim.core.used_settings import build_settings, loss_settings

__all__ = ["EXACT", "PRIMITIVES", "ConformanceError", "Frozen", "Subject", "watched"]

PRIMITIVES = 12
EXACT = RenderSettings(backend=REFERENCE, alpha_max=0.9999, alpha_min=0.0, transmittance_min=0.0, depth_floor=1e-12)
"""Nothing skipped and nothing clamped that could be left alone: what the mathematics says."""


class ConformanceError(AssertionError):
    """A task does not do what the framework relies on; names task, check, place, what was found and what was
    expected."""


class Subject:
    """One task at one choice of settings.

    Args:
        check: name of the check, for messages.
        preset: whose model settings are used; None: the task's default.
        model: changes to them by name, e.g. ``{"density": {"form": "gaussian"}}``.
    """

    def __init__(
        self, task: TaskSpec, check: str = "", preset: str | None = None, model: Mapping[str, Any] | None = None
    ) -> None:
        self.task, self.check, self.preset, self.changes = task, check, preset, dict(model or {})

    def named(self, check: str) -> Subject:
        """The same for another check; what has been read from files is shared."""
        other = copy(self)
        other.check = check
        return other

    def with_channels(self, channels: int) -> Subject:
        """The same on a synthetic data set of so many colour channels."""
        other = copy(self)
        other.dataset = example(self.task.conditions, channels)
        return other

    # ------------------------------------------------------------ verdicts

    def require(self, ok: bool, where: str, found: object, expected: str) -> None:
        """Raise :class:`ConformanceError` unless ``ok``."""
        if not ok:
            raise ConformanceError(
                f"task {self.task.name!r}: {self.check}: {where}: found {found}; expected {expected}"
            )

    def image(self, where: str, model: Primitives, view: View) -> Tensor:
        """(H, W, C) colours of a view, which must be finite."""
        try:
            rgb = render(model, view.camera, view.conditions, self.settings.renderer).rgb
        except NonFiniteError as error:
            self.require(False, where, str(error), "finite numbers")
            raise
        self.require(bool(torch.isfinite(rgb).all()), where, "NaN or infinity in the image", "finite colours")
        return rgb

    # ------------------------------------------------------------ what the task builds

    @cached_property
    def settings(self) -> RunSettings:
        """The preset's settings with a handful of primitives, drawn by the reference backend."""
        choice = task_choices(self.task)
        found = preset_settings(self.task, self.preset or choice.preset, choice.scene)
        model = replace(found.model, **{"primitives": PRIMITIVES, **self.changes})
        return replace(found, model=model, renderer=RenderSettings(backend=REFERENCE))

    @cached_property
    def options(self) -> dict[str, Any]:
        """The task's own options at their defaults."""
        return task_choices(self.task).options

    @cached_property
    def dataset(self) -> Dataset:
        """The task's own example, or one with the conditions and channels it declares."""
        return (
            self.task.example()
            if self.task.example is not None
            else example(self.task.conditions, len(self.task.channels) or 3)
        )

    def fields(self) -> tuple[DensityField, ColourField]:
        """Freshly built fields."""
        return self.task.build(build_settings(self.task, self.settings.model, self.options), self.dataset)

    def specs(self) -> list[tuple[str, ParameterSpec]]:
        """("density" or "colour", spec) of every parameter beside the geometry's."""
        density, colour = self.fields()
        return [*(("density", s) for s in density.parameters()), *(("colour", s) for s in colour.parameters())]

    def lowering(self, name: str) -> str:
        """``"density.lower: "`` for a parameter of the density, and so on: the method that the image depends on it
        through."""
        kind = next((kind for kind, spec in self.specs() if spec.name == name), None)
        return "" if kind is None else f"{kind}.lower: "

    def fresh(self, seed: int = 0) -> Primitives:
        """A model as a run starts with."""
        density, colour = self.fields()
        return initial_model(density, colour, self.dataset, self.settings.model, seed)

    def model(self, dtype: torch.dtype = torch.float64) -> Primitives:
        """A model in the middle of training, as it were: initial values moved a little, so that nothing is zero or
        equal by chance."""
        model = self.fresh()
        generator = torch.Generator().manual_seed(11)
        for name, value in model.params.items():
            strength = {"quats": 0.3, "log_scales": 0.2}.get(
                name, 0.05 * max(1.0, float(value.abs().mean()) if value.numel() else 1.0)
            )
            model.params[name] = (value + strength * torch.randn(value.shape, generator=generator)).to(dtype)
        for field in (model.density, model.colour):
            field.set_progress(1.0)
        return model

    def trainer(self, iterations: int, strategy: str = "relocate", seed: int = 0) -> Trainer:
        """What fits a fresh model, for a few steps, with interventions in the population every second step."""
        model, train = self.fresh(seed), self.settings.train
        population = PopulationSettings(strategy=strategy, every=2, start=0.0, stop=1.0, fraction=0.2)
        rates = {name: rate for name, rate in train.rates.items() if name in model.params}
        units = {name: unit for name, unit in train.rate_units.items() if name in model.params}
        short = TrainSettings(
            iterations=iterations, rates=rates, rate_units=units, ssim_weight=train.ssim_weight, population=population
        )
        loss = self.task.loss(loss_settings(self.task, short, self.options))
        return Trainer(model, self.dataset, loss, short, self.settings.renderer, seed)

    def views(self) -> list[View]:
        """The training views."""
        return [self.dataset.train.view(i) for i in range(len(self.dataset.train))]


class Frozen(ColourField):
    """A colour field whose shading is given: that carries no gradient, and finite differences must not see it move."""

    def __init__(self, colour: ColourField, shading: Shading | None) -> None:
        self.colour, self.channels, self.shading = colour, colour.channels, shading

    def parameters(self) -> list[ParameterSpec]:
        return self.colour.parameters()

    def settings(self) -> dict[str, Any]:
        return self.colour.settings()

    def shade(
        self, geometry: Geometry, density: LoweredDensity, conditions: Conditions, settings: RenderSettings
    ) -> Shading | None:
        return self.shading

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Any:
        return self.colour.lower(params, geometry, camera, conditions)

    @classmethod
    def of(cls, model: Primitives, conditions: Conditions) -> Frozen:
        """The model's colour with its shading in this frame."""
        with torch.no_grad():
            geometry, density = model.lower_density(conditions)
            return cls(model.colour, model.colour.shade(geometry, density, conditions, RenderSettings()))


def watched(model: Primitives) -> dict[str, Tensor]:
    """The model's parameters, from now on leaves that collect gradients."""
    model.params = {name: value.detach().clone().requires_grad_() for name, value in model.params.items()}
    return model.params
