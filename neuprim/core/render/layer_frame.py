"""Image layers, such as depth, that ``neuprim render --format exr`` can write, and the view they are computed from.

Every task has the layers in :data:`COMMON`; :attr:`neuprim.core.task.TaskSpec.layers` adds others.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.errors import ConfigError, FormError
from neuprim.core.model.fields import Conditions, Constant, LoweredColour
from neuprim.core.model.primitives import LoweredPrimitives, Primitives
from neuprim.core.render import RenderOutput, RenderSettings, render_lowered
from neuprim.core.render.output import unproject_rendered_depth

__all__ = ["LayerFrame", "LayerSpec"]

_CLEAR = 2e-4  # above this transmittance no primitive is clamped: alpha_max = 0.9999 alone gives half of it
_WEAKEN = 1 / 8
_ROUNDS = 14  # at most: thins by 8^14 = 4e12; float32 hardly needs more


@dataclass(frozen=True)
class LayerFrame:
    """One view of a model, with its image and its integrals along rays, from which image layers are computed.

    No value has a gradient.
    """

    model: Primitives
    camera: Camera
    conditions: Conditions  # a value of every condition of the task
    settings: RenderSettings
    color_space: str = "linear"

    @cached_property
    def lowered(self) -> LoweredPrimitives:
        """The primitives with the coefficients of density and colour for this frame, which the renderer integrates."""
        with torch.no_grad():
            return self.model.lower(self.camera, self.conditions, self.settings)

    @cached_property
    def drawn(self) -> RenderOutput:
        """The rendered image over black, with depth; ``rgb`` is premultiplied by ``alpha``."""
        return self._render(self.lowered, replace(self.settings, depth=True))

    @cached_property
    def emitted(self) -> Tensor | None:
        """Integral of extinction times colour along each ray, (H, W, C); None if colours vary within a primitive."""
        colours = self.lowered.colour.flat
        if colours is None:
            return None
        return torch.stack([self.integral(channel) for channel in colours.clamp_min(0.0).unbind(1)], -1)

    @cached_property
    def unshaded(self) -> Tensor:
        """Image over black, (H, W, C), without the shading (such as shadows) that the model's colour field computes."""
        with torch.no_grad():
            forms = self.model.lower(self.camera, self.conditions, shaded=False)
        return self._render(replace(self.lowered, colour=forms.colour, shade=None), self.settings).rgb

    @cached_property
    def shading(self) -> Tensor | None:
        """Mean shading factor of each pixel, (H, W): 1 without shadow, 0 where the ray hits nothing.

        None if the model computes no shading.
        """
        geometry, density = self.lowered.geometry, self.lowered.density
        with torch.no_grad():
            found = self.model.colour.shade(geometry, density, self.camera, self.conditions, self.settings)
        if found is None or (found.primitives is None and found.pixels is None):
            return None
        factor = torch.ones_like(self.drawn.alpha)
        if found.primitives is not None:
            seen = self.composite(Constant(found.primitives.to(geometry.means)[:, None]))[..., 0]
            factor = seen / torch.where(self.drawn.alpha > 0, self.drawn.alpha, 1.0)
        if found.pixels is not None:
            assert self.drawn.depth is not None
            hit = self.drawn.alpha > 0
            factor[hit] = factor[hit] * found.pixels(unproject_rendered_depth(self.drawn.depth, self.camera)[hit]).to(
                factor
            )
        return torch.where(self.drawn.alpha > 0, factor, 0.0)

    def composite(self, colour: LoweredColour) -> Tensor:
        """Return the (H, W, C') image over black, sum of alpha_i T_i c_i, where ``colour`` gives the colours c_i.

        alpha_i is the opacity of primitive i on the ray, T_i the transmittance in front of it.
        """
        return self._render(replace(self.lowered, colour=colour, shade=None), self.settings).rgb

    def integral(self, weights: Tensor | None = None) -> Tensor:
        """Return the (H, W) sum, along each ray, of weight times optical depth over all primitives.

        Each optical depth covers the whole chord behind the near plane and is at least 0. The settings ``alpha_max``,
        ``alpha_min`` and ``transmittance_min`` do not limit the result, because it is computed as -log of the
        transmittance of a medium of lower density.

        Args:
            weights: (N,) finite numbers of at least 0, one per primitive of :attr:`lowered`; None for 1.
        """
        count = self.lowered.geometry.count
        weights = torch.ones(count, device=self.lowered.geometry.means.device) if weights is None else weights.detach()
        if weights.shape != (count,) or not bool((weights.isfinite() & (weights >= 0)).all()):
            raise FormError(
                f"integral: weights have shape {tuple(weights.shape)}; expected ({count},) finite numbers, at least 0"
            )
        n, camera = self.settings.samples, self.camera
        camera = camera.resized(camera.width * n, camera.height * n)
        settings = replace(
            self.settings, samples=1, alpha_min=0.0, transmittance_min=0.0, alpha_max=0.9999, depth=False
        )
        found = self._thin(lambda factor: self._transmittance(weights * factor, camera, settings))
        return found if n == 1 else found.reshape(self.camera.height, n, self.camera.width, n).mean((1, 3))

    def _thin(self, transmittance: Callable[[float], Tensor]) -> Tensor:
        """Return the optical depth of each pixel; ``transmittance(x)`` renders the pixels with x times the density.

        The optical depth is -log(``transmittance(1)``), or -log(``transmittance(x)``)/x with x < 1 for opaque pixels.
        """
        T = transmittance(1.0)
        found, opaque, factor = _depth_of_transmittance(T), T <= _CLEAR, 1.0
        for _ in range(_ROUNDS):
            if not bool(opaque.any()):
                break
            factor *= _WEAKEN
            T = transmittance(factor)
            found, opaque = torch.where(opaque, _depth_of_transmittance(T) / factor, found), opaque & (T <= _CLEAR)
        return found.clamp_min(0.0).add(0.0).to(T.dtype)  # no -0

    def _transmittance(self, weights: Tensor, camera: Camera, settings: RenderSettings) -> Tensor:
        """Return the (H, W) transmittance of the primitives, each with its density multiplied by its weight, (N,).

        Renders black primitives over a white background.
        """
        lowered, means = self.lowered, self.lowered.geometry.means
        black = Constant(torch.zeros(len(means), 1, device=means.device))
        thin = replace(lowered, density=lowered.density.scaled(weights), colour=black, shade=None)
        with torch.no_grad():
            return render_lowered(thin, camera, settings, torch.ones(1, device=means.device)).rgb[..., 0]

    def _render(self, lowered: LoweredPrimitives, settings: RenderSettings) -> RenderOutput:
        with torch.no_grad():
            return render_lowered(lowered, self.camera, settings)


def _depth_of_transmittance(transmittance: Tensor) -> Tensor:
    """Return the float64 optical depth -log T, with T clamped to at least the smallest normal number of its dtype."""
    return -transmittance.clamp_min(torch.finfo(transmittance.dtype).tiny).double().log()


# ---------------------------------------------------------------- layers by name


@dataclass(frozen=True)
class LayerSpec:
    """One layer of the files that ``neuprim render --format exr`` writes.

    Attributes:
        name: what the user types after ``--layers``, and the prefix of the channel names; letters, digits and _.
        summary: one line with meaning and unit of the values; the summary is also written into the file.
        draw: function of a :class:`LayerFrame` that returns (H, W, C) finite values, or (H, W) for one channel. It
            returns None if the model of the frame has no such layer.
        channels: names of the channels; empty for a layer of light. A layer of light has the channels of the task's
            images, over black and premultiplied by alpha. It is summed over the lights of an environment and needs
            linear colours.
    """

    name: str
    summary: str
    draw: Callable[[LayerFrame], Tensor | None]
    channels: tuple[str, ...] = ()

    @property
    def light(self) -> bool:
        """Whether the layer's values are light, not data such as depth."""
        return not self.channels


LIGHTS = "lights"
"""Name with which ``--layers`` selects one layer per light (``light_000`` and so on), if several lights are on."""

COMMON: tuple[LayerSpec, ...] = (
    LayerSpec("beauty", "the image, linear light, premultiplied by alpha", lambda frame: frame.drawn.rgb),
    LayerSpec("alpha", "accumulated opacity, 0 to 1", lambda frame: frame.drawn.alpha, ("A",)),
    LayerSpec(
        "depth",
        "distance from the camera's plane (camera z), in the units of the data's files: the mean over the chord "
        "middles of what the pixel shows, weighted by its part in the pixel; 0 where alpha is 0",
        lambda frame: frame.drawn.depth,
        ("Z",),
    ),
    LayerSpec(
        "density",
        "density integral: the optical depth of the whole ray behind the near plane, without unit",
        LayerFrame.integral,
        ("Y",),
    ),
)
"""Layers of every task."""


def select_layers(text: str | None, own: Sequence[LayerSpec], several: bool) -> tuple[LayerSpec, ...]:
    """Return the layers that ``--layers`` names, in the order of the full list; without names, all layers.

    Args:
        text: names separated by commas, or None.
        own: the layers that the task adds to the common layers (:data:`COMMON`).
        several: whether several lights are on. If so, only common layers and the task's layers of light can be
            selected.

    Raises:
        ConfigError: an unknown name, or no name.
    """
    offered = (*COMMON, *(spec for spec in own if spec.light or not several))
    if text is None:
        return offered
    names = [part.strip() for part in text.split(",") if part.strip()]
    known = [spec.name for spec in offered] + [LIGHTS] * several
    for name in names:
        if name not in known:
            raise ConfigError(f"--layers {name}: no such layer; expected some of {', '.join(known)}")
    if not names:
        raise ConfigError(f"--layers {text!r}: no layers; expected some of {', '.join(known)}")
    return tuple(spec for spec in offered if spec.name in names)
