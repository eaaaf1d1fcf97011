"""The class :class:`TaskUnderTest`, with which checks build models, data and trainers; and a synthetic data set."""

from __future__ import annotations

import math
from collections.abc import Mapping
from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from neuprim.config import RunSettings, preset_settings, read_task_config
from neuprim.core.cameras import Camera, look_at
from neuprim.core.data import Dataset, Pixels, PointCloud, View, ViewSet, camera_extent
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.fields import ColourField, ConditionSpec, Constant, Cosine, DensityField
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import LoweredPrimitives, Primitives
from neuprim.core.model.schema import ParameterSpec
from neuprim.core.render import RenderSettings, render, render_lowered
from neuprim.core.render.backends import REFERENCE
from neuprim.core.task import TaskSpec
from neuprim.core.train.initial_model import initial_model_to_train
from neuprim.core.train.settings import PopulationSettings, TrainSettings, build_settings, loss_settings
from neuprim.core.train.trainer import Trainer

PRIMITIVES = 12
EXACT = RenderSettings(backend=REFERENCE, alpha_max=0.9999, alpha_min=0.0, transmittance_min=0.0, depth_floor=1e-12)
"""Render settings for the float64 reference backend. They skip no contribution to a pixel, and clamp as little as
possible."""


class ConformanceError(AssertionError):
    """Error: a task violates the interface. The message has task, check, place, and what was found and expected."""


class TaskUnderTest:
    """A task to check, with one choice of settings, and methods that build models from it and compare results.

    Args:
        task: the task to check.
        check: name of the running check, for messages.
        preset: name of the preset for the model settings; None is the task's default preset.
        model: changes to these model settings by name, e.g. ``{"density": {"form": "gaussian"}}``.
    """

    def __init__(
        self, task: TaskSpec, check: str = "", preset: str | None = None, model: Mapping[str, Any] | None = None
    ) -> None:
        self.task, self.check, self.preset, self.changes = task, check, preset, dict(model or {})

    def named(self, check: str) -> TaskUnderTest:
        """Return a copy for the check named ``check``; the copy shares the settings that were read from files."""
        other = copy(self)
        other.check = check
        return other

    def with_channels(self, channels: int) -> TaskUnderTest:
        """Return a copy whose data set is :func:`conformance_dataset`, with ``channels`` colour channels."""
        other = copy(self)
        other.dataset = conformance_dataset(self.task.conditions, channels)
        return other

    def require(self, ok: bool, where: str, found: object, expected: object) -> None:
        """Raise :class:`ConformanceError` unless ``ok``. Message: "task, check: ``where``: found ...; expected ..."."""
        if not ok:
            raise ConformanceError(
                f"task {self.task.name!r}: {self.check}: {where}: found {found}; expected {expected}"
            )

    def require_finite(self, where: str, value: Tensor | None) -> None:
        """Raise :class:`ConformanceError` if ``value`` contains NaN or infinity."""
        ok = value is None or bool(torch.isfinite(value).all())
        self.require(ok, where, "NaN or infinity", "finite numbers")

    def require_layout(self, where: str, found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
        """Raise :class:`ConformanceError` unless tensors are finite and have the expected names, dtypes and shapes."""
        self.require(set(found) == set(expected), where, f"tensors {sorted(found)}", sorted(expected))
        for name, value in expected.items():
            a, b = (f"{x.dtype} {tuple(x.shape)}" for x in (found[name], value))
            self.require(a == b, f"{where}: {name}", a, b)
            self.require_finite(f"{where}: {name}", found[name])

    def require_close(self, where: str, found: Tensor, expected: Tensor, rows: Tensor) -> None:
        """Raise :class:`ConformanceError` if two vectors (M,) differ by more than 1e-6 of the largest expected value.

        ``rows`` (M,) has the index of the primitive that each value belongs to, for the message.
        """
        if len(rows):
            error = (found - expected).abs() / expected.abs().max().clamp_min(1e-30)
            i = int(error.argmax())
            place = f"{where}, primitive {int(rows[i])}"
            self.require(float(error[i]) <= 1e-6, place, f"{float(found[i]):.6g}", f"{float(expected[i]):.6g}")

    def require_equal(self, where: str, found: Mapping[str, Tensor], expected: Mapping[str, Tensor]) -> None:
        """Raise :class:`ConformanceError` unless found and expected tensors have the same names and equal bits."""
        for name in expected.keys() | found.keys():
            same = name in found and name in expected and torch.equal(found[name], expected[name])
            self.require(same, f"{where}: {name}", "different values", "equal bits")

    def draw(self, where: str, model: Primitives, view: View) -> Tensor:
        """Render a view to (H, W, C); raise :class:`ConformanceError` if the image is not finite."""
        try:
            rgb = render(model, view.camera, view.conditions, self.settings.renderer).rgb
        except NonFiniteError as error:
            raise ConformanceError(f"task {self.task.name!r}: {self.check}: {where}: found {error}") from error
        self.require_finite(f"{where}: image", rgb)
        return rgb

    @cached_property
    def settings(self) -> RunSettings:
        """Settings of the preset, with 12 primitives, the changes of the model settings, and the reference backend."""
        choice = read_task_config(self.task)
        found = preset_settings(self.task, self.preset or choice.preset, choice.scene)
        model = replace(found.model, **{"primitives": PRIMITIVES, **self.changes})
        return replace(found, model=model, renderer=RenderSettings(backend=REFERENCE))

    @cached_property
    def options(self) -> dict[str, Any]:
        """Default values of the options that the task defines."""
        return read_task_config(self.task).options

    @cached_property
    def dataset(self) -> Dataset:
        """Example data set of the task; if there is none, a synthetic set with the task's conditions and channels."""
        if self.task.example is not None:
            return self.task.example()
        return conformance_dataset(self.task.conditions, len(self.task.channels) or 3)

    @property
    def views(self) -> list[View]:
        """Training views of the data set."""
        return [self.dataset.train.view(i) for i in range(len(self.dataset.train))]

    @property
    def double_views(self) -> list[View]:
        """Training views of the data set, with camera and conditions in float64."""
        found = []
        for view in self.views:
            conditions = {k: v.double() if v.is_floating_point() else v for k, v in view.conditions.items()}
            camera = replace(view.camera, viewmat=view.camera.viewmat.double())
            found.append(replace(view, camera=camera, conditions=conditions))
        return found

    def build_fields(self) -> tuple[DensityField, ColourField]:
        """Build the task's density field and colour field (the functions that primitives share)."""
        return self.task.build(build_settings(self.task, self.settings.model, self.options), self.dataset)

    def parameter_specs(self) -> list[tuple[str, ParameterSpec]]:
        """List ("density" or "colour", spec) for every parameter of the two fields."""
        density, colour = self.build_fields()
        return [*(("density", s) for s in density.parameters()), *(("colour", s) for s in colour.parameters())]

    def lower_method(self, parameter: str) -> str:
        """Return, for messages, the method of the field that uses a parameter, e.g. ``"density.lower: "``.

        The text is empty for parameters of the ellipsoids, which belong to no field.
        """
        kind = next((kind for kind, spec in self.parameter_specs() if spec.name == parameter), None)
        return "" if kind is None else f"{kind}.lower: "

    def initial_model(self, seed: int = 0) -> Primitives:
        """Return the initial model of a training run with this seed."""
        density, colour = self.build_fields()
        return initial_model_to_train(density, colour, self.dataset, self.settings.model, seed)

    def perturbed_model(self, dtype: torch.dtype = torch.float64) -> Primitives:
        """Return a model with randomly perturbed parameters, so that none is zero and no two are equal."""
        model = self.initial_model()
        generator = torch.Generator().manual_seed(11)
        for name, value in model.params.items():
            typical = float(value.abs().mean()) if value.numel() else 1.0
            strength = {"quats": 0.3, "log_scales": 0.2}.get(name, 0.05 * max(1.0, typical))
            model.params[name] = (value + strength * torch.randn(value.shape, generator=generator)).to(dtype)
        for field in (model.density, model.colour):
            field.set_progress(1.0)
        return model

    def trainer(self, iterations: int) -> Trainer:
        """Return a trainer of a new model that relocates primitives (population control) every second step."""
        model, train = self.initial_model(), self.settings.train
        population = PopulationSettings(strategy="relocate", every=2, start=0.0, stop=1.0, fraction=0.2)
        rates = {name: rate for name, rate in train.rates.items() if name in model.params}
        units = {name: unit for name, unit in train.rate_units.items() if name in model.params}
        short = TrainSettings(
            iterations=iterations, rates=rates, rate_units=units, ssim_weight=train.ssim_weight, population=population
        )
        loss = self.task.loss(loss_settings(self.task, short, self.options))
        return Trainer(model, self.dataset, loss, short, self.settings.renderer, 0)


# ---------------------------------------------------------------- synthetic data

_WIDTH, _HEIGHT = 10, 9  # smaller than the window of SSIM, which is then skipped
_DISTANCE = 2.5
_NEAR_ZERO = 3.0


def conformance_range(spec: ConditionSpec) -> tuple[float, float]:
    """Return the interval from which checks draw the values of a condition.

    The interval is the part of the condition's range within -3..3, or the whole range if that part is empty.
    """
    low, high = max(spec.range[0], -_NEAR_ZERO), min(spec.range[1], _NEAR_ZERO)
    return (low, high) if low < high else spec.range


def random_conformance_condition(
    spec: ConditionSpec, generator: torch.Generator, shape: tuple[int, ...] | None = None
) -> Tensor:
    """Draw a random float32 value of a condition (such as the time), uniform in :func:`conformance_range`.

    ``shape`` is the shape of the result; None is the shape of the condition.
    """
    low, high = conformance_range(spec)
    return low + (high - low) * torch.rand(spec.shape if shape is None else shape, generator=generator)


class _ConformanceViews(ViewSet):
    def __init__(self, views: list[View], channels: int) -> None:
        settings = RenderSettings(backend=REFERENCE)
        frames = [render_lowered(_conformance_ellipsoids(channels), view.camera, settings) for view in views]
        self.views, self.images = views, [Pixels(frame.rgb, frame.alpha) for frame in frames]

    def __len__(self) -> int:
        return len(self.views)

    def view(self, index: int) -> View:
        return self.views[index]

    def pixels(self, index: int) -> Pixels:
        return self.images[index]


def conformance_dataset(conditions: tuple[ConditionSpec, ...], channels: int = 3) -> Dataset:
    """Make a small synthetic data set: six training and two test views, 10 x 9 pixels, sRGB.

    The images show ellipsoids of constant density on grey. Each view has random values of the conditions (inputs such
    as the time); the images do not depend on these values.
    """
    generator = torch.Generator().manual_seed(7)
    views = []
    for i in range(8):
        drawn = {spec.name: random_conformance_condition(spec, generator) for spec in conditions}
        camera = _conformance_camera(1.1 * i, 0.6 * math.sin(2.0 * i))
        views.append(View(f"{'train' if i < 6 else 'test'}{i % 6}", camera, drawn))

    def start(views: ViewSet, count: int, generator: torch.Generator) -> PointCloud:
        means = 1.4 * (torch.rand(count, 3, generator=generator) - 0.5)
        colours = 0.2 + 0.6 * torch.rand(count, channels, generator=generator)
        scalars = [spec for spec in conditions if spec.shape == ()]
        return PointCloud(
            means, colours, {spec.name: random_conformance_condition(spec, generator, (count,)) for spec in scalars}
        )

    return Dataset(
        name="conformance example",
        train=_ConformanceViews(views[:6], channels),
        test=_ConformanceViews(views[6:], channels),
        start=start,
        extent=camera_extent([view.camera for view in views[:6]]),
        background=torch.full((channels,), 0.3),
        channels=channels,
        data_source="generated",
        bounds=torch.tensor([[-0.8] * 3, [0.8] * 3]),
    )


def _conformance_camera(angle: float, height: float) -> Camera:
    eye = _DISTANCE * torch.tensor([math.cos(angle), math.sin(angle), height], dtype=torch.float64)
    focal = 0.5 * _WIDTH / math.tan(0.35)
    pose = look_at(eye, torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(pose, focal, focal, _WIDTH / 2, _HEIGHT / 2, _WIDTH, _HEIGHT)


def _conformance_ellipsoids(channels: int) -> LoweredPrimitives:
    geometry = Geometry(
        torch.tensor([[-0.35, 0.0, 0.0], [0.4, 0.1, 0.05], [0.0, -0.2, 0.4]]),
        torch.tensor([[0.4, 0.25, 0.3], [0.3, 0.35, 0.25], [0.2, 0.3, 0.2]]).log(),
        torch.tensor([[1.0, 0.1, 0.2, 0.0], [0.9, 0.0, -0.3, 0.2], [1.0, 0.0, 0.0, 0.0]]),
    )
    constant = Cosine(torch.zeros(3, 0, 3), torch.zeros(3, 0), torch.zeros(3, 0), torch.tensor([[2.5], [2.0], [1.5]]))
    colours = torch.tensor([[0.9, 0.15, 0.1], [0.1, 0.3, 0.85], [0.2, 0.7, 0.3]])
    return LoweredPrimitives(geometry, constant, Constant(colours[:, torch.arange(channels) % 3]))
