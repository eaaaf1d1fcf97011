"""How a finished model is drawn, as ``key=value`` overrides of ``neuprim render``, ``eval`` and ``tradeoff``.

renderer.KEY=VALUE       any setting of the renderer, over the run's own
resolution=0.5           render at half the width and height, and upsample bilinearly
density.NAME=N           a smaller density, for example fewer neurons (Field.reductions)
colour.NAME=N            a smaller colour: bands of spherical harmonics, terms in time
store.GROUP=FORMAT       emulate storage of means, shape, density, colour or all of them in one of :data:`FORMATS`
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import torch
from torch import Tensor
from torch.nn.functional import interpolate

from neuprim.config.overrides import parse_overrides, quote_override
from neuprim.core.cameras.projections import AnyCamera
from neuprim.core.checkpoint import read_header
from neuprim.core.compression import is_compressed
from neuprim.core.compression.quantizers import fit_columns
from neuprim.core.data import View
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.reduction import KINDS, reduce_model, reduction_names, validate_reduction
from neuprim.core.render import RenderSettings, backends, render
from neuprim.core.validation import Range, validate_settings, validate_value

HEADS = ("renderer", "resolution", "density", "colour", "store")
"""First parts of the keys."""

_Resolution = Annotated[float, Range(above=0, at_most=1, says="a factor above 0, at most 1")]


# ---------------------------------------------------------------- storage formats

FLOAT32 = "float32"
"""Format of model files."""

FORMATS = (FLOAT32, "float16", "uint8")
"""``uint8`` has even steps between the ends of each column."""

GROUPS = ("means", "shape", "density", "colour")
"""Groups of parameters: centres, other numbers of the ellipsoids, and both fields."""

ALL_GROUPS = "all"


def _round_trip_run_storage(value: Tensor, format: str) -> Tensor:
    """(N, ...) float32 after storing and reading."""
    if format == "float16":
        return value.half().float()
    if format == FLOAT32:
        return value
    flat = value.detach().cpu().reshape(len(value), math.prod(value.shape[1:]))
    columns = fit_columns(flat, [8] * flat.shape[1])
    return columns.values(columns.codes(flat)).reshape(value.shape).to(value)


def _run_tensor_storage_bytes(value: Tensor, format: str) -> int:
    if format == "uint8":
        return value.numel() + 8 * math.prod(value.shape[1:])  # every column has two float32 ends
    return (2 if format == "float16" else 4) * value.numel()


def _run_storage_parameters(model: Primitives, group: str) -> tuple[str, ...]:
    if group == "means":
        return ("means",)
    if group == "shape":
        return tuple(spec.name for spec in GEOMETRY_SPECS if spec.name != "means")
    return tuple(spec.name for spec in (model.density if group == "density" else model.colour).parameters())


def emulate_run_storage(model: Primitives, storage: Mapping[str, str]) -> Primitives:
    """Return the model after storing groups of parameters in formats; itself if all are float32.

    Raises:
        ConfigError: a value is outside the range of its format.
    """
    if all(name == FLOAT32 for name in storage.values()):
        return model
    params = dict(model.params)
    for group, name in storage.items():
        for parameter in _run_storage_parameters(model, group):
            params[parameter] = _round_trip_run_storage(params[parameter].detach(), name)
            if not bool(torch.isfinite(params[parameter]).all()):
                raise ConfigError(f"store.{group}={name}: {parameter} has values outside the range of {name}")
    return Primitives(model.density, model.colour, params)


def run_storage_bytes(model: Primitives, storage: Mapping[str, str]) -> int:
    """Return the bytes of the model's tensors, each group in its format."""
    return sum(
        _run_tensor_storage_bytes(model.params[name], storage.get(group, FLOAT32))
        for group in GROUPS
        for name in _run_storage_parameters(model, group)
    )


def estimate_run_file_bytes(path: Path, full: Primitives, reduced: Primitives, storage: Mapping[str, str]) -> int:
    """Return the bytes of a run's model file if it held ``reduced`` in these formats instead of the ``full`` model.

    An unchanged model has its file's own size. Otherwise a compressed file, or one without zeros, counts as tensors.
    """
    size, after = path.stat().st_size, run_storage_bytes(reduced, storage)
    if not is_compressed(path) and "sparse" not in read_header(path, "model"):
        return size - run_storage_bytes(full, {}) + after
    return size if after == run_storage_bytes(full, {}) else after


# ---------------------------------------------------------------- render configuration


@dataclass(frozen=True)
class RenderConfig:
    """How to draw a model.

    Attributes:
        resolution: factor of width and height, above 0 and at most 1.
        reduced: ("density" or "colour", setting) -> its smaller value.
        storage: group of parameters -> name of a format.
    """

    settings: RenderSettings = field(default_factory=RenderSettings)
    resolution: float = 1.0
    reduced: Mapping[tuple[str, str], int] = field(default_factory=dict)
    storage: Mapping[str, str] = field(default_factory=dict)

    def to_overrides(self, defaults: RenderSettings) -> tuple[str, ...]:
        """Return overrides that :func:`parse_run_rendering` reads back, over default settings."""
        before = dataclasses.asdict(defaults)
        values = dataclasses.asdict(self.settings)
        words = [
            _format_run_render_override(f"renderer.{name}", value)
            for name, value in values.items()
            if value != before[name]
        ]
        words += [_format_run_render_override("resolution", self.resolution)] if self.resolution != 1.0 else []
        words += [f"{kind}.{name}={value}" for (kind, name), value in self.reduced.items()]
        formats = set(self.storage.values())
        if len(self.storage) == len(GROUPS) and len(formats) == 1 and formats != {FLOAT32}:
            return (*words, f"store.{ALL_GROUPS}={formats.pop()}")
        return (*words, *(f"store.{group}={name}" for group, name in self.storage.items() if name != FLOAT32))

    def prepare_model(self, model: Primitives) -> Primitives:
        """Return the model to draw: fields reduced first, then storage emulated; itself if nothing changes.

        Raises:
            ConfigError: a value is outside the range of its format.
        """
        for (kind, name), value in self.reduced.items():
            model = reduce_model(model, kind, name, value)
        return emulate_run_storage(model, self.storage)

    def scale_view(self, view: View) -> View:
        """Return the view at the resolution to draw."""
        if self.resolution == 1.0:
            return view
        size = (max(1, round(self.resolution * side)) for side in (view.camera.width, view.camera.height))
        return replace(view, camera=view.camera.resized(*size))

    def upsample(self, image: Tensor, camera: AnyCamera) -> Tensor:
        """Return an image at the camera's own size, (H, W, C)."""
        size = (camera.height, camera.width)
        if image.shape[:2] == size:
            return image
        large = interpolate(image.permute(2, 0, 1)[None], size, mode="bilinear", align_corners=False)
        return large[0].permute(1, 2, 0).contiguous()

    def render_view(
        self, model: Primitives, view: View, background: Tensor, on_alpha: Callable[[Tensor], None] = lambda alpha: None
    ) -> Tensor:
        """Render a view of a model from :meth:`prepare_model`, without gradients: (H, W, C) on the CPU.

        Args:
            on_alpha: called with the image's alpha.
        """
        small = self.scale_view(view)
        with torch.no_grad():
            frame = render(model, small.camera, small.conditions, self.settings, background)
        on_alpha(frame.alpha)
        return self.upsample(frame.rgb.cpu(), view.camera)


def parse_run_rendering(overrides: Sequence[str], defaults: RenderSettings, model: Primitives) -> RenderConfig:
    """Parse overrides of the rendering of a model, over default settings.

    Raises:
        ConfigError: an unknown key, setting or format, a reduction that the model's fields lack, or an invalid value.
    """
    values: dict[str, Any] = dataclasses.asdict(defaults)
    resolution, reduced, storage = 1.0, dict[tuple[str, str], int](), dict[str, str]()
    for assignment in parse_overrides(overrides):
        head, dot, name = assignment.key.partition(".")
        if head == "resolution" and not dot:
            resolution = validate_value(assignment.value, _Resolution, "resolution")
        elif head == "renderer" and dot:
            values[name] = assignment.value
        elif head in KINDS and dot:
            reduced[head, name] = validate_reduction(model.density, model.colour, head, name, assignment.value)
        elif head == "store" and dot:
            format = _check_run_storage_format(name, assignment.value)
            storage |= dict.fromkeys(GROUPS if name == ALL_GROUPS else [name], format)
        else:
            known = [
                *(f"renderer.{name}" for name in values),
                "resolution",
                *(f"store.{name}" for name in (*GROUPS, ALL_GROUPS)),
                *reduction_names(model.density, model.colour),
            ]
            raise ConfigError(f"{assignment.key}: no setting of rendering{nearest(assignment.key, known)}")
    settings = validate_settings(RenderSettings, values, "renderer")
    if settings.near == "auto":
        settings = dataclasses.replace(settings, near=defaults.near)  # resolved by the run's training
    backends.check_backend_name(settings.backend)
    backends.check_backend_device(settings)
    return RenderConfig(settings, resolution, dict(sorted(reduced.items())), dict(sorted(storage.items())))


def _check_run_storage_format(group: str, name: Any) -> str:
    if group not in (*GROUPS, ALL_GROUPS):
        raise ConfigError(f"store.{group}: no such group of parameters{nearest(group, (*GROUPS, ALL_GROUPS))}")
    if name not in FORMATS:
        raise ConfigError(f"store.{group}={name}: no such format{nearest(str(name), FORMATS)}")
    return str(name)


def _format_run_render_override(key: str, value: Any) -> str:
    if isinstance(value, str):
        return quote_override(key, value)
    return f"{key}={str(value).lower() if isinstance(value, bool) else repr(value).removesuffix('.0')}"
