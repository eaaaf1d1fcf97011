"""What a frame's layers are made of: its light, its opacity, and other colours or integrals along the same rays."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.errors import FormError
from neuprim.core.model.fields import Conditions, Constant, LoweredColour
from neuprim.core.model.primitives import Lowered, Primitives
from neuprim.core.render import RenderOutput, RenderSettings, render_lowered
from neuprim.core.render.draw import unproject_depth

_CLEAR = 2e-4  # a transmittance above has no clamped primitive: one, at alpha_max = 0.9999, would halve it
_WEAKEN = 1 / 8
_ROUNDS = 14  # at most: densities of 4e12 along a ray, and float32 knows hardly more


@dataclass(frozen=True)
class LayerFrame:
    """One frame of a model as a layer sees it, under every condition of the task; nothing has a gradient, and
    everything is where the model is."""

    model: Primitives
    camera: Camera
    conditions: Conditions
    settings: RenderSettings
    color_space: str = "linear"

    @cached_property
    def lowered(self) -> Lowered:
        """The frame's closed forms, as it is drawn."""
        with torch.no_grad():
            return self.model.lower(self.camera, self.conditions, self.settings)

    @cached_property
    def drawn(self) -> RenderOutput:
        """The frame over black with its depth: ``rgb`` is premultiplied by ``alpha``."""
        return self._render(self.lowered, replace(self.settings, depth=True))

    @cached_property
    def emitted(self) -> Tensor | None:
        """(H, W, C) integral of sigma c along each ray, where each primitive has one colour in the frame; else None."""
        colours = self.lowered.colour.flat
        if colours is None:
            return None
        return torch.stack([self.integral(channel) for channel in colours.clamp_min(0.0).unbind(1)], -1)

    @cached_property
    def unshaded(self) -> Tensor:
        """(H, W, C) the frame over black without what :meth:`~neuprim.core.model.fields.ColourField.shade` multiplies
        its colours by."""
        with torch.no_grad():
            forms = self.model.lower(self.camera, self.conditions, shaded=False)
        return self._render(replace(self.lowered, colour=forms.colour, shade=None), self.settings).rgb

    @cached_property
    def shading(self) -> Tensor | None:
        """(H, W) mean factor of :meth:`~neuprim.core.model.fields.ColourField.shade` over what a pixel shows, 0 where
        nothing is hit; None for a colour that has none.
        """
        geometry, density = self.lowered.geometry, self.lowered.density
        with torch.no_grad():
            found = self.model.colour.shade(geometry, density, self.conditions, self.settings)
        if found is None or (found.primitives is None and found.pixels is None):
            return None
        factor = torch.ones_like(self.drawn.alpha)
        if found.primitives is not None:
            seen = self.composite(Constant(found.primitives.to(geometry.means)[:, None]))[..., 0]
            factor = seen / torch.where(self.drawn.alpha > 0, self.drawn.alpha, 1.0)
        if found.pixels is not None:
            assert self.drawn.depth is not None
            hit = self.drawn.alpha > 0
            factor[hit] = factor[hit] * found.pixels(unproject_depth(self.drawn.depth, self.camera)[hit]).to(factor)
        return torch.where(self.drawn.alpha > 0, factor, 0.0)

    def composite(self, colour: LoweredColour) -> Tensor:
        """(H, W, C') the frame over black with other colours of the primitives of :attr:`lowered`: the sum along each
        ray of a primitive's weight alpha_i T_i times its colour."""
        return self._render(replace(self.lowered, colour=colour, shade=None), self.settings).rgb

    def integral(self, weights: Tensor | None = None) -> Tensor:
        """(H, W) the sum along each ray of the primitives' optical depths, each times its weight: the integral of
        weight times sigma.

        Optical depths are those of whole chords behind the near plane, at least 0 each; nothing is clamped at
        ``alpha_max``, left out below ``alpha_min`` or cut where a ray ends. It is -log of the transmittance of a medium
        made as thin as that takes.

        Args:
            weights: (N,) at least 0, one for each primitive of :attr:`lowered`; None for 1.

        Raises:
            FormError: weights of another shape, negative or not finite.
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
        """-log of the transmittance for densities times 1, for the pixels that are opaque then for thinner ones, and so
        on."""
        T = transmittance(1.0)
        found, opaque, factor = _depth(T), T <= _CLEAR, 1.0
        for _ in range(_ROUNDS):
            if not bool(opaque.any()):
                break
            factor *= _WEAKEN
            T = transmittance(factor)
            found, opaque = torch.where(opaque, _depth(T) / factor, found), opaque & (T <= _CLEAR)
        return found.clamp_min(0.0).add(0.0).to(T.dtype)  # no -0

    def _transmittance(self, weights: Tensor, camera: Camera, settings: RenderSettings) -> Tensor:
        """(H, W) of the frame with densities times ``weights``: what is left of a white background behind black
        primitives."""
        lowered, means = self.lowered, self.lowered.geometry.means
        black = Constant(torch.zeros(len(means), 1, device=means.device))
        thin = replace(lowered, density=lowered.density.scaled(weights), colour=black, shade=None)
        with torch.no_grad():
            return render_lowered(thin, camera, settings, torch.ones(1, device=means.device)).rgb[..., 0]

    def _render(self, lowered: Lowered, settings: RenderSettings) -> RenderOutput:
        with torch.no_grad():
            return render_lowered(lowered, self.camera, settings)


def _depth(transmittance: Tensor) -> Tensor:
    """Optical depth, float64; of what float32 calls 0, that of its smallest number."""
    return -transmittance.clamp_min(torch.finfo(transmittance.dtype).tiny).double().log()
