"""Colour under a point light: one hidden layer per primitive (equation 14), with or without a light-visibility factor.

    h = cos(beta (W_x x~ + W_d d + W_l l + b))         x~ the local middle of the chord, d and l unit vectors at the
    centre:
                                                       from the camera, and to the light
    additive         c = V E max(0, c_dc + W_out h)                         equation 14: 9 -> H -> 3, 107 parameters at
    H = 8 multiplicative   c = V E max(0, albedo (1 + w_out . h))                 no tinting: 91 parameters

E is the light's intensity, divided by the squared distance where the data set says so, over that of a typical training
light, so that learning rates do not depend on the data's unit of light; V the visibility of the light from the
primitive (:mod:`neuprim.tasks.relight.visibility`) or 1. Everything but W_x x~ is constant over a primitive, so it
folds into the closed form :class:`~neuprim.core.model.forms.RayNet`, which the renderer evaluates per pixel.
"""

from __future__ import annotations

import math
from typing import Any

from torch import Tensor

from neuprim.core.cameras.projections import AnyCamera
from neuprim.core.compute import device
from neuprim.core.model.cosine_sums import canonicalize_cosines, smaller_neuron_counts
from neuprim.core.model.fields import ColourField, Conditions, LoweredDensity, RayNet, Shading, read_script
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import InitContext, ParameterSpec, Params
from neuprim.core.settings import RenderSettings
from neuprim.tasks.relight.directions import least_square, unit
from neuprim.tasks.relight.fewer import fewer_units
from neuprim.tasks.relight.visibility import light_visibility

__all__ = ["FORMS", "LightNetwork"]

FORMS = ("additive", "multiplicative")

VISIBILITY = ("none", "primitive", "pixel")


class LightNetwork(ColourField):
    """See the module. H = 0 is the constant colour c_dc (times V and E).

    Args:
        hidden: H, 0..16.
        form: one of :data:`FORMS`.
        visibility: where a depth image out of the light is asked whether light arrives: nowhere ("none": equation 14 as
        printed), at
            the centres of primitives ("primitive"), or at the point that each pixel shows ("pixel").
        boost: beta. 1 starts flat in the light's direction, 30 overfits (method: relighting).
        falloff: whether the light's intensity is divided by the squared distance, in scene units.
        typical: E of a typical training light, in the data's units.
    """

    init_settings = ("output",)

    def __init__(
        self,
        hidden: int = 8,
        channels: int = 3,
        form: str = "additive",
        visibility: str = "primitive",
        boost: float = 3.0,
        falloff: bool = False,
        typical: float = 1.0,
    ) -> None:
        if not isinstance(hidden, int) or not 0 <= hidden <= 16:
            raise ValueError(f"{hidden!r} hidden units; expected 0..16")
        if not isinstance(channels, int) or channels < 1:
            raise ValueError(f"{channels!r} colour channels; expected at least 1")
        if form not in FORMS:
            raise ValueError(f"form {form!r}; expected {' or '.join(FORMS)}")
        if visibility not in VISIBILITY:
            raise ValueError(f"visibility {visibility!r}; expected {', '.join(VISIBILITY[:-1])} or {VISIBILITY[-1]}")
        if not 0 < boost <= 100:
            raise ValueError(f"boost {boost!r}; expected a number in (0, 100]")
        if not 0 < typical < math.inf:
            raise ValueError(f"typical light {typical!r}; expected a number above 0")
        self.typical = float(typical)
        self.hidden, self.channels, self.form = hidden, channels, form
        self.visibility, self.boost, self.falloff = visibility, float(boost), bool(falloff)

    def settings(self) -> dict[str, Any]:
        return {
            name: getattr(self, name)
            for name in ("hidden", "channels", "form", "visibility", "boost", "falloff", "typical")
        }

    def parameters(self) -> list[ParameterSpec]:
        H, C = self.hidden, self.channels
        outputs = (C, H) if self.form == "additive" else (1, H)
        return [
            ParameterSpec("c_dc", (C,), 1e-2, lambda c: c.colors.clamp_min(_DARKEST).float()),
            ParameterSpec("net_x", (H, 3), 1e-2, lambda c: c.uniform(H, 3, bound=1 / 9)),
            ParameterSpec("net_view", (H, 3), 1e-2, lambda c: c.uniform(H, 3, bound=1 / 3)),
            ParameterSpec("net_light", (H, 3), 1e-2, lambda c: c.uniform(H, 3, bound=1 / 3)),
            ParameterSpec("net_phase", (H,), 1e-2, lambda c: c.uniform(H, bound=math.pi / self.boost)),
            ParameterSpec("net_out", outputs, 2e-2, lambda c: c.uniform(*outputs, bound=_output(c))),
        ]

    def shade(
        self, geometry: Geometry, density: LoweredDensity, conditions: Conditions, settings: RenderSettings
    ) -> Shading | None:
        if self.visibility == "none":
            return None
        visible = light_visibility(geometry, density, conditions["light"], settings)
        return Shading(pixels=visible) if self.visibility == "pixel" else Shading(primitives=visible(geometry.means))

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> RayNet:
        means = geometry.means
        size = geometry.length_scale.detach()[:, None]
        view = unit(means - device.to_like(camera.position, means), size)
        to_light = device.to_like(conditions["light"], means) - means
        strength = device.to_like(conditions["light_intensity"], means).expand(self.channels) / self.typical
        factor = strength.expand(means.shape[0], -1)
        if self.falloff:
            factor = factor / to_light.square().sum(-1, keepdim=True).clamp_min(least_square(geometry))
        phase = (
            (params["net_view"] * view[:, None]).sum(-1)
            + (params["net_light"] * unit(to_light, size)[:, None]).sum(-1)
            + params["net_phase"]
        )
        if self.form == "additive":
            base, out = params["c_dc"], params["net_out"]
        else:
            albedo = params["c_dc"].clamp_min(0.0)
            base, out = albedo, albedo[:, :, None] * params["net_out"]
        return RayNet(self.boost * params["net_x"], self.boost * phase, out * factor[:, :, None], base * factor)

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        """x~' = x~ m/m' - (mu' - mu)/m': the children see what their parent saw."""
        r = (new.log_length_scale.double() - old.log_length_scale.double()).exp()
        shift = (new.means.double() - old.means.double()) / old.length_scale.double()[:, None]
        net_x = params["net_x"].double()
        phase = params["net_phase"].double() + (net_x * shift[:, None]).sum(-1)
        return {
            **params,
            "net_x": (net_x * r[:, None, None]).to(params["net_x"]),
            "net_phase": phase.to(params["net_phase"]),
        }

    def reductions(self) -> dict[str, tuple[int, ...]]:
        return {"hidden": smaller_neuron_counts(self.hidden)} if self.hidden else {}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[LightNetwork, dict[str, Tensor]]:
        return LightNetwork(**{**self.settings(), "hidden": value}), fewer_units(
            params, geometry, value, self.boost, self.form == "multiplicative"
        )

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Hidden units."""
        inputs = ("net_x", "net_view", "net_light", "net_phase")
        return tuple(
            PrunableUnit(f"unit {h}", {**dict.fromkeys(inputs, (h,)), "net_out": (slice(None), h)})
            for h in range(self.hidden)
        )

    def script(self) -> str:
        return read_script(__package__, "colour.js")

    def canonicalize(self, params: Params) -> dict[str, Tensor]:
        return canonicalize_cosines(params, ("net_x", "net_view", "net_light"), "net_phase", "net_out", self.boost)


_DARKEST = 1e-3
"""Initial colours start at least this far above zero: at zero and below, max(0, .) passes no gradient and black stays
black."""


def _output(ctx: InitContext) -> float:
    return ctx.number("output", 0.05)
