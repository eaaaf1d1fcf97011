"""Colour fields under a point light: a network per primitive (equation 14 of the paper), or spherical harmonics.

    h = cos(beta (W_x x~ + W_d d + W_l l + b))
    additive         c = V E max(0, c_dc + W_out h)        equation 14: 9 -> H -> 3, 107 parameters at H = 8
    multiplicative   c = V E max(0, albedo (1 + w_out . h))    h does not change the hue: 91 parameters

h are the H hidden units. The W, b, c_dc and albedo are parameters of each primitive; beta is a constant factor. x~ is
the middle of the ray's chord through the ellipsoid, relative to the ellipsoid's centre, in units of the longest
semi-axis. d and l are unit vectors: from the camera to the centre, and from the centre to the light. E is the strength
of the light relative to a typical training light: the intensity, divided by the squared distance if the dataset's
falloff is "inverse_square". V is the visibility of the light from the primitive (:mod:`neuprim.core.render.light`), or
1. All terms but W_x x~ are constant over a primitive. For each frame, the field is therefore converted to
:class:`~neuprim.core.model.forms.RayNet`, which the renderer evaluates per pixel.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.compute import device
from neuprim.core.model.cosine import canonicalize_cosines, ellipsoid_cosine_mean, smaller_cosine_neuron_counts
from neuprim.core.model.edge import sinc
from neuprim.core.model.fields import (
    ColourField,
    Conditions,
    Constant,
    LoweredDensity,
    RayNet,
    Shading,
    read_script,
)
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import ParameterSpec, Params
from neuprim.core.model.sh import prunable_sh_coefficients, truncate_sh_bands
from neuprim.core.render.light import VISIBILITY, check_typical_light, light_factor, normalize_direction, shade_by_light
from neuprim.core.settings import RenderSettings

FORMS = ("additive", "multiplicative")

DARKEST = 1e-3  # smallest initial colour: at zero and below, max(0, .) passes no gradient and black stays black


def check_count(value: object, low: int, high: float, name: str) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        expected = f"at least {low}" if high == math.inf else f"{low}..{high}"
        raise ValueError(f"{name} {value!r}; expected {expected}")


class LightNetwork(ColourField):
    """Colour network of each primitive under a point light (see the module). With H = 0, the colour is c_dc V E.

    Args:
        hidden: H, number of hidden units, 0..16.
        form: one of :data:`FORMS`.
        visibility: one of :data:`VISIBILITY`; equation 14 as printed has "none".
        boost: beta. With 1 the initial colour hardly depends on the light's direction; 30 overfits.
        falloff: divide the light's intensity by the squared distance, in scene units.
        typical: strength of a typical training light in the data's units; E is relative to it.
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
        check_count(hidden, 0, 16, "hidden units")
        check_count(channels, 1, math.inf, "colour channels")
        check_typical_light(typical)
        if form not in FORMS:
            raise ValueError(f"form {form!r}; expected {' or '.join(FORMS)}")
        if visibility not in VISIBILITY:
            raise ValueError(f"visibility {visibility!r}; expected {', '.join(VISIBILITY[:-1])} or {VISIBILITY[-1]}")
        if not 0 < boost <= 100:
            raise ValueError(f"boost {boost!r}; expected a number in (0, 100]")
        self.typical = float(typical)
        self.hidden, self.channels, self.form = hidden, channels, form
        self.visibility, self.boost, self.falloff = visibility, float(boost), bool(falloff)

    def settings(self) -> dict[str, Any]:
        names = ("hidden", "channels", "form", "visibility", "boost", "falloff", "typical")
        return {name: getattr(self, name) for name in names}

    def parameters(self) -> list[ParameterSpec]:
        H, C = self.hidden, self.channels
        outputs = (C, H) if self.form == "additive" else (1, H)
        return [
            ParameterSpec("c_dc", (C,), 1e-2, lambda c: c.colors.clamp_min(DARKEST).float()),
            ParameterSpec("net_x", (H, 3), 1e-2, lambda c: c.uniform(H, 3, bound=1 / 9)),
            ParameterSpec("net_view", (H, 3), 1e-2, lambda c: c.uniform(H, 3, bound=1 / 3)),
            ParameterSpec("net_light", (H, 3), 1e-2, lambda c: c.uniform(H, 3, bound=1 / 3)),
            ParameterSpec("net_phase", (H,), 1e-2, lambda c: c.uniform(H, bound=math.pi / self.boost)),
            ParameterSpec("net_out", outputs, 2e-2, lambda c: c.uniform(*outputs, bound=c.number("output", 0.05))),
        ]

    def shade(
        self,
        geometry: Geometry,
        density: LoweredDensity,
        camera: AnyCamera,
        conditions: Conditions,
        settings: RenderSettings,
    ) -> Shading | None:
        return shade_by_light(self.visibility, geometry, density, conditions, settings)

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> RayNet:
        means = geometry.means
        size = geometry.detached_length_scale[:, None]
        view = normalize_direction(means - device.to_device_like(camera.position, means), size)
        to_light = device.to_device_like(conditions["light"], means) - means
        factor = light_factor(geometry, conditions, self.typical, self.falloff)
        phase = (
            (params["net_view"] * view[:, None]).sum(-1)
            + (params["net_light"] * normalize_direction(to_light, size)[:, None]).sum(-1)
            + params["net_phase"]
        )
        if self.form == "additive":
            base, out = params["c_dc"], params["net_out"]
        else:
            albedo = params["c_dc"].clamp_min(0.0)
            base, out = albedo, albedo[:, :, None] * params["net_out"]
        return RayNet(self.boost * params["net_x"], self.boost * phase, out * factor[:, :, None], base * factor)

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        """Return the parameters of the children of split primitives, such that children have their parents' colour.

        A point at x~ in a parent (centre mu, longest semi-axis m) is at x~' = x~ m/m' - (mu' - mu)/m' in a child
        (centre mu', longest semi-axis m').
        """
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
        return {"hidden": smaller_cosine_neuron_counts(self.hidden)} if self.hidden else {}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[LightNetwork, dict[str, Tensor]]:
        return LightNetwork(**{**self.settings(), "hidden": value}), prune_light_network_units(
            params, geometry, value, self.boost, self.form == "multiplicative"
        )

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        inputs = ("net_x", "net_view", "net_light", "net_phase")
        return tuple(
            PrunableUnit(f"unit {h}", {**dict.fromkeys(inputs, (h,)), "net_out": (slice(None), h)})
            for h in range(self.hidden)
        )

    def script(self) -> str:
        return read_script(__package__, "colour.js")

    def canonicalize(self, params: Params) -> dict[str, Tensor]:
        return canonicalize_cosines(params, ("net_x", "net_view", "net_light"), "net_phase", "net_out", self.boost)


# ---------------------------------------------------------------- pruning


def prune_light_network_units(
    params: Params, geometry: Geometry, keep: int, boost: float, multiplicative: bool
) -> dict[str, Tensor]:
    """Prune a :class:`LightNetwork` to the ``keep`` hidden units per primitive that affect the colour most.

    A removed unit is replaced by its mean over x~ in the ellipsoid and over all directions d and l. Symbols are those
    of the module; phi is beta b. The mean of cos(phi + beta (W_x x~ + W_d d + W_l l)) is cos(phi) B(|beta W_x A|)
    sinc(|beta W_d|) sinc(|beta W_l|). The columns of A are the semi-axes in the units of x~. B is the mean of a cosine
    over the unit ball. The variance follows from cos^2 = (1 + cos 2(.))/2. In the multiplicative form, the mean becomes
    part of the albedo.
    """
    net_x, view, light = (params[name].double() * boost for name in ("net_x", "net_view", "net_light"))
    phase, out = boost * params["net_phase"].double(), params["net_out"].double()
    semi_axes = (geometry.log_scales.double() - geometry.log_length_scale.double()[:, None]).exp()
    rotations = geometry.double().rotations
    x_rate = ((net_x @ rotations) * semi_axes[:, None, :]).norm(dim=-1)
    view_rate, light_rate = view.norm(dim=-1), light.norm(dim=-1)

    def mean_of(times: int) -> Tensor:
        over_ellipsoid = (times * phase).cos() * ellipsoid_cosine_mean(times * x_rate)
        return over_ellipsoid * sinc(times * view_rate) * sinc(times * light_rate)

    mean = mean_of(1)
    variance = (1 + mean_of(2)) / 2 - mean.square()
    order = (out.square().sum(1) * variance).argsort(dim=1, descending=True, stable=True)
    kept, gone = order[:, :keep].sort(dim=1).values, order[:, keep:]
    vectors = ("net_x", "net_view", "net_light")
    rows = kept[..., None].expand(-1, -1, 3)
    fewer = {name: params[name].gather(1, rows).contiguous() for name in vectors}
    fewer["net_phase"] = params["net_phase"].gather(1, kept).contiguous()
    outputs = out.shape[1]
    stays = params["net_out"].gather(2, kept[:, None].expand(-1, outputs, -1))
    left = (out * mean[:, None]).gather(2, gone[:, None].expand(-1, outputs, -1)).sum(2)
    base = params["c_dc"].double()
    if not multiplicative:
        return {**params, **fewer, "net_out": stays.contiguous(), "c_dc": (base + left).to(params["c_dc"])}
    # c_dc (1 + left + w . h) = c_dc (1 + left) (1 + w/(1 + left) . h); where little would be left, only the units go
    scale = torch.where(1 + left > 0.1, 1 + left, torch.ones_like(left))
    fewer["net_out"] = (stays.double() / scale[:, :, None]).to(params["net_out"]).contiguous()
    return {**params, **fewer, "c_dc": (base * scale).to(params["c_dc"])}


# ---------------------------------------------------------------- spherical harmonics of the light


class LightHarmonics(ColourField):
    """Baseline colour field c = E max(0, SH(l)), without view dependence and shadows.

    SH is a sum of spherical harmonics, l the direction to the light, and E the light's strength (see the module).
    """

    def __init__(self, degree: int = 5, channels: int = 3, falloff: bool = False, typical: float = 1.0) -> None:
        check_count(degree, 0, 8, "spherical-harmonics degree")
        check_typical_light(typical)
        self.degree, self.channels, self.falloff, self.typical = degree, channels, bool(falloff), float(typical)

    def settings(self) -> dict[str, Any]:
        return {name: getattr(self, name) for name in ("degree", "channels", "falloff", "typical")}

    def parameters(self) -> list[ParameterSpec]:
        C, rest = self.channels, (self.degree + 1) ** 2 - 1
        specs = [ParameterSpec("c_dc", (C,), 1e-2, lambda c: c.colors.clamp_min(DARKEST).float())]
        if rest:
            specs.append(ParameterSpec("light_sh", (rest, C), 1e-2, lambda c: torch.zeros(c.count, rest, C)))
        return specs

    def reductions(self) -> dict[str, tuple[int, ...]]:
        return {"degree": tuple(range(self.degree - 1, -1, -1))} if self.degree else {}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[LightHarmonics, dict[str, Tensor]]:
        return LightHarmonics(**{**self.settings(), "degree": value}), truncate_sh_bands(params, "light_sh", value)

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        return prunable_sh_coefficients(self.degree, self.channels, "light_sh")

    def script(self) -> str:
        return read_script(__package__, "harmonics.js")

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        color = params["c_dc"]
        if self.degree:
            to_light = device.to_device_like(conditions["light"], color) - geometry.means
            size = geometry.detached_length_scale[:, None]
            bands = real_light_harmonics(normalize_direction(to_light, size), self.degree)
            color = color + (bands[:, 1:, None] * params["light_sh"]).sum(1)
        return Constant(color.clamp_min(0.0) * light_factor(geometry, conditions, self.typical, self.falloff))


def real_light_harmonics(directions: Tensor, degree: int) -> Tensor:
    """Return (N, (degree + 1)^2) orthonormal real spherical harmonics at unit ``directions`` (N, 3).

    Bands are in order, m = -l..l. Recurrences give the associated Legendre functions, without Condon-Shortley phase:
    P_m^m = (2m - 1)!! sin^m, P_{m+1}^m = (2m + 1) z P_m^m, (l - m) P_l^m = (2l - 1) z P_{l-1}^m -
    (l + m - 1) P_{l-2}^m. Here, sin is the sine of the angle from the z axis. With the azimuth phi, sin^m cos(m phi)
    and sin^m sin(m phi) are polynomials in x and y.
    """
    x, y, z = directions.unbind(-1)
    cosine, sine = [torch.ones_like(x)], [torch.zeros_like(x)]
    for _ in range(degree):
        cosine.append(x * cosine[-1] - y * sine[-1])
        sine.append(x * sine[-1] + y * cosine[-2])
    legendre: dict[tuple[int, int], Tensor] = {}
    for m in range(degree + 1):
        legendre[m, m] = torch.full_like(x, math.prod(range(1, 2 * m, 2)))
        if m < degree:
            legendre[m + 1, m] = (2 * m + 1) * z * legendre[m, m]
        for l in range(m + 2, degree + 1):
            legendre[l, m] = ((2 * l - 1) * z * legendre[l - 1, m] - (l + m - 1) * legendre[l - 2, m]) / (l - m)
    columns = []
    for l in range(degree + 1):
        for m in range(-l, l + 1):
            a = abs(m)
            ratio = math.factorial(l - a) / math.factorial(l + a)
            scale = math.sqrt((2 * l + 1) / (4 * math.pi) * ratio) * (math.sqrt(2) if m else 1)
            columns.append(scale * legendre[l, a] * (cosine[a] if m >= 0 else sine[a]))
    return torch.stack(columns, -1)
