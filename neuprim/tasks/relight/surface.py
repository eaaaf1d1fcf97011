"""Colour field of a surface under a point light: normal, albedo, highlights and indirect light.

    c = E [ V (max(0, a) s(n . l) + gate(n . l) sum_j max(0, k_j) exp(g_j (n . h - 1))) + max(0, b_0 + B l) ]

n, l and v are unit vectors: the normal, and the directions from the primitive's centre to the light and to the camera.
h = unit(l + v) is the half vector. s(x) = (x + sqrt(x^2 + 0.01))/2 is a smooth max(0, x), gate(x) = 1/(1 + exp(-20 x)).
a is the albedo. The sum over j is over highlight lobes with colours k_j and sharpnesses g_j: spherical Gaussians in the
half vector (Wang et al. 2009, All-frequency rendering of dynamic, spatially-varying reflectance). b_0 + B l is indirect
light, with one b_0 and one row of B per channel. V is the visibility of the light, 0..1. E is the light's strength
relative to a typical training light (:mod:`neuprim.tasks.relight.colour`). The colour is constant over a primitive.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.cameras.pinhole import AnyCamera
from neuprim.core.compute import device
from neuprim.core.errors import FormError
from neuprim.core.model.colour_constants import LOG_LIMIT, MOST_LOBES
from neuprim.core.model.fields import ColourField, Conditions, Constant, LoweredDensity, Shading, read_script
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import InitContext, ParameterSpec, Params
from neuprim.core.model.tensors import Sizes, primitive_tensors_fault
from neuprim.core.render.light import check_typical_light, light_factor, shade_by_light
from neuprim.core.settings import RenderSettings
from neuprim.tasks.relight.colour import check_count
from neuprim.tasks.relight.surface_constants import GATE, SHORTEST, WRAP

INDIRECT = (0, 1, 4)
"""Possible numbers of coefficients of indirect light per channel: none, b_0, or b_0 and B (see the module)."""

_GLOSS = 20.0  # initial sharpness of the first lobe; each further one is six times as sharp
_HIGHLIGHT, _INDIRECT = 0.1, 0.02
_NEIGHBOURS = 12


def surface_colors(
    means: Tensor,
    sizes: Tensor,
    normal: Tensor,
    albedo: Tensor,
    highlight: Tensor,
    log_gloss: Tensor,
    indirect: Tensor,
    light: Tensor,
    eye: Tensor,
) -> Tensor:
    """Return (N, 2, C) linear colours of N primitives under a point light: [:, 0] is direct, [:, 1] indirect light.

    The colours follow the module's equation for E = V = 1. Float32 tensors are computed by fused kernels. The result is
    differentiable with respect to all inputs but ``sizes``.

    Args:
        means: (N, 3) centres, scene units.
        sizes: (N,) sizes of the primitives, scene units.
        normal: (N, 3) normals, of any length.
        albedo: (N, C).
        highlight: (N, L, C) colours of the highlight lobes, L from 0 to 8.
        log_gloss: (N, L) natural logarithms of the lobes' sharpness g.
        indirect: (N, n, C) coefficients of indirect light: b_0, then the columns of B for x, y and z. n is one of
            :data:`INDIRECT`.
        light, eye: (3,) positions, scene units.

    Raises:
        FormError: a tensor has a wrong shape.
    """
    sizes_by_name: Sizes = {}
    fault = primitive_tensors_fault(
        [
            ("means", means, (("N", 3),)),
            ("sizes", sizes, (("N",),)),
            ("normal", normal, (("N", 3),)),
            ("albedo", albedo, (("N", "C"),)),
            ("highlight", highlight, (("N", "L", "C"),)),
            ("log_gloss", log_gloss, (("N", "L"),)),
            ("indirect", indirect, (("N", "B", "C"),)),
            ("light", light, ((3,),)),
            ("eye", eye, ((3,),)),
        ],
        sizes_by_name,
    )
    if fault is None and highlight.shape[1] > MOST_LOBES:
        fault = f"highlight has {highlight.shape[1]} lobes; expected at most {MOST_LOBES}"
    if fault is None and indirect.shape[1] not in INDIRECT:
        fault = f"indirect has {indirect.shape[1]} numbers a channel; expected 0, 1 or 4"
    if fault is not None:
        raise FormError(f"surface_colors: {fault}")
    tensors = (means, sizes, normal, albedo, highlight, log_gloss, indirect)
    if all(tensor.dtype == torch.float32 for tensor in tensors):
        if device.on_numba(*tensors):
            from neuprim.tasks.relight import surface_cpu  # numba, loaded when first needed

            return surface_cpu.fused_surface_colors(*tensors, light, eye)
        if highlight.shape[1] and indirect.shape[1] and device.on_warp(*tensors):
            from neuprim.tasks.relight import surface_warp

            return surface_warp.fused_surface_colors(*tensors, light, eye)
    centers, shortest = means.double(), SHORTEST * sizes.double()[:, None]
    n = _unit(normal.double(), SHORTEST)
    l, v = (_unit(device.to_device_like(place, centers) - centers, shortest) for place in (light, eye))
    cosine = (n * l).sum(-1, keepdim=True)
    near = ((n * _unit(l + v, SHORTEST)).sum(-1, keepdim=True) - 1).clamp_max(0)
    diffuse = 0.5 * (cosine + (cosine.square() + WRAP).sqrt())
    gloss = log_gloss.double().clamp(-LOG_LIMIT, LOG_LIMIT).exp()
    weight = torch.sigmoid(GATE * cosine) * (gloss * near).exp()
    direct = albedo.double().clamp_min(0) * diffuse + (weight[..., None] * highlight.double().clamp_min(0)).sum(1)
    b = indirect.double()
    around = b[:, :1].sum(1) + (l[:, : b[:, 1:].shape[1], None] * b[:, 1:]).sum(1)
    return torch.stack([direct, around.clamp_min(0)], 1).to(albedo.dtype)


def _unit(vector: Tensor, shortest: Tensor | float) -> Tensor:
    return vector / vector.norm(dim=-1, keepdim=True).clamp_min(shortest)


def initial_normals(context: InitContext) -> Tensor:
    """Estimate (N, 3) float32 unit normals of starting points.

    A normal is the direction of least variance of the point's neighbours, oriented away from the mean of all points.
    """
    points = context.means.double()
    away = points - points.mean(0)
    count = min(_NEIGHBOURS, len(points))
    near = torch.from_numpy(cKDTree(points.numpy()).query(points.numpy(), k=count)[1]).reshape(-1, count)
    offsets = points[near] - points[near].mean(1, keepdim=True)
    normals = torch.linalg.eigh(offsets.transpose(1, 2) @ offsets).eigenvectors[:, :, 0]
    inward = (normals * away).sum(-1, keepdim=True) < 0
    return torch.where(inward, -normals, normals).float()


class SurfaceColour(ColourField):
    """Colour field of surface primitives under a point light (see the module).

    A primitive has 6 + 4 L + 3 n parameters for three channels.

    Args:
        lobes: L, number of highlight lobes, 0..8.
        indirect: n, coefficients of indirect light per channel, one of :data:`INDIRECT`.
        visibility: "none", or "primitive": the visibility of the light is computed once per primitive.
        falloff, typical: as in :class:`~neuprim.tasks.relight.colour.LightNetwork`.
    """

    def __init__(
        self,
        lobes: int = 1,
        indirect: int = 4,
        channels: int = 3,
        visibility: str = "primitive",
        falloff: bool = False,
        typical: float = 1.0,
    ) -> None:
        check_count(lobes, 0, MOST_LOBES, "lobes")
        check_count(channels, 1, math.inf, "colour channels")
        check_typical_light(typical)
        if isinstance(indirect, bool) or indirect not in INDIRECT:
            raise ValueError(f"indirect {indirect!r}; expected 0, 1 or 4")
        if visibility not in ("none", "primitive"):
            raise ValueError(f"visibility {visibility!r}; expected none or primitive, as form=surface")
        self.lobes, self.indirect, self.channels = lobes, indirect, channels
        self.visibility, self.falloff, self.typical = visibility, bool(falloff), float(typical)

    def settings(self) -> dict[str, Any]:
        names = ("lobes", "indirect", "channels", "visibility", "falloff", "typical")
        return {name: getattr(self, name) for name in names}

    def parameters(self) -> list[ParameterSpec]:
        L, B, C = self.lobes, self.indirect, self.channels
        specs = [
            ParameterSpec("c_dc", (C,), 1e-2, lambda c: c.colors.clamp_min(0).float(), low=0.0),
            ParameterSpec("normal", (3,), 1e-2, initial_normals),
        ]
        if L:
            sharpness = torch.tensor([math.log(_GLOSS) + j * math.log(6.0) for j in range(L)])
            specs += [
                ParameterSpec("highlight", (L, C), 1e-2, lambda c: torch.full((c.count, L, C), _HIGHLIGHT), low=0.0),
                ParameterSpec("log_gloss", (L,), 3e-2, lambda c: sharpness.expand(c.count, L).clone()),
            ]
        if B:
            start = torch.zeros(B, C)
            start[0] = _INDIRECT
            specs.append(ParameterSpec("indirect", (B, C), 3e-3, lambda c: start.expand(c.count, B, C).clone()))
        return specs

    def shade(
        self,
        geometry: Geometry,
        density: LoweredDensity,
        camera: AnyCamera,
        conditions: Conditions,
        settings: RenderSettings,
    ) -> Shading | None:
        return shade_by_light(self.visibility, geometry, density, conditions, settings)

    def lower(self, params: Params, geometry: Geometry, camera: AnyCamera, conditions: Conditions) -> Constant:
        means, albedo = geometry.means, params["c_dc"]
        none = albedo.new_zeros(len(albedo), 0, self.channels)
        parts = surface_colors(
            means, geometry.detached_length_scale, params["normal"], albedo,
            params.get("highlight", none), params.get("log_gloss", none[..., 0]), params.get("indirect", none),
            conditions["light"], camera.position,
        )  # fmt: skip
        direct, indirect = (parts * light_factor(geometry, conditions, self.typical, self.falloff)[:, None]).unbind(1)
        return Constant(direct, indirect if self.indirect else None)

    def reductions(self) -> dict[str, tuple[int, ...]]:
        found = {"lobes": tuple(range(self.lobes - 1, -1, -1))} if self.lobes else {}
        return found | ({"indirect": tuple(b for b in INDIRECT[::-1] if b < self.indirect)} if self.indirect else {})

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[SurfaceColour, dict[str, Tensor]]:
        """Return a colour field with fewer coefficients of indirect light or fewer lobes, and its parameters.

        The lobes with the largest product of colour and integral over the sphere remain.
        """
        field, found = SurfaceColour(**{**self.settings(), name: value}), dict(params)
        if name == "indirect":
            kept = found.pop("indirect")[:, :value].contiguous()
            return field, found | ({"indirect": kept} if value else {})
        highlight, log_gloss = found.pop("highlight"), found.pop("log_gloss")
        if value:
            g = log_gloss.double().clamp(-LOG_LIMIT, LOG_LIMIT).exp()
            size = highlight.double().clamp_min(0).sum(-1) * -torch.expm1(-2 * g) / g
            kept = size.argsort(dim=1, descending=True, stable=True)[:, :value].sort(dim=1).values
            rows = kept[..., None].expand(-1, -1, self.channels)
            found["highlight"] = highlight.gather(1, rows).contiguous()
            found["log_gloss"] = log_gloss.gather(1, kept).contiguous()
        return field, found

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Return prunable units (parameters zeroed together): one per lobe, one for indirect light's direction part."""
        found = [PrunableUnit(f"lobe {j}", {"highlight": (j,), "log_gloss": (j,)}) for j in range(self.lobes)]
        if self.indirect > 1:
            found.append(PrunableUnit("direction of indirect light", {"indirect": (slice(1, None),)}))
        return tuple(found)

    def script(self) -> str:
        return read_script(__package__, "surface.js")
