"""Write one view of a run as layers of one OpenEXR file: linear light, numbers beside it, and the camera and conditions
in its header."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import camera_exr_attributes
from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels
from neuprim.core.data import View
from neuprim.core.errors import ConfigError
from neuprim.core.io.exr import ExrChannel, write_exr_layers
from neuprim.core.io.images import srgb_to_linear
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.layer_frame import LIGHTS, LayerFrame, LayerSpec, select_layers
from neuprim.core.render.near_plane import resolve_near
from neuprim.core.render.output import mean_depth
from neuprim.core.task import TaskSpec
from neuprim.plugins.returns import draw_task_layer
from neuprim.runs.render_config import RenderConfig
from neuprim.version import __version__

_MOST_LIGHTS = 128
_REC709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)  # those of sRGB: x and y of red, green, blue, white


def _linear_light_of_run_layer(image: Tensor, color_space: str, alpha: Tensor | None = None) -> Tensor:
    """(H, W, C) linear light of an image in a data set's colour space; sRGB values lose what is below 0.

    Args:
        alpha: (H, W) that the image is premultiplied by. The curve applies to the colour without it.
    """
    if color_space == "linear":
        return image
    if alpha is None:
        return srgb_to_linear(image.clamp_min(0.0))
    opacity = alpha[..., None]
    return opacity * srgb_to_linear((image / torch.where(opacity > 0, opacity, 1.0)).clamp_min(0.0))


@dataclass(frozen=True)
class RunExrLayers:
    """Which layers of a run's views are written, and how.

    Attributes:
        names: as after ``--layers``; None: all but a layer per light.
        half: 16-bit floats for light and alpha.
        background: (C,) in the model's colour space. Beauty lies over it where alpha is not among the layers.
        lights: conditions of frames that add up, of light from all around; empty: the view's own light.
        world: in whose coordinates and units the file has cameras, positions and depths.

    Raises:
        ConfigError: no such layer, or one of light where the model's colours are no linear light.
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

    def __post_init__(self) -> None:
        if self._splits_lights and len(self.lights) > _MOST_LIGHTS:
            raise ConfigError(
                f"--layers {LIGHTS}: {len(self.lights)} lights; expected at most {_MOST_LIGHTS}, a layer each "
                f"(--environment-samples)"
            )
        self._layer_specs()

    @property
    def _splits_lights(self) -> bool:
        """Whether every light gets a layer of its own."""
        return bool(self.lights) and self.names is not None and LIGHTS in [n.strip() for n in self.names.split(",")]

    def _layer_specs(self) -> tuple[LayerSpec, ...]:
        found = select_layers(self.names, self.task.layers, bool(self.lights))
        if self.channels.color_space == "linear":
            return found
        light = [spec.name for spec in found if spec.light and spec.name != "beauty"] + [LIGHTS] * self._splits_lights
        if self.names is not None and light:
            raise ConfigError(
                f"--layers {light[0]}: the model's colours are sRGB values, which do not add up; expected a model in "
                f"linear light"
            )
        return tuple(spec for spec in found if spec.name not in light)

    def write(
        self, path: Path, model: Primitives, view: View, on_alpha: Callable[[Tensor], None] = lambda alpha: None
    ) -> None:
        """Draw and write one view; ``on_alpha`` is called after each of its lights, with the image's alpha.

        Raises:
            ConfigError: a layer was asked for by name that the model does not have.
            DataError: values that the file cannot hold, or it cannot be written.
        """
        small, settings = self.point.scale_view(view), self.point.settings
        found: dict[str, Tensor] = {}
        present = {spec.name: spec for spec in self._layer_specs()}
        for i, light in enumerate(self.lights or ({},)):
            conditions = {**small.conditions, **light}
            frame = LayerFrame(model, small.camera, conditions, settings, self.channels.color_space)
            for spec in list(present.values()):
                if i and not spec.light:
                    continue
                image = draw_task_layer(spec, frame, self.channels.count)
                if image is None:
                    if self.names is not None:
                        raise ConfigError(f"--layers {spec.name}: this run's model has none ({spec.summary})")
                    del present[spec.name]
                    continue
                image = image.cpu().double() if self.lights and spec.light else image.cpu()
                found[spec.name] = found[spec.name] + image if i else image
            if self._splits_lights:
                found[f"light_{i:03d}"] = frame.drawn.rgb.cpu()
            on_alpha(frame.drawn.alpha)
        channels, summaries = self._exr_channels(found, present, frame.drawn.alpha.cpu(), view)
        write_exr_layers(path, channels, {**self._exr_attributes(model, view), **summaries})

    def _exr_channels(
        self, found: Mapping[str, Tensor], specs: Mapping[str, LayerSpec], alpha: Tensor, view: View
    ) -> tuple[dict[str, ExrChannel], dict[str, str]]:
        """Channel -> values of the view's own size, and the attributes that say what each layer is."""
        channels: dict[str, ExrChannel] = {}
        summaries: dict[str, str] = {}
        large_alpha = self.point.upsample(alpha[..., None], view.camera)
        for name, image in found.items():
            spec, image = specs.get(name), image.float()
            if name == "depth":  # as the mean that it is: nothing of the 0 beside a silhouette
                weighted = self.point.upsample(image * alpha[..., None], view.camera)
                image = mean_depth(weighted, large_alpha) / self.world.scale
            else:
                image = self.point.upsample(image, view.camera)
            if name == "beauty" and "alpha" in found:
                image = _linear_light_of_run_layer(image, self.channels.color_space, large_alpha[..., 0])
            elif name == "beauty":
                image = image + (1.0 - large_alpha) * self.background.to(image)
                image = _linear_light_of_run_layer(image, self.channels.color_space)
            half = self.half and (spec is None or spec.light or name == "alpha")
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
        """What the file says about itself: camera, conditions, where it comes from and what its numbers are."""
        space = self.channels.color_space
        near = resolve_near(self.point.settings, model.params["means"], [view.camera]).near_plane
        origin = "" if space == "linear" else ", of a model whose colours are sRGB values"
        found = {
            **camera_exr_attributes(self.world.world_camera(view.camera), near / self.world.scale),
            "software": f"neuprim {__version__}",
            "neuprim:run": self.run_dir.resolve().name,
            "neuprim:task": self.task.name,
            "neuprim:view": view.name,
            "neuprim:colorSpace": f"linear light{origin}",
            "neuprim:background": _linear_light_of_run_layer(self.background[None, None], space)[0, 0].tolist(),
        }
        if self.channels.is_rgb:
            found["chromaticities"] = _REC709
        replaced = {name for light in self.lights for name in light}
        for name, value in self._condition_values(view.conditions):
            if name not in replaced:
                found[f"neuprim:condition:{name}"] = value
        for i, light in enumerate(self.lights if self._splits_lights else ()):
            found |= {f"neuprim:light_{i:03d}:{name}": value for name, value in self._condition_values(light)}
        return found

    def _condition_values(self, conditions: Conditions) -> Iterator[tuple[str, Any]]:
        """Conditions as users write them and as OpenEXR takes them: one number, two or three as a vector, others as a
        list."""
        specs = {spec.name: spec for spec in self.task.conditions}
        for name, value in conditions.items():
            given = specs[name].given(value, self.world) if name in specs else value
            numbers: Any = given.detach().cpu().double().flatten().tolist()
            if len(numbers) in (2, 3):
                numbers = np.array(numbers, np.float64 if given.dtype == torch.float64 else np.float32)
            yield name, float(numbers[0]) if len(numbers) == 1 else numbers
