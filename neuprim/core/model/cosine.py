"""The density of the paper's neural primitive, one hidden layer of K cosines, extended by an edge and a gain.

    sigma(x) = g (1 - |y|^2)^p f(x~)/m inside the ellipsoid |y| < 1,   f(x~) = sum_k w2_k cos(omega0 (W1_k . x~ + b1_k))
    + b2,   g = exp(log_gain)

x~ = (x - mu)/m, with the centre mu and the longest semi-axis m; y is x in coordinates in which the ellipsoid is the
unit ball. p = 0 without gain is the paper's primitive. p = 2 with K = 0 is close to a Gaussian that is cut off at the
boundary.

**Canonical form.** A sum of w_k cos(rate (v_k . x + b_k)) has the same value for several sets of parameters. The
sum does not change when (v_k, b_k) changes sign, or when a whole turn (2 pi) is added to rate b_k. Nor does the sum
change when half a turn is added to rate b_k and w_k changes sign. So every w_k can be positive, and every rate b_k
between 0 and half a turn.

**Pruning** keeps the neurons whose term of the density varies most, and adds the means of the removed terms to b2. Over
an ellipsoid with semi-axes s and orientation R, x~ = R diag(s/m) y with y in the unit ball, a neuron's cosine has

    mean of cos(phi + r.y) = cos(phi) b(|r|),   b(r) = 3 (sin r - r cos r)/r^3,   phi = omega0 b1,
    r = omega0 diag(s/m) R^T W1

The variance of the cosine follows from the mean of cos^2 = (1 + cos 2(.))/2. If the phase changes with the time xi in
0..1, as phi + xi a, then b gets the factor sinc(a/2) and phi becomes phi + a/2. All means assume a hard edge.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Annotated, Any

import torch
from torch import Tensor

from neuprim.core.model.edge import EDGES, NORMS, edge_weight, sinc
from neuprim.core.model.fields import Conditions, Cosine, DensityField, read_script
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import InitContext, ParameterSpec, Params
from neuprim.core.model.tensors import field_number_fault
from neuprim.core.validation import Range

__all__ = ["CosineDensity", "cosine_density", "split_cosine"]

OMEGA0 = 30.0  # SIREN boost: multiplies the whole phase

GAIN_LIMIT = 20.0
"""log_gain is clamped to plus or minus this value; beyond the limit, log_gain gets no gradient. No scene needs a wider
range of densities, and products with the other weights stay far from the limits of float32."""


DENSITY_OPTIONS: dict[str, Any] = {"edge": EDGES, "gain": bool, "omega0": Annotated[float, Range(above=0)]}
"""Settings of CosineDensity under ``model.density``, for :func:`neuprim.core.validation.validate_choices`."""


DENSITY_TRADE: dict[str, tuple[int, ...]] = {"model.neurons": (0, 2, 4, 8), "model.density.edge": EDGES}
"""Settings of CosineDensity that trade quality for speed or size, for
:attr:`neuprim.core.task.TaskSpec.tunable_settings`."""


class CosineDensity(DensityField):
    """Density field of the neural primitive: K cosine neurons and an offset (docs/mathematics.md, "One primitive").

    The field lowers to :class:`~neuprim.core.model.fields.Cosine`. Each primitive has 5K + 1 parameters, plus one with
    ``gain``. With ``init.mode`` "opaque" (default), a primitive starts with the opacity of its starting point if it is
    known, else with central opacity ``init.alpha``. "paper" draws the offset as the paper does; half of all chords then
    have no gradient. Raises ValueError for invalid arguments.

    Args:
        neurons: number K of cosines, 0 to 16.
        omega0: factor on the phases, above 0.
        edge: exponent p of the factor (1 - |y|^2)^p: 0 for a hard edge, 1 or 2 for a soft edge.
        gain: whether primitives have a parameter log_gain, whose exponential multiplies the density.
    """

    init_settings = ("mode", "alpha")
    stage = 0

    def __init__(self, neurons: int = 8, omega0: float = OMEGA0, edge: int = 0, gain: bool = False) -> None:
        if not isinstance(neurons, int) or not 0 <= neurons <= 16:
            raise ValueError(f"{neurons!r} neurons; expected 0..16")
        if field_number_fault(omega0) is not None or omega0 <= 0:
            raise ValueError(f"omega0 {omega0!r}; expected a positive number")
        if type(edge) is not int or edge not in EDGES:
            raise ValueError(f"edge {edge!r}; expected 0, 1 or 2")
        if not isinstance(gain, bool):
            raise ValueError(f"gain {gain!r}; expected true or false")
        self.neurons, self.omega0, self.edge, self.gain = neurons, omega0, edge, gain
        self.exact_split = edge == 0

    def settings(self) -> dict[str, Any]:
        usual = {"omega0": OMEGA0, "edge": 0, "gain": False}
        return {
            "neurons": self.neurons,
            **{name: getattr(self, name) for name, value in usual.items() if getattr(self, name) != value},
        }

    @classmethod
    def every_parameter(cls) -> list[ParameterSpec]:
        return cls(gain=True).parameters()

    def parameters(self) -> list[ParameterSpec]:
        K = self.neurons
        third = 1.0 / 3.0
        amplitude = math.sqrt(6.0 / K) / self.omega0 if K else 0.0
        specs = [
            ParameterSpec("W1", (K, 3), 3e-3, lambda c: c.uniform(K, 3, bound=third)),
            ParameterSpec("b1", (K,), 3e-3, lambda c: c.uniform(K, bound=third)),
            ParameterSpec("w2", (K,), 1e-2, lambda c: c.uniform(K, bound=amplitude)),
            ParameterSpec("b2", (1,), 1e-2, lambda c: _initial_density_offset(c, amplitude, NORMS[self.edge])),
        ]
        if self.gain:
            specs.append(ParameterSpec("log_gain", (1,), 2e-1, lambda c: torch.zeros(c.count, 1)))
        return specs

    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> Cosine:
        w2, b2 = apply_density_gain(params["w2"], params["b2"], params.get("log_gain"))
        return Cosine(params["W1"], params["b1"], w2, b2, self.omega0, self.edge)

    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        return cosine_density(self.lower(params, geometry, conditions), geometry, prim, x)

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        return split_cosine(params, old, new, self.omega0, self.edge)

    def canonicalize(self, params: Params) -> dict[str, Tensor]:
        found = canonicalize_cosines(params, ("W1",), "b1", "w2", self.omega0)
        return canonicalize_gain(found, "b2", "log_gain", GAIN_LIMIT) if self.gain and not self.neurons else found

    def from_gaussians(self, alphas: Tensor) -> tuple[Tensor, Tensor]:
        support, depth = gaussian_support(self.edge, alphas)
        return support.to(alphas), -torch.expm1(-depth).to(alphas)

    def reductions(self) -> dict[str, tuple[int, ...]]:
        return {"neurons": smaller_cosine_neuron_counts(self.neurons)} if self.neurons else {}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[CosineDensity, dict[str, Tensor]]:
        return CosineDensity(value, self.omega0, self.edge, self.gain), prune_cosine_neurons(
            params, geometry, value, self.omega0
        )

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Return one unit per neuron: its frequencies, phase and amplitude."""
        return tuple(PrunableUnit(f"neuron {k}", {"W1": (k,), "b1": (k,), "w2": (k,)}) for k in range(self.neurons))

    def script(self) -> str:
        return read_script(__package__, "cosine.js")

    def largest(self, params: Params, geometry: Geometry) -> Tensor:
        w2, b2 = apply_density_gain(params["w2"], params["b2"], params.get("log_gain"))
        return (b2.reshape(-1) + w2.abs().sum(1)).clamp_min(0) / geometry.length_scale

    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        return {**params, "w2": params["w2"] * factor[:, None], "b2": params["b2"] * factor[:, None]}


def apply_density_gain(w2: Tensor, b2: Tensor, log_gain: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return amplitudes ``w2`` (N, K) and offsets ``b2`` (N, 1) multiplied by exp(``log_gain``), (N, 1) or (N,).

    ``log_gain`` is clamped to plus or minus :data:`GAIN_LIMIT`. With None, ``w2`` and ``b2`` are returned unchanged.
    """
    if log_gain is None:
        return w2, b2
    from neuprim.core.model.rows import fused_cosine_gain  # numba, loaded when first needed

    return fused_cosine_gain(w2, b2.reshape(-1, 1), log_gain.reshape(-1, 1), GAIN_LIMIT)


_FAINT, _SOLID = 0.02, 0.98
"""Range to which the opacities of starting points are clamped: beyond, a primitive passes little light or gradient."""


def _initial_density_offset(ctx: InitContext, amplitude: float, norm: float) -> Tensor:
    """Return the (N, 1) initial offsets b2, as the settings ``init.mode`` and ``init.alpha`` choose them.

    ``norm`` is N_p, the integral of the edge's weight (:data:`~neuprim.core.model.edge.NORMS`). ``amplitude`` is the
    largest initial offset in the mode "paper".
    """
    mode, alpha = ctx.choice("mode", "opaque", "paper"), ctx.number("alpha", 0.8, 0, 1)
    opaque = -math.log1p(-alpha) / norm  # a central chord of a sphere has optical depth N_p b2
    if mode == "paper" and amplitude:
        return ctx.uniform(1, bound=amplitude)
    if ctx.alphas is not None:
        depth = -torch.log1p(-ctx.alphas.float().clamp(_FAINT, _SOLID))
        return (depth / ctx.thickness.float())[:, None] / norm
    return torch.full((ctx.count, 1), opaque)


def cosine_density(form: Cosine, geometry: Geometry, prim: Tensor, x: Tensor) -> Tensor:
    """Return sigma (M,), 1/scene unit, not clamped at 0, of primitives ``prim`` (M,) at points ``x`` (M, 3).

    A hard edge is not applied: points must lie inside their primitives.
    """
    m = geometry.length_scale[prim]
    local = (x - geometry.means[prim]) / m[:, None]
    phase = form.omega0 * ((form.W1[prim] * local[:, None, :]).sum(-1) + form.b1[prim])
    sigma = ((form.w2[prim] * phase.cos()).sum(-1) + form.b2[prim].reshape(-1)) / m
    if form.edge == 0:
        return sigma
    whitened = (geometry.rotations[prim].transpose(1, 2) @ local[:, :, None])[..., 0] * (
        m[:, None] / geometry.scales[prim]
    )
    return sigma * edge_weight(whitened.square().sum(-1), form.edge)


def split_density_scale(old: Geometry, new: Geometry, edge: int = 0) -> Tensor:
    """Return the float64 factors c, one per child, by which :func:`split_cosine` multiplies w2 and b2.

    ``old`` and ``new`` are the ellipsoids of parents and children, one row per child.
    """
    r = (new.log_length_scale.double() - old.log_length_scale.double()).exp()
    if edge == 0:
        return r
    return 0.5 * r * (old.log_scales.double().sum(-1) - new.log_scales.double().sum(-1)).exp()


def split_cosine(
    params: Params, old: Geometry, new: Geometry, omega0: float = OMEGA0, edge: int = 0
) -> dict[str, Tensor]:
    """Return the parameters of the children of split primitives. A child continues the function f of its parent.

    W1' = r W1, b1' = b1 + W1 (mu'-mu)/m and (w2, b2)' = c (w2, b2), with r = m'/m. Primes mark the child, mu is the
    centre, m the longest semi-axis. With a hard edge, c = r, and sigma does not change inside a child. With a soft
    edge, the child's own edge makes sigma fade inside the child. Then c = r V/(2 V'), with V the product of the
    semi-axes: the two children together have their parent's integral of (1 - |y|^2)^p/m. All steps are in float64, so
    that f changes only by the final rounding.
    """
    r, c = split_density_scale(old, new), split_density_scale(old, new, edge)
    shift = (new.means.double() - old.means.double()) / old.length_scale.double()[:, None]
    W1, b1 = params["W1"].double(), params["b1"].double()
    b1 = b1 + (W1 * shift[:, None, :]).sum(-1)
    turns = 2 * math.pi / omega0
    b1 = b1 - turns * torch.round(b1 / turns)  # a phase is only known modulo one turn; keep it small for float32
    return {
        **params,
        "W1": (W1 * r[:, None, None]).to(params["W1"]),
        "b1": b1.to(params["b1"]),
        "w2": (params["w2"].double() * c[:, None]).to(params["w2"]),
        "b2": (params["b2"].double() * c[:, None]).to(params["b2"]),
    }


_LOGITS = torch.linspace(-6, 6, 25, dtype=torch.float64)
"""Logits of the opacities in the table of :func:`_gaussian_support_table`. Other opacities use the nearest entry."""
_NODES, _FAR = 160, 5.0  # number of rings of the footprint, and its radius in standard deviations
_WIDTHS = (1.45, 4.0)  # search interval of c
_GOLDEN = (5**0.5 - 1) / 2


def gaussian_support(edge: int, alphas: Tensor, volume: bool = False) -> tuple[Tensor, Tensor]:
    """Return size c (N,) and central optical depth tau (N,) of primitives that replace Gaussians; float64.

    c is the distance from centre to edge in standard deviations; ``alphas`` are the (N,) opacities of the Gaussians,
    0..1. By default, the opacity of a Gaussian falls off as a Gaussian in the image. With ``volume``, the Gaussians are
    densities in space, so their optical depth falls off as a Gaussian instead.
    """
    table = _gaussian_support_table(edge, volume)
    alphas = alphas.double().clamp(1e-9, 1 - 1e-9)
    where = (torch.logit(alphas).clamp(float(_LOGITS[0]), float(_LOGITS[-1])) - _LOGITS[0]) / (_LOGITS[1] - _LOGITS[0])
    row = where.floor().long().clamp(0, len(_LOGITS) - 2)
    part = (where - row)[:, None]
    found = table[row] * (1 - part) + table[row + 1] * part
    return found[:, 0], -torch.log1p(-alphas) * found[:, 1].exp()


@lru_cache
def _gaussian_support_table(edge: int, volume: bool) -> Tensor:
    """Return an (O, 2) table of the primitives whose images are closest to Gaussians, for O opacities o.

    Column 0 is the size c in standard deviations, found by golden-section search. Column 1 is log(tau / -log(1 - o)),
    tau the central optical depth.
    """
    r = (torch.arange(_NODES, dtype=torch.float64) + 0.5) / _NODES * _FAR
    opacity = torch.sigmoid(_LOGITS)[:, None]
    bell = (-r * r / 2).exp()
    target = -torch.expm1(torch.log1p(-opacity) * bell) if volume else opacity * bell

    def best(c: Tensor) -> tuple[Tensor, Tensor]:
        """Return the (O,) squared image errors of primitives of the sizes ``c`` (O,), and their (O,) log tau.

        The central optical depth tau is chosen so that primitive and Gaussian have equal integrals over the image.
        """
        shape = (1 - (r / c[:, None]).square()).clamp_min(0) ** (edge + 0.5)
        low, high = torch.full_like(c, -12.0), torch.full_like(c, 6.0)
        for _ in range(40):
            middle = (low + high) / 2
            less = ((-torch.expm1(-middle.exp()[:, None] * shape) - target) * r).sum(1) < 0
            low, high = torch.where(less, middle, low), torch.where(less, high, middle)
        error = (-torch.expm1(-high.exp()[:, None] * shape) - target).square()
        return (error * r).sum(1), high

    low, high = (torch.full_like(_LOGITS, width) for width in _WIDTHS)
    for _ in range(22):
        left, right = high - _GOLDEN * (high - low), low + _GOLDEN * (high - low)
        lower = best(left)[0] < best(right)[0]
        low, high = torch.where(lower, low, left), torch.where(lower, right, high)
    c = (low + high) / 2
    return torch.stack([c, best(c)[1] - (-torch.log1p(-opacity[:, 0])).log()], 1)


_SLACK = 1e-6  # in turns: phases this close to an end by rounding stay, so that a second pass changes no bit


def canonicalize_cosines(
    params: Params, inputs: tuple[str, ...], phase: str, weights: str, rate: float
) -> dict[str, Tensor]:
    """Return equivalent parameters of sums of w_k cos(rate (v_k . x + b_k)), with w_k >= 0 and b_k from 0 to pi/rate.

    In a network with several outputs, w_k >= 0 holds for the first output only.

    Args:
        inputs: names of the frequency parameters, which multiply the inputs of the cosines, (N, K) or (N, K, ...).
        phase, weights: names of the phases b_k, (N, K), and of the weights w_k, (N, K) or (N, outputs, K).
        rate: factor on the whole argument of the cosines.
    """
    turn = 2 * math.pi / rate
    b, w = params[phase].detach().double(), params[weights].detach()
    negative = (w if w.dim() == 2 else w[:, 0]) < 0
    b = torch.where(negative, b + turn / 2, b)
    b = torch.where((b / turn).abs() <= 0.5 + _SLACK, b, b - turn * torch.round(b / turn))
    backward = b < 0
    found = {
        **params,
        phase: b.abs().to(params[phase]),
        weights: torch.where(negative if w.dim() == 2 else negative[:, None], -w, w),
    }
    for name in inputs:
        value = params[name].detach()
        found[name] = torch.where(backward.reshape(*backward.shape, *[1] * (value.dim() - 2)), -value, value)
    return found


def canonicalize_gain(params: Params, strength: str, log_gain: str, limit: float) -> dict[str, Tensor]:
    """Move the magnitude of b in the products b exp(g) into g, so that b is -1, 0 or 1.

    ``strength`` and ``log_gain`` name the parameters b and g. Where |g| would exceed ``limit``, b and g stay unchanged.
    """
    b, g = params[strength].detach(), params[log_gain].detach()
    joined = g.double().clamp(-limit, limit) + b.double().abs().log()
    fits = (b != 0) & (joined.abs() <= limit)
    return {**params, strength: torch.where(fits, b.sign(), b), log_gain: torch.where(fits, joined.to(g), g)}


def smaller_cosine_neuron_counts(neurons: int) -> tuple[int, ...]:
    """Return the smaller numbers of neurons that are offered: 3/4, 1/2 and 1/4 of ``neurons``, rounded down, and 0."""
    return tuple(sorted({neurons * part // 4 for part in range(4)} - {neurons}, reverse=True))


def prune_cosine_neurons(params: Params, geometry: Geometry, keep: int, omega0: float) -> dict[str, Tensor]:
    """Return the parameters with fewer neurons: each primitive keeps the ``keep`` neurons whose terms vary most.

    A neuron's term is its part of the density inside the primitive. The means of the removed terms are added to the
    offset b2.
    """
    W1, phase, w2 = params["W1"].double(), omega0 * params["b1"].double(), params["w2"].double()
    semi_axes = (geometry.log_scales.double() - geometry.log_length_scale.double()[:, None]).exp()
    rotations = geometry.double().rotations
    rate = omega0 * ((W1 @ rotations) * semi_axes[:, None, :]).norm(dim=-1)
    advance = omega0 * params["W_t"].double() if "W_t" in params else torch.zeros_like(phase)
    phase = phase + advance / 2
    mean = phase.cos() * ellipsoid_cosine_mean(rate) * sinc(advance / 2)
    square = (1 + (2 * phase).cos() * ellipsoid_cosine_mean(2 * rate) * sinc(advance)) / 2
    order = (w2.square() * (square - mean.square())).argsort(dim=1, descending=True, stable=True)
    kept, gone = order[:, :keep].sort(dim=1).values, order[:, keep:]
    fewer = {name: value.gather(1, kept).contiguous() for name, value in params.items() if name in ("b1", "w2", "W_t")}
    fewer["W1"] = params["W1"].gather(1, kept[..., None].expand(-1, -1, 3)).contiguous()
    fewer["b2"] = (params["b2"].double() + (w2 * mean).gather(1, gone).sum(1, keepdim=True)).to(params["b2"])
    return {**params, **fewer}


def ellipsoid_cosine_mean(r: Tensor) -> Tensor:
    """Return the mean of cos(v.y) over points y in the unit ball, for vectors v of the length ``r`` >= 0."""
    small = r < 1e-2
    safe = torch.where(small, torch.ones_like(r), r)
    return torch.where(small, 1 - r * r / 10, 3 * (safe.sin() - safe * safe.cos()) / safe**3)
