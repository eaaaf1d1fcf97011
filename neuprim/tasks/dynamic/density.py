"""A cosine density that changes in time: one frame's is a static one, so time costs nothing per pixel (method:
"Density").

What varies is chosen by name, several joined by "+":

    phase    b1 + xi W_t                                        equation 13 of the paper; K parameters
    offset   b2 + sum_j p_j cos(pi j xi) + q_j sin(pi j xi)     j = 1..4; 8 parameters
    window   (w2, b2) (1 - u^2)^2, u = (xi - c)/tau, |u| < 1    the primitive lives from c - tau to c + tau; 2
    parameters motion   mu + v (xi - c) + a (xi - c)^2                     c of the window, else 1/2; 6 parameters

xi is time over the sequence, 0..1. Primitives outside their window are left out of a frame before anything is computed.

A model joined from chunks of a sequence has seams between them, and for every primitive the chunk that it was fitted
in, a number that is not learned: what it lives of its own accord counts within its chunk alone, and is faded over at
the seams (:mod:`neuprim.tasks.dynamic.seams`).

Where several grids make the extinction (smoke and flames), each of ``components`` adds one parameter, share_NAME: the
primitive's share of that grid, as a logit.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.model.cosine_sums import canonicalize_cosines, prune_neurons
from neuprim.core.model.densities.cosine import (
    OMEGA0,
    CosineDensity,
    amplified,
    cosine_density,
    split_cosine,
    split_scale,
)
from neuprim.core.model.fields import Conditions, Cosine, DensityField, read_script
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import InitContext, ParameterSpec, Params
from neuprim.core.train.splitting import SPLIT_LONG, SPLIT_SHIFT
from neuprim.tasks.dynamic.seams import checked_seams, shares
from neuprim.tasks.dynamic.stilled import stilled

__all__ = ["PARTS", "TimeDensity", "time_of"]

PARTS = ("phase", "offset", "window", "motion")
"""What may vary in time."""

OFFSET_TERMS = 4
_MOTION = ("velocity", "acceleration")
_SHARE = "share_"


def time_of(conditions: Conditions) -> Tensor:
    """The frame's time xi, a 0-dim float64 tensor.

    Raises:
        KeyError: the frame has no condition "time".
    """
    if "time" not in conditions:
        raise KeyError("a dynamic model needs the condition 'time'")
    return conditions["time"].detach().double().reshape(())


class TimeDensity(DensityField):
    """f(x~, xi) of K cosine neurons whose ``time`` parts vary, see the module; 5K + 1 parameters and those of the
    parts.

    ``init`` of the model settings: as :class:`~neuprim.core.model.densities.cosine.CosineDensity`, and ``window``, the
    half width tau of a fresh window in units of the sequence, ``window_frames``, how many frames of a sequence it is at
    most, and ``rate``, the bound of U(-rate, rate) that W_t starts from.

    Args:
        seams: (from, to) of the times over which one chunk of the sequence hands over to the next, ascending; none: the
        model is of one piece. components: names of the source grids whose share of the extinction each primitive keeps.
    """

    init_settings = (*CosineDensity.init_settings, "window", "window_frames", "rate")

    def __init__(
        self,
        neurons: int = 8,
        time: str = "phase",
        divide_above: float = 0.0,
        omega0: float = OMEGA0,
        edge: int = 0,
        gain: bool = False,
        seams: Sequence[Sequence[float]] = (),
        components: Sequence[str] = (),
    ) -> None:
        parts = time.split("+") if isinstance(time, str) and time != "none" else []
        if not isinstance(time, str) or any(p not in PARTS for p in parts) or len(set(parts)) != len(parts):
            raise ValueError(f"{time!r}: expected none or some of {', '.join(PARTS)} joined by +")
        self.static, self.divide_above = CosineDensity(neurons, omega0, edge, gain), divide_above
        self.exact_split = self.static.exact_split
        self.time, self.parts = "+".join(p for p in PARTS if p in parts) or "none", frozenset(parts)
        self.seams = checked_seams(seams)
        if isinstance(components, str) or not all(isinstance(name, str) and name.isidentifier() for name in components):
            raise ValueError(f"components {components!r}; expected a list of names")
        self.named = tuple(components)

    def settings(self) -> dict[str, Any]:
        joined = {"seams": [list(seam) for seam in self.seams]} if self.seams else {}
        named = {"components": list(self.named)} if self.named else {}
        return {**self.static.settings(), "time": self.time, **joined, **named}

    @classmethod
    def every_parameter(cls) -> list[ParameterSpec]:
        return cls(
            time="+".join(PARTS), gain=True, seams=[(0.0, 1.0)], components=("density", "temperature")
        ).parameters()

    def parameters(self) -> list[ParameterSpec]:
        K = self.static.neurons
        specs = self.static.parameters()
        if "phase" in self.parts:
            specs.append(ParameterSpec("W_t", (K,), 3e-3, lambda c: c.uniform(K, bound=c.number("rate", 0.1))))
        if "offset" in self.parts:
            specs += [
                ParameterSpec(name, (OFFSET_TERMS,), 3e-3, _zeros(OFFSET_TERMS))
                for name in ("offset_cos", "offset_sin")
            ]
        if "window" in self.parts:
            specs.append(ParameterSpec("window_center", (1,), 3e-3, _initial_center))
            specs.append(ParameterSpec("log_window", (1,), 1e-2, _initial_log_window))
        if "motion" in self.parts:
            specs += [ParameterSpec(name, (3,), 1e-2, _zeros(3), lr_unit="extent") for name in _MOTION]
        if self.seams:
            specs.append(ParameterSpec("chunk", (1,), 0.0, _zeros(1)))
        specs += [ParameterSpec(_SHARE + name, (1,), 0.3, _zeros(1)) for name in self.named]
        return specs

    def components(self, params: Params) -> dict[str, Tensor]:
        return {name: params[_SHARE + name].sigmoid().reshape(-1) for name in self.named}

    def largest(self, params: Params, geometry: Geometry) -> Tensor:
        own = dict(params)
        if "offset" in self.parts:
            own["b2"] = params["b2"] + (params["offset_cos"].abs() + params["offset_sin"].abs()).sum(1, keepdim=True)
        return self.static.largest(own, geometry)

    # ------------------------------------------------------------ one frame

    def active_rows(self, params: Params, conditions: Conditions) -> Tensor | None:
        if "window" not in self.parts and not self.seams:
            return None
        xi, rows = time_of(conditions), None
        if "window" in self.parts:
            from neuprim.tasks.dynamic.frame_cpu import in_their_windows  # numba, loaded when first needed

            rows = in_their_windows(params["window_center"], params["log_window"], xi)
        if self.seams:
            counts = shares(params["chunk"], self.seams, xi)[:, 0] > 0
            rows = counts.nonzero()[:, 0] if rows is None else rows[counts[rows]]
        return rows

    def move(self, params: Params, geometry: Geometry, conditions: Conditions) -> Geometry:
        if "motion" not in self.parts:
            return geometry
        from neuprim.tasks.dynamic.frame_cpu import fused_move  # numba, loaded when first needed

        center = params["window_center"] if "window" in self.parts else torch.full_like(geometry.means[:, :1], 0.5)
        means = fused_move(geometry.means, params["velocity"], params["acceleration"], center, time_of(conditions))
        return Geometry(means, geometry.log_scales, geometry.quats)

    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> Cosine:
        xi = time_of(conditions)
        b1 = params["b1"]
        if "phase" in self.parts:
            b1 = _advance(b1, params["W_t"], xi, 2 * math.pi / self.static.omega0)
        own = dict(params)
        if "offset" in self.parts:
            angle = math.pi * xi * torch.arange(1, OFFSET_TERMS + 1, dtype=torch.float64, device=xi.device)
            b2 = params["b2"]
            own["b2"] = (
                b2
                + (
                    params["offset_cos"] @ device.to_like(angle.cos(), b2)
                    + params["offset_sin"] @ device.to_like(angle.sin(), b2)
                )[:, None]
            )
        w2, b2 = amplified(own["w2"], own["b2"], own.get("log_gain"))
        if "window" in self.parts:
            from neuprim.tasks.dynamic.frame_cpu import fused_window  # numba, loaded when first needed

            w2, b2 = fused_window(w2, b2, params["window_center"], params["log_window"], xi)
        if self.seams:
            share = shares(params["chunk"], self.seams, xi).to(b2)
            w2, b2 = w2 * share, b2 * share
        return Cosine(params["W1"], b1, w2, b2, self.static.omega0, self.static.edge)

    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        return cosine_density(
            self.lower(params, geometry, conditions), self.move(params, geometry, conditions), prim, x
        )

    # ------------------------------------------------------------ population

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        children = split_cosine(params, old, new, self.static.omega0, self.static.edge)
        if "offset" in self.parts:
            scale = split_scale(old, new, self.static.edge)
            for name in ("offset_cos", "offset_sin"):
                children[name] = params[name] * scale.to(params["b2"])[:, None]
        return children

    def canonicalize(self, params: Params) -> dict[str, Tensor]:
        if not self.static.neurons and "offset" not in self.parts:
            return self.static.canonicalize(params)
        return canonicalize_cosines(
            params, ("W1", "W_t") if "phase" in self.parts else ("W1",), "b1", "w2", self.static.omega0
        )

    def divide(self, params: Params, geometry: Geometry) -> tuple[Tensor, dict[str, Tensor], Geometry] | None:
        """Windows longer than ``divide_above`` are halved; the halves overlap, as windows fade at their ends.

        Time is one more axis: halves lie along it as the children of a split do along the longest axis of space.
        """
        if "window" not in self.parts or self.divide_above <= 0:
            return None
        tau = params["log_window"].double().exp()
        later = torch.cat([-SPLIT_SHIFT * tau, SPLIT_SHIFT * tau]).float()
        halves = {name: torch.cat([value, value]) for name, value in params.items()}
        halves["window_center"] = halves["window_center"] + later
        halves["log_window"] = halves["log_window"] + math.log(SPLIT_LONG)
        means = torch.cat([geometry.means, geometry.means])
        if "motion" in self.parts:
            velocity, acceleration = halves["velocity"], halves["acceleration"]
            means = means + (velocity + acceleration * later) * later
            halves["velocity"] = velocity + 2 * acceleration * later
        rows = Geometry(means, *(torch.cat([x, x]) for x in (geometry.log_scales, geometry.quats)))
        return tau[:, 0] > self.divide_above, halves, rows

    def from_gaussians(self, alphas: Tensor) -> tuple[Tensor, Tensor]:
        return self.static.from_gaussians(alphas)

    def reductions(self) -> dict[str, tuple[int, ...]]:
        """Neurons, and every part of time, which is either there or not."""
        return {**self.static.reductions(), **{part: (0,) for part in PARTS if part in self.parts}}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[TimeDensity, dict[str, Tensor]]:
        """Without a part of time: its mean over the sequence, see :mod:`neuprim.tasks.dynamic.stilled`."""
        if name == "neurons":
            field = TimeDensity(**{**self.settings(), "neurons": value})
            return field, prune_neurons(params, geometry, value, self.static.omega0)
        fewer = stilled(params, geometry, name, self.static.omega0)
        left = "+".join(part for part in PARTS if part in self.parts and part != name) or "none"
        field = TimeDensity(**{**self.settings(), "time": left})
        kept = {"means", *(spec.name for spec in field.parameters())}
        return field, {key: value for key, value in fewer.items() if key in kept}

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Neurons, and what changes in time but for windows, without which nothing would be left."""
        turning = ("W_t",) if "phase" in self.parts else ()
        found = [
            PrunableUnit(one.name, {**one.places, **dict.fromkeys(turning, one.places["b1"])})
            for one in self.static.prunable_units()
        ]
        if "offset" in self.parts:
            found.append(PrunableUnit("offset", {"offset_cos": (), "offset_sin": ()}))
        if "motion" in self.parts:
            found += [PrunableUnit(f"{name} {'xyz'[k]}", {name: (k,)}, name) for name in _MOTION for k in range(3)]
        return tuple(found)

    def script(self) -> str:
        return read_script(__package__, "density.js")

    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        scaled = self.static.scale_density(params, factor)
        for name in ("offset_cos", "offset_sin"):
            if name in params:
                scaled[name] = params[name] * factor[:, None]
        return scaled


def _advance(b1: Tensor, W_t: Tensor, xi: Tensor, turn: float) -> Tensor:
    """b1 + xi W_t less whole turns, 2 pi/omega0 each: exact to float32 however far outside 0..1 the time lies, as only
    the remainder matters."""
    phase = b1.double() + xi * W_t.double()
    return (phase - turn * torch.round(phase.detach() / turn)).to(b1)


def _zeros(width: int) -> Any:
    return lambda ctx: torch.zeros(ctx.count, width)


def _initial_center(ctx: InitContext) -> Tensor:
    """When the starting point was seen, else spread evenly at random over the sequence."""
    if "time" in ctx.conditions:
        return ctx.conditions["time"].float().reshape(-1, 1)
    return (ctx.uniform(1) + 1) / 2


def _initial_log_window(ctx: InitContext) -> Tensor:
    """A sequence that is longer shows more events, not longer ones, so that frames say how long a fresh primitive
    should live."""
    half = ctx.number("window", 0.2, 0)
    if ctx.settings.get("window_frames") is not None and "time" in ctx.steps:
        half = min(half, ctx.number("window_frames", 1.0, 0) * ctx.steps["time"])
    return torch.full((ctx.count, 1), math.log(half))
