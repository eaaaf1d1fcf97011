"""Render configurations of finished models: ``key=value`` overrides of ``neuprim render``, ``eval``, ``tradeoff``.

renderer.KEY=VALUE       replace a setting of the run's renderer
resolution=0.5           render at half the width and height, and upsample bilinearly
density.NAME=N           reduce the density of all primitives, e.g. to fewer neurons (Field.reductions)
colour.NAME=N            reduce the colour of all primitives, e.g. to fewer bands of spherical harmonics or lobes

A view is rendered as an image, or as layers of one OpenEXR file. The file holds linear light and data such as depth;
its header holds the camera and the conditions.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import interpolate

from neuprim.config.overrides import parse_overrides, quote_override
from neuprim.core.cameras.pinhole import AnyCamera, camera_exr_attributes
from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels
from neuprim.core.checkpoint import read_header
from neuprim.core.compression.file import is_compressed
from neuprim.core.data import View
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.io.exr import REC709, ExrChannel, write_deep_exr, write_exr_layers
from neuprim.core.io.images import srgb_to_linear
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import KINDS, Primitives, reduce_model, reduction_names, validate_reduction
from neuprim.core.render import RenderSettings, backends, render
from neuprim.core.render.layer_frame import LIGHTS, LayerFrame, LayerSpec, select_layers
from neuprim.core.render.near_plane import resolve_near
from neuprim.core.render.output import mean_depth
from neuprim.core.task import TaskSpec
from neuprim.core.validation import Range, validate_settings, validate_value
from neuprim.plugins.attribution import draw_task_layer
from neuprim.runs.color_space import OutputColorSpace
from neuprim.runs.deep_images import draw_deep_image
from neuprim.runs.shutter import Shutter
from neuprim.version import __version__

_Resolution = Annotated[float, Range(above=0, at_most=1, says="a factor above 0, at most 1")]

__all__ = ["RenderConfig", "parse_run_rendering"]

_MOST_LIGHTS = 128
_COVERAGE = "(alpha)"  # no name of a layer


def estimate_run_file_bytes(path: Path, full: Primitives, reduced: Primitives) -> int:
    """Estimate the size in bytes that the model file at ``path`` would have with the model ``reduced``.

    The file holds the model ``full``. If both models have equally many values, the result is the size of the file. For
    a smaller model and a compressed or sparse file, the result is the size of uncompressed float32 tensors.
    """
    before, after = (4 * model.count * model.parameters_per_primitive for model in (full, reduced))
    size = path.stat().st_size
    if not is_compressed(path) and "sparse" not in read_header(path, "model"):
        return size - before + after
    return size if after == before else after


# ---------------------------------------------------------------- render configuration


@dataclass(frozen=True)
class RenderConfig:
    """A render configuration: how to render a finished model."""

    settings: RenderSettings = field(default_factory=RenderSettings)  # overrides renderer.KEY=VALUE
    resolution: float = 1.0  # factor on width and height, above 0 and at most 1; override resolution=0.5
    # reduced settings of fields: ("density" or "colour", name) -> smaller value; override colour.degree=1
    reduced: Mapping[tuple[str, str], int] = field(default_factory=dict)

    def to_overrides(self, defaults: RenderSettings) -> tuple[str, ...]:
        """Return ``key=value`` texts from which :func:`parse_run_rendering` restores this object, with ``defaults``."""
        before = dataclasses.asdict(defaults)
        values = dataclasses.asdict(self.settings)
        words = [
            _format_run_render_override(f"renderer.{name}", value)
            for name, value in values.items()
            if value != before[name]
        ]
        words += [_format_run_render_override("resolution", self.resolution)] if self.resolution != 1.0 else []
        return (*words, *(f"{kind}.{name}={value}" for (kind, name), value in self.reduced.items()))

    def prepare_model(self, model: Primitives) -> Primitives:
        """Return the model with this configuration's reductions, e.g. fewer neurons; unchanged if there are none."""
        for (kind, name), value in self.reduced.items():
            model = reduce_model(model, kind, name, value)
        return model

    def scale_view(self, view: View) -> View:
        """Return the view with width and height of its camera's image multiplied by ``resolution``."""
        if self.resolution == 1.0:
            return view
        size = (max(1, round(self.resolution * side)) for side in (view.camera.width, view.camera.height))
        return replace(view, camera=view.camera.resized(*size))

    def upsample(self, image: Tensor, camera: AnyCamera) -> Tensor:
        """Scale an (H, W, C) image bilinearly to the width and height of the camera."""
        size = (camera.height, camera.width)
        if image.shape[:2] == size:
            return image
        large = interpolate(image.permute(2, 0, 1)[None], size, mode="bilinear", align_corners=False)
        return large[0].permute(1, 2, 0).contiguous()

    def render_view(
        self, model: Primitives, view: View, background: Tensor, on_alpha: Callable[[Tensor], None] = lambda alpha: None
    ) -> Tensor:
        """Render a view without gradients; return its (H, W, C) image on the CPU.

        Args:
            model: the result of :meth:`prepare_model`.
            on_alpha: function that is called with the alpha of the image.
        """
        small = self.scale_view(view)
        with torch.no_grad():
            frame = render(model, small.camera, small.conditions, self.settings, background)
        on_alpha(frame.alpha)
        return self.upsample(frame.rgb.cpu(), view.camera)


def parse_run_rendering(overrides: Sequence[str], defaults: RenderSettings, model: Primitives) -> RenderConfig:
    """Parse overrides such as ``renderer.samples=2`` and ``resolution=0.5`` into a render configuration.

    Args:
        defaults: values of settings that the overrides do not name.

    Raises:
        ConfigError: an unknown key or setting, a reduction that the model's fields lack, or an invalid value.
    """
    values: dict[str, Any] = dataclasses.asdict(defaults)
    resolution, reduced = 1.0, dict[tuple[str, str], int]()
    for assignment in parse_overrides(overrides):
        head, dot, name = assignment.key.partition(".")
        if head == "resolution" and not dot:
            resolution = validate_value(assignment.value, _Resolution, "resolution")
        elif head == "renderer" and dot:
            values[name] = assignment.value
        elif head in KINDS and dot:
            reduced[head, name] = validate_reduction(model.density, model.colour, head, name, assignment.value)
        else:
            known = [
                *(f"renderer.{name}" for name in values),
                "resolution",
                *reduction_names(model.density, model.colour),
            ]
            raise ConfigError(f"{assignment.key}: no such rendering setting{nearest(assignment.key, known)}")
    settings = validate_settings(RenderSettings, values, "renderer")
    if settings.near == "auto":
        settings = dataclasses.replace(settings, near=defaults.near)  # resolved by the run's training
    backends.check_backend_name(settings.backend)
    backends.check_backend_device(settings)
    return RenderConfig(settings, resolution, dict(sorted(reduced.items())))


def _format_run_render_override(key: str, value: Any) -> str:
    if isinstance(value, str):
        return quote_override(key, value)
    return f"{key}={str(value).lower() if isinstance(value, bool) else repr(value).removesuffix('.0')}"


# ---------------------------------------------------------------- OpenEXR layers


@dataclass(frozen=True)
class RunExrLayers:
    """Writer of a run's views as OpenEXR files, one file per view, with layers such as colour, alpha and depth.

    Attributes:
        point: how to render the model.
        names: comma-separated names of the layers, as after ``--layers``; None: all layers except those of single
            lights.
        half: whether alpha and the layers that hold light are stored as 16-bit floats.
        background: (C,) in the model's colour space. Without an alpha layer, the layer "beauty" is
            composited over the background.
        lights: conditions of the lights of an environment map, over which images are summed; empty: the view's light.
        world: coordinates and units of cameras, positions and depths in the file.
        fps: frames per second of the sequence that the images belong to; None if unknown.
        shutter: shutter of the motion blur, which averages each layer over sub-frames, and depth with alpha as weight;
            None: no motion blur.
        color_space: colour space of the layers that hold light; None: linear Rec. 709.
        compression: name in :data:`~neuprim.core.io.exr.COMPRESSIONS`.
        crop: whether files store only the pixels around the visible part of the model (the data window).
        deep: largest number of samples of a pixel in deep files, which have only colour, alpha and depths; None: write
            flat files.

    Raises:
        ConfigError: a layer is unknown, or holds light although the model's colours are not linear light; a colour
            space is given although the channels are not R, G, B; files are cropped that store the background; or an
            option has no meaning for deep files.
    """

    run_dir: Path
    task: TaskSpec
    channels: Channels
    point: RenderConfig
    background: Tensor
    names: str | None = None
    half: bool = False
    lights: Sequence[Conditions] = ()
    world: World = field(default_factory=World)
    fps: float | None = None
    shutter: Shutter | None = None
    color_space: OutputColorSpace | None = None
    compression: str = "zip"
    crop: bool = False
    deep: int | None = None

    def __post_init__(self) -> None:
        if self.deep is not None:
            self._check_deep()
        names = [spec.name for spec in self._layer_specs()]
        if self.crop and "beauty" in names and "alpha" not in names:
            raise ConfigError("--crop: without the layer alpha, beauty contains the background; expected alpha, too")
        if self.color_space is not None and not self.channels.is_rgb:
            found = ", ".join(self.channels.names)
            raise ConfigError(f"--colorspace {self.color_space.name}: expected channels R, G, B; found {found}")

    def _check_deep(self) -> None:
        for fault, expected in (
            (self.channels.color_space != "linear", "a model in linear light; the colours of this model are sRGB"),
            (self.names is not None, "no --layers, as deep files have only colour, alpha and depths"),
            (self.shutter is not None, "no --shutter"),
            (self.crop, "no --crop, as empty pixels of deep files take no space"),
            (self.compression != "zip", "no --compression, as deep files can use only zip"),
            (self.point.resolution != 1.0, "resolution=1"),
            (self.point.settings.sort != "center", "renderer.sort=center, the order of slices of depth"),
            (self.point.settings.samples != 1, "renderer.samples=1, as a mean of rays has no depths"),
            (not {"A", "Z", "ZBack"}.isdisjoint(self.channels.names), "channels with other names than A, Z and ZBack"),
        ):
            if fault:
                raise ConfigError(f"--deep: expected {expected}")

    @property
    def _splits_lights(self) -> bool:
        """Whether each light of an environment map gets its own layer: whether the user named the layer "lights"."""
        return bool(self.lights) and self.names is not None and LIGHTS in [n.strip() for n in self.names.split(",")]

    def _layer_specs(self) -> tuple[LayerSpec, ...]:
        if self._splits_lights and len(self.lights) > _MOST_LIGHTS:
            raise ConfigError(
                f"--layers {LIGHTS}: {len(self.lights)} lights need one layer each; expected at most {_MOST_LIGHTS} "
                f"lights (lower --environment-samples)"
            )
        found = select_layers(self.names, self.task.layers, bool(self.lights))
        if self.channels.color_space == "linear":
            return found
        light = [spec.name for spec in found if spec.light and spec.name != "beauty"] + [LIGHTS] * self._splits_lights
        if self.names is not None and light:
            raise ConfigError(
                f"--layers {light[0]}: layers of light need linear colours, but the model's are sRGB; expected a model "
                f"in linear light"
            )
        return tuple(spec for spec in found if spec.name not in light)

    def write(
        self, path: Path, model: Primitives, view: View, on_alpha: Callable[[Tensor], None] = lambda alpha: None
    ) -> None:
        """Render one view and write its layers; ``on_alpha`` is called with the alpha of each rendered image.

        Raises:
            ConfigError: the user named a layer that the model does not have.
            DataError: the file cannot hold the values, or it cannot be written.
        """
        if self.deep is not None:
            return self._write_deep(path, model, view, self.deep, on_alpha)
        present = {spec.name: spec for spec in self._layer_specs()}
        mean: dict[str, Tensor] = {}
        sub_frames = [view] if self.shutter is None else self.shutter.sub_frames(view)
        for moment in sub_frames:
            for name, image in self._draw_layers(model, moment, present, on_alpha).items():
                mean[name] = mean.get(name, 0.0) + image.double() / len(sub_frames)
        channels, summaries = self._exr_channels(mean, present)
        visible = mean[_COVERAGE][..., 0] > 0 if self.crop else None
        write_exr_layers(path, channels, {**self._exr_attributes(model, view), **summaries}, self.compression, visible)

    def _write_deep(
        self, path: Path, model: Primitives, view: View, most: int, on_alpha: Callable[[Tensor], None]
    ) -> None:
        image = draw_deep_image(model, view, self.point.settings, self.lights, most, on_alpha, self.world.scale)
        light = image.rgb if self.color_space is None else self.color_space.convert(image.rgb)
        colors = {name: light[:, i] for i, name in enumerate(self.channels.names)}
        samples = {n: ExrChannel(v[:, None], self.half) for n, v in {**colors, "A": image.alpha}.items()}
        samples |= {"Z": ExrChannel(image.front[:, None]), "ZBack": ExrChannel(image.back[:, None])}
        write_deep_exr(path, image.counts, samples, self._exr_attributes(model, view))

    def _draw_layers(
        self, model: Primitives, view: View, present: dict[str, LayerSpec], on_alpha: Callable[[Tensor], None]
    ) -> dict[str, Tensor]:
        """Render a view; return layer name -> (H, W, C) values.

        Colours are linear light, and depth is multiplied by alpha, so that the values can be averaged over sub-frames.
        The entry ``_COVERAGE`` is alpha. Layers that the model does not have are removed from ``present``.
        """
        small, settings = self.point.scale_view(view), self.point.settings
        found: dict[str, Tensor] = {}
        for i, light in enumerate(self.lights or ({},)):
            conditions = {**small.conditions, **light}
            frame = LayerFrame(model, small.camera, conditions, settings, self.channels.color_space)
            for spec in list(present.values()):
                if i and not spec.light:
                    continue
                image = draw_task_layer(spec, frame, self.channels.count)
                if image is None:
                    if self.names is not None:
                        raise ConfigError(f"--layers {spec.name}: this run's model has no such layer ({spec.summary})")
                    del present[spec.name]
                    continue
                image = image.cpu().double() if self.lights and spec.light else image.cpu()
                found[spec.name] = found[spec.name] + image if i else image
            if self._splits_lights:
                found[f"light_{i:03d}"] = frame.drawn.rgb.cpu()
            on_alpha(frame.drawn.alpha)
        alpha = frame.drawn.alpha.cpu()[..., None]
        if "depth" in found:  # so that the 0 outside a silhouette has no effect
            found["depth"] = found["depth"] * alpha
        large = {name: self.point.upsample(image.float(), view.camera) for name, image in found.items()}
        coverage = self.point.upsample(alpha, view.camera)
        if "beauty" in large:
            image, space = large["beauty"], self.channels.color_space
            if "alpha" in large:
                large["beauty"] = _linear_light_of_run_layer(image, space, coverage[..., 0])
            else:
                large["beauty"] = _linear_light_of_run_layer(image + (1 - coverage) * self.background.to(image), space)
        return {**large, _COVERAGE: coverage}

    def _exr_channels(
        self, found: Mapping[str, Tensor], specs: Mapping[str, LayerSpec]
    ) -> tuple[dict[str, ExrChannel], dict[str, str]]:
        """Convert layers to OpenEXR channels; return channel name -> channel, and a header text for each layer.

        Args:
            found: layer name -> values of :meth:`_draw_layers`, averaged over sub-frames.
            specs: layer name -> specification of the layer.
        """
        channels: dict[str, ExrChannel] = {}
        summaries: dict[str, str] = {}
        for name, values in found.items():
            if name == _COVERAGE:
                continue
            spec, image = specs.get(name), values
            if name == "depth":
                image = mean_depth(image, found[_COVERAGE]) / self.world.scale
            image = image.float()
            light = spec is None or spec.light
            if light and self.color_space is not None:
                image = self.color_space.convert(image)
            half = self.half and (light or name == "alpha")
            names = self.channels.names if spec is None or not spec.channels else spec.channels
            prefix = "" if name in ("beauty", "alpha") else f"{name}."
            channels |= {f"{prefix}{c}": ExrChannel(image[..., i], half) for i, c in enumerate(names)}
            summaries[f"neuprim:layer:{name}"] = (
                "light of this light alone, premultiplied by alpha" if spec is None else spec.summary
            )
        if "beauty" in found and "alpha" not in found:
            summaries["neuprim:layer:beauty"] = "the image over the background, linear light"
        return channels, summaries

    def _exr_attributes(self, model: Primitives, view: View) -> dict[str, Any]:
        """Return the file's header attributes: camera, conditions, name of the run, and colour space."""
        space = self.channels.color_space
        near = resolve_near(self.point.settings, model.params["means"], [view.camera]).near_plane
        origin = "" if space == "linear" else ", of a model whose colours are sRGB values"
        background = _linear_light_of_run_layer(self.background[None, None], space)[0, 0]
        if self.color_space is not None:
            background = self.color_space.convert(background)
            origin += f", in {self.color_space.name}"
        found = {
            **camera_exr_attributes(self.world.world_camera(view.camera), near / self.world.scale),
            "software": f"neuprim {__version__}",
            "neuprim:run": self.run_dir.resolve().name,
            "neuprim:task": self.task.name,
            "neuprim:view": view.name,
            "neuprim:colorSpace": f"linear light{origin}",
            "neuprim:background": background.tolist(),
        }
        if self.color_space is not None:
            found["oiio:ColorSpace"] = self.color_space.name
        if self.channels.is_rgb:
            chromaticities = REC709 if self.color_space is None else self.color_space.chromaticities
            if chromaticities is not None:
                found["chromaticities"] = chromaticities
        if self.fps is not None:
            broadcast = Fraction(round(1.001 * self.fps) * 1000, 1001)  # 23.976 means 24000/1001
            close = abs(broadcast - self.fps) < 0.002
            found["framesPerSecond"] = broadcast if close else Fraction(self.fps).limit_denominator(1000)
        if self.shutter is not None:
            found["neuprim:shutter"] = self.shutter.fraction
        replaced = {name for light in self.lights for name in light}
        for name, value in self._condition_values(view.conditions):
            if name not in replaced:
                found[f"neuprim:condition:{name}"] = value
        for i, light in enumerate(self.lights if self._splits_lights else ()):
            found |= {f"neuprim:light_{i:03d}:{name}": value for name, value in self._condition_values(light)}
        return found

    def _condition_values(self, conditions: Conditions) -> Iterator[tuple[str, Any]]:
        """Yield (name, value) of the conditions, in the user's coordinates, as OpenEXR types: a number, a vector of two
        or three, or a list."""
        specs = {spec.name: spec for spec in self.task.conditions}
        for name, value in conditions.items():
            given = specs[name].given(value, self.world) if name in specs else value
            numbers: Any = given.detach().cpu().double().flatten().tolist()
            if len(numbers) in (2, 3):
                numbers = np.array(numbers, np.float64 if given.dtype == torch.float64 else np.float32)
            yield name, float(numbers[0]) if len(numbers) == 1 else numbers


def _linear_light_of_run_layer(image: Tensor, color_space: str, alpha: Tensor | None = None) -> Tensor:
    """Convert an (H, W, C) image from ``color_space`` to linear light; negative sRGB values become 0.

    Args:
        alpha: (H, W) alpha by which the image is premultiplied; None for an image that is not premultiplied. The
            transfer curve is applied to the unpremultiplied colour.
    """
    if color_space == "linear":
        return image
    if alpha is None:
        return srgb_to_linear(image.clamp_min(0.0))
    opacity = alpha[..., None]
    return opacity * srgb_to_linear((image / torch.where(opacity > 0, opacity, 1.0)).clamp_min(0.0))
