"""One view of a run as layers of one OpenEXR file: linear light, numbers beside it, and the camera and conditions in
its header."""

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
from neuprim.core.layers import LIGHTS, LayerFrame, LayerSpec, select_layers
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.near_plane import resolve_near
from neuprim.core.render.output import mean_depth
from neuprim.core.task import TaskSpec
from neuprim.plugins.returns import draw_task_layer
from neuprim.runs.render_config import RenderConfig
from neuprim.version import __version__

DATATYPES = ("half", "float")
"""Of light and alpha in a file; other numbers are 32-bit floats in either."""

_MOST_LIGHTS = 128
_REC709 = (0.64, 0.33, 0.3, 0.6, 0.15, 0.06, 0.3127, 0.329)  # those of sRGB: x and y of red, green, blue, white


def linear_light(image: Tensor, color_space: str, alpha: Tensor | None = None) -> Tensor:
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
class Layers:
    """Which layers of a run's views are written, and how.

    Attributes:
        names: as after ``--layers``; None: all but a layer per light.
        half: 16-bit floats for light and alpha.
        background: (C,) in the model's colour space. Beauty lies over it where alpha is not among the layers.
        lights: conditions of frames that add up, of light from all around; empty: the view's own light.
        world: in whose coordinates and units the file has cameras, positions and depths.
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
        if self.apart and len(self.lights) > _MOST_LIGHTS:
            many = f"{len(self.lights)} lights; expected at most {_MOST_LIGHTS}"
            raise ConfigError(f"--layers {LIGHTS}: {many}, a layer each (--environment-samples)")
        self.specs()  # refuses names that there are not

    @property
    def several(self) -> bool:
        """Whether frames of several lights add up."""
        return len(self.lights) > 0

    @property
    def apart(self) -> bool:
        """Whether every light gets a layer of its own."""
        return self.several and self.names is not None and LIGHTS in [part.strip() for part in self.names.split(",")]

    def specs(self) -> tuple[LayerSpec, ...]:
        """The layers that were asked for.

        Raises:
            ConfigError: a name of another one, or of light where the model's colours are no linear light.
        """
        found = select_layers(self.names, self.task.layers, self.several)
        if self.channels.color_space == "linear":
            return found
        if self.names is not None:
            light = [spec.name for spec in found if spec.light and spec.name != "beauty"] + [LIGHTS] * self.apart
            if light:
                raise ConfigError(
                    f"--layers {light[0]}: the model's colours are sRGB values, which do not add up; expected a model "
                    f"in linear light"
                )
        return tuple(spec for spec in found if not spec.light or spec.name == "beauty")

    def write(
        self, path: Path, model: Primitives, view: View, drawn: Callable[[Tensor], None] = lambda alpha: None
    ) -> None:
        """Draw and write one view; ``drawn`` is called after each of its lights, with the image's alpha.

        Raises:
            ConfigError: a layer was asked for by name that the model does not have.
            DataError: values that the file cannot hold, or it cannot be written.
        """
        small = self.point.scale_view(view)
        found: dict[str, Tensor] = {}
        present = {spec.name: spec for spec in self.specs()}
        for i, light in enumerate(self.lights or ({},)):
            conditions = {**small.conditions, **light}
            frame = LayerFrame(model, small.camera, conditions, self.point.settings, self.channels.color_space)
            for spec in list(present.values()):
                if i and not spec.light:
                    continue
                image = self._drawn(spec, frame)
                if image is None:
                    if self.names is not None:
                        raise ConfigError(f"--layers {spec.name}: this run's model has none ({spec.summary})")
                    del present[spec.name]
                else:
                    found[spec.name] = image if not i else found[spec.name] + image
            if self.apart:
                found[f"light_{i:03d}"] = frame.drawn.rgb.cpu()
            drawn(frame.drawn.alpha)
        alpha = frame.drawn.alpha.cpu()
        planes, summaries = self._planes(found, present, alpha, view)
        write_exr_layers(path, planes, {**self._attributes(model, view), **summaries})

    def _drawn(self, spec: LayerSpec, frame: LayerFrame) -> Tensor | None:
        """(H, W, C) on the processor; float64 where several lights add up."""
        image = draw_task_layer(spec, frame, self.channels.count)
        if image is None:
            return None
        image = image.cpu()
        return image.double() if self.several and spec.light else image

    def _planes(
        self, found: Mapping[str, Tensor], specs: Mapping[str, LayerSpec], alpha: Tensor, view: View
    ) -> tuple[dict[str, ExrChannel], dict[str, str]]:
        """Channel -> values of the view's own size, and the attributes that say what each layer is."""
        planes: dict[str, ExrChannel] = {}
        said: dict[str, str] = {}
        whole = self.point.upsample(alpha[..., None], view.camera)
        for name, image in found.items():
            spec = specs.get(name)
            image = image.float()
            if name == "depth":  # as the mean that it is: nothing of the 0 beside a silhouette
                weighted = self.point.upsample(image * alpha[..., None], view.camera)
                image = mean_depth(weighted, whole) / self.world.scale
            else:
                image = self.point.upsample(image, view.camera)
            if name == "beauty":
                image = self._beauty(image, whole[..., 0], "alpha" in found)
            light = spec is None or spec.light
            names = self.channels.names if spec is None or not spec.channels else spec.channels
            prefix = "" if name in ("beauty", "alpha") else f"{name}."
            planes |= {
                f"{prefix}{c}": ExrChannel(image[..., i], self.half and (light or name == "alpha"))
                for i, c in enumerate(names)
            }
            said[f"neuprim:layer:{name}"] = (
                "light of this light alone, premultiplied by alpha" if spec is None else spec.summary
            )
        if "beauty" in found and "alpha" not in found:
            said["neuprim:layer:beauty"] = "the image over the background, linear light"
        return planes, said

    def _beauty(self, image: Tensor, alpha: Tensor, premultiplied: bool) -> Tensor:
        space = self.channels.color_space
        if premultiplied:
            return linear_light(image, space, alpha)
        return linear_light(image + (1.0 - alpha)[..., None] * self.background.to(image), space)

    def _attributes(self, model: Primitives, view: View) -> dict[str, Any]:
        """What the file says about itself: camera, conditions, where it comes from and what its numbers are."""
        linear = self.channels.color_space == "linear"
        near = resolve_near(self.point.settings, model.params["means"], [view.camera]).near_plane
        found = {
            **camera_exr_attributes(self.world.world_camera(view.camera), near / self.world.scale),
            "software": f"neuprim {__version__}",
            "neuprim:run": self.run_dir.resolve().name,
            "neuprim:task": self.task.name,
            "neuprim:view": view.name,
            "neuprim:colorSpace": "linear light"
            if linear
            else "linear light, of a model whose colours are sRGB values",
            "neuprim:background": linear_light(self.background[None, None], self.channels.color_space)[0, 0].tolist(),
        }
        if self.channels.plain:
            found["chromaticities"] = _REC709
        replaced = {name for light in self.lights for name in light}
        for name, value in self._given(view.conditions):
            if name not in replaced:
                found[f"neuprim:condition:{name}"] = _attribute(value)
        for i, light in enumerate(self.lights if self.apart else ()):
            for name, value in self._given(light):
                found[f"neuprim:light_{i:03d}:{name}"] = _attribute(value)
        return found

    def _given(self, conditions: Conditions) -> Iterator[tuple[str, Tensor]]:
        """Conditions as users write them."""
        specs = {spec.name: spec for spec in self.task.conditions}
        for name, value in conditions.items():
            yield name, specs[name].given(value, self.world) if name in specs else value


def _attribute(value: Tensor) -> Any:
    """A condition as OpenEXR's Python package takes it: one number, two or three as a vector, others as a list."""
    numbers = value.detach().cpu().double().flatten().tolist()
    if len(numbers) == 1:
        return float(numbers[0])
    return (
        np.array(numbers, np.float64 if value.dtype == torch.float64 else np.float32)
        if len(numbers) in (2, 3)
        else numbers
    )
