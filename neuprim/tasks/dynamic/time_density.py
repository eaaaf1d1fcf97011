"""Density field whose cosine neurons change in time.

At a fixed time, the density is that of :mod:`neuprim.core.model.cosine`: a network of K neurons with phases b1, output
weights w2 and offset b2, in an ellipsoid with centre mu. xi is the time, 0..1 over the sequence. The setting ``time``
names the time-dependent parts, joined by "+". W_t, p_j, q_j, c, tau, v and a are parameters of each primitive:

    phase    b1 + xi W_t                                        equation 13 of the paper; K parameters
    offset   b2 + sum_j p_j cos(pi j xi) + q_j sin(pi j xi)     j = 1..4; 8 parameters
    window   (w2, b2) (1 - u^2)^2, u = (xi - c)/tau, |u| < 1    active from c - tau to c + tau; 2 parameters
    motion   mu + v (xi - c) + a (xi - c)^2                     c of the window, else 1/2; 6 parameters

Primitives whose window does not contain xi are removed from a frame before anything else is computed.

A model joined from chunks of a sequence stores the chunk number of every primitive. Neighbouring chunks overlap in
time. During an overlap, the earlier chunk's weight falls linearly from 1 to 0, and the later one's rises from 0 to 1.

If the extinction comes from several grids (smoke and flames), each name in ``components`` adds one parameter,
share_NAME: the fraction of the primitive's extinction that belongs to that grid, as a logit. Each name in ``channels``
adds one parameter, channel_NAME: the value of another grid, such as the temperature or the velocity, divided by its
largest absolute value.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.data.dataset import ChannelRange
from neuprim.core.model.cosine import (
    OMEGA0,
    CosineDensity,
    apply_density_gain,
    canonicalize_cosines,
    cosine_density,
    prune_cosine_neurons,
    split_cosine,
    split_density_scale,
)
from neuprim.core.model.fields import CHANNEL, Conditions, Cosine, DensityField, read_script
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.prunable import PrunableUnit
from neuprim.core.model.schema import InitContext, ParameterSpec, Params
from neuprim.tasks.dynamic.time_kernels import apply_time_window, move_means, rows_in_time_window

TIME_PARTS = ("phase", "offset", "window", "motion")
"""Parts of the density that can vary in time."""

OFFSET_TERMS = 4
_OFFSETS, _MOTION = ("offset_cos", "offset_sin"), ("velocity", "acceleration")
_SHARE = "share_"

ChunkOverlaps = tuple[tuple[float, float], ...]
"""(from, to) times of the overlaps of successive chunks (separately trained parts of a sequence), ascending. Chunk k
ends with overlap k."""


def get_frame_time(conditions: Conditions) -> Tensor:
    """Return the condition "time" of a frame, 0-dim float64; raises KeyError if it is missing."""
    if "time" not in conditions:
        raise KeyError("a dynamic model needs the condition 'time'")
    return conditions["time"].detach().double().reshape(())


def validate_time_chunk_overlaps(seams: Sequence[Sequence[float]]) -> ChunkOverlaps:
    """Convert ``seams``, (from, to) times of chunk overlaps, to tuples; raise ValueError unless all times ascend."""
    try:
        overlaps = tuple((float(begin), float(end)) for begin, end in seams)
    except (TypeError, ValueError):
        raise ValueError(f"seams {seams!r}; expected pairs of times") from None
    flat = list(itertools.chain.from_iterable(overlaps))
    if not all(map(math.isfinite, flat)) or flat != sorted(flat) or any(begin == end for begin, end in overlaps):
        raise ValueError(f"seams {seams!r}; expected pairs of ascending times, one after the other")
    return overlaps


def time_chunk_weights(chunk: Tensor, overlaps: ChunkOverlaps, xi: Tensor) -> Tensor:
    """Return the weight 0..1 of each primitive at time ``xi``; float64, shape of ``chunk``.

    The weight is 1 during the primitive's time chunk, 0 outside, and changes linearly during overlaps of chunks.

    Args:
        chunk: chunk number of each primitive, 0 to len(overlaps), any dtype. Numbers are rounded, because compression
            may change them slightly.
    """
    numbers = chunk.detach().double().round()
    weights = torch.ones_like(numbers)
    for number, (begin, end) in enumerate(overlaps):
        progress = ((xi.to(numbers) - begin) / (end - begin)).clamp(0.0, 1.0)
        weights = weights * torch.where(numbers > number, progress, 1.0 - progress)
    return weights


class TimeDensity(DensityField):
    """Density field of K cosine neurons; ``time`` names the parts that change in time (see the module).

    A primitive has 5K + 1 parameters plus the parameters of the parts. The setting ``model.init`` has the keys of
    :class:`~neuprim.core.model.cosine.CosineDensity`, and

    * ``window``: initial half width tau of windows, as a fraction of the sequence;
    * ``window_frames``: upper limit of the initial tau, in frames;
    * ``rate``: W_t of the part "phase" is initialised uniformly from -rate..rate.

    Args:
        seams: overlaps in time of the chunks from which a model was joined; empty for other models.
        components: names of the source grids whose share of the extinction each primitive stores.
        channels: name of each channel, and the values of its :class:`ChannelRange`.
    """

    init_settings = (*CosineDensity.init_settings, "window", "window_frames", "rate")
    stage = 0

    def __init__(
        self, neurons: int = 8, time: str = "phase", omega0: float = OMEGA0, edge: int = 0, gain: bool = False,
        seams: Sequence[Sequence[float]] = (), components: Sequence[str] = (),
        channels: Sequence[Sequence[Any]] = (),
    ) -> None:  # fmt: skip
        parts = time.split("+") if isinstance(time, str) and time != "none" else []
        if not isinstance(time, str) or any(p not in TIME_PARTS for p in parts) or len(set(parts)) != len(parts):
            raise ValueError(f"{time!r}: expected none or some of {', '.join(TIME_PARTS)} joined by +")
        self.static = CosineDensity(neurons, omega0, edge, gain)
        self.exact_split = self.static.exact_split
        self.time, self.parts = "+".join(p for p in TIME_PARTS if p in parts) or "none", frozenset(parts)
        self.seams = validate_time_chunk_overlaps(seams)
        if isinstance(components, str) or not all(isinstance(name, str) and name.isidentifier() for name in components):
            raise ValueError(f"components {components!r}; expected a list of names")
        self.named = tuple(components)
        self.ranges = _validate_channels(channels)

    def settings(self) -> dict[str, Any]:
        settings = {**self.static.settings(), "time": self.time}
        if self.seams:
            settings["seams"] = [list(overlap) for overlap in self.seams]
        if self.named:
            settings["components"] = list(self.named)
        if self.ranges:
            settings["channels"] = [[name, *own] for name, own in self.ranges.items()]
        return settings

    @classmethod
    def every_parameter(cls) -> list[ParameterSpec]:
        grids: dict[str, Any] = {"components": ("density", "temperature"), "channels": [("temperature", 1.0, 1, 0.0)]}
        return cls(time="+".join(TIME_PARTS), gain=True, seams=[(0.0, 1.0)], **grids).parameters()

    def parameters(self) -> list[ParameterSpec]:
        K = self.static.neurons
        specs = self.static.parameters()
        if "phase" in self.parts:
            specs.append(ParameterSpec("W_t", (K,), 3e-3, lambda c: c.uniform(K, bound=c.number("rate", 0.1))))
        if "offset" in self.parts:
            zero = _zero_time_parameters(OFFSET_TERMS)
            specs += [ParameterSpec(name, (OFFSET_TERMS,), 3e-3, zero) for name in _OFFSETS]
        if "window" in self.parts:
            specs.append(ParameterSpec("window_center", (1,), 3e-3, _initial_time_window_center))
            specs.append(ParameterSpec("log_window", (1,), 1e-2, _initial_log_time_window))
        if "motion" in self.parts:
            specs.append(ParameterSpec("velocity", (3,), 1e-2, _initial_velocity, lr_unit="extent"))
            specs.append(ParameterSpec("acceleration", (3,), 1e-2, _zero_time_parameters(3), lr_unit="extent"))
        if self.seams:
            specs.append(ParameterSpec("chunk", (1,), 0.0, _zero_time_parameters(1)))
        specs += [ParameterSpec(_SHARE + name, (1,), 0.3, _zero_time_parameters(1)) for name in self.named]
        for name, (largest, width, lowest) in self.ranges.items():
            zero = _zero_time_parameters(width)
            specs.append(ParameterSpec(CHANNEL + name, (width,), 1e-1, zero, low=lowest / largest))
        return specs

    def components(self, params: Params) -> dict[str, Tensor]:
        return {name: params[_SHARE + name].sigmoid().reshape(-1) for name in self.named}

    def channels(self, params: Params) -> dict[str, Tensor]:
        return {name: params[CHANNEL + name] * own.largest for name, own in self.ranges.items()}

    def largest(self, params: Params, geometry: Geometry) -> Tensor:
        changed = dict(params)
        if "offset" in self.parts:
            most = (params["offset_cos"].abs() + params["offset_sin"].abs()).sum(1, keepdim=True)
            changed["b2"] = params["b2"] + most
        return self.static.largest(changed, geometry)

    def active_rows(self, params: Params, conditions: Conditions) -> Tensor | None:
        if "window" not in self.parts and not self.seams:
            return None
        xi, rows = get_frame_time(conditions), None
        if "window" in self.parts:
            rows = rows_in_time_window(params["window_center"], params["log_window"], xi)
        if self.seams:
            counts = time_chunk_weights(params["chunk"], self.seams, xi)[:, 0] > 0
            rows = counts.nonzero()[:, 0] if rows is None else rows[counts[rows]]
        return rows

    def move(self, params: Params, geometry: Geometry, conditions: Conditions) -> Geometry:
        if "motion" not in self.parts:
            return geometry
        center = params["window_center"] if "window" in self.parts else torch.full_like(geometry.means[:, :1], 0.5)
        motion = (params["velocity"], params["acceleration"], center)
        means = move_means(geometry.means, *motion, get_frame_time(conditions))
        return Geometry(means, geometry.log_scales, geometry.quats)

    def lower(self, params: Params, geometry: Geometry, conditions: Conditions) -> Cosine:
        xi = get_frame_time(conditions)
        b1 = params["b1"]
        if "phase" in self.parts:
            b1 = _advance_phase_in_time(b1, params["W_t"], xi, 2 * math.pi / self.static.omega0)
        changed = dict(params)
        if "offset" in self.parts:
            angle = math.pi * xi * torch.arange(1, OFFSET_TERMS + 1, dtype=torch.float64, device=xi.device)
            b2 = params["b2"]
            cosines = params["offset_cos"] @ device.to_device_like(angle.cos(), b2)
            sines = params["offset_sin"] @ device.to_device_like(angle.sin(), b2)
            changed["b2"] = b2 + (cosines + sines)[:, None]
        w2, b2 = apply_density_gain(changed["w2"], changed["b2"], changed.get("log_gain"))
        if "window" in self.parts:
            w2, b2 = apply_time_window(w2, b2, params["window_center"], params["log_window"], xi)
        if self.seams:
            weight = time_chunk_weights(params["chunk"], self.seams, xi).to(b2)
            w2, b2 = w2 * weight, b2 * weight
        return Cosine(params["W1"], b1, w2, b2, self.static.omega0, self.static.edge)

    def density(self, params: Params, geometry: Geometry, prim: Tensor, x: Tensor, conditions: Conditions) -> Tensor:
        form = self.lower(params, geometry, conditions)
        return cosine_density(form, self.move(params, geometry, conditions), prim, x)

    def on_split(self, params: Params, old: Geometry, new: Geometry) -> dict[str, Tensor]:
        children = split_cosine(params, old, new, self.static.omega0, self.static.edge)
        if "offset" in self.parts:
            scale = split_density_scale(old, new, self.static.edge)
            for name in _OFFSETS:
                children[name] = params[name] * scale.to(params["b2"])[:, None]
        return children

    def canonicalize(self, params: Params) -> dict[str, Tensor]:
        if not self.static.neurons and "offset" not in self.parts:
            return self.static.canonicalize(params)
        rates = ("W1", "W_t") if "phase" in self.parts else ("W1",)
        return canonicalize_cosines(params, rates, "b1", "w2", self.static.omega0)

    def from_gaussians(self, alphas: Tensor) -> tuple[Tensor, Tensor]:
        return self.static.from_gaussians(alphas)

    def reductions(self) -> dict[str, tuple[int, ...]]:
        """Return possible reductions: smaller numbers of neurons, and 0 (removal) for each time-dependent part."""
        return self.static.reductions() | {part: (0,) for part in TIME_PARTS if part in self.parts}

    def reduce(
        self, params: Params, geometry: Geometry, name: str, value: int
    ) -> tuple[TimeDensity, dict[str, Tensor]]:
        if name == "neurons":
            field = TimeDensity(**{**self.settings(), "neurons": value})
            return field, prune_cosine_neurons(params, geometry, value, self.static.omega0)
        remaining = drop_time_terms(params, geometry, name, self.static.omega0)
        left = "+".join(part for part in TIME_PARTS if part in self.parts and part != name) or "none"
        field = TimeDensity(**{**self.settings(), "time": left})
        kept = {"means", *(spec.name for spec in field.parameters())}
        return field, {key: value for key, value in remaining.items() if key in kept}

    def prunable_units(self) -> tuple[PrunableUnit, ...]:
        """Return prunable units (parameters zeroed together): neurons, the offset, and motion per axis.

        A window is not prunable, since zeros do not remove it.
        """
        rates = ("W_t",) if "phase" in self.parts else ()
        units = [
            PrunableUnit(unit.name, {**unit.places, **dict.fromkeys(rates, unit.places["b1"])})
            for unit in self.static.prunable_units()
        ]
        if "offset" in self.parts:
            units.append(PrunableUnit("offset", dict.fromkeys(_OFFSETS, ())))
        if "motion" in self.parts:
            units += [PrunableUnit(f"{name} {'xyz'[k]}", {name: (k,)}, name) for name in _MOTION for k in range(3)]
        return tuple(units)

    def script(self) -> str:
        return read_script(__package__, "density.js")

    def scale_density(self, params: Params, factor: Tensor) -> dict[str, Tensor]:
        scaled = self.static.scale_density(params, factor)
        for name in _OFFSETS:
            if name in params:
                scaled[name] = params[name] * factor[:, None]
        return scaled


def _validate_channels(channels: Sequence[Sequence[Any]]) -> dict[str, ChannelRange]:
    """Convert (name, values of a :class:`ChannelRange`) to a dict; raise ValueError if anything is wrong."""
    try:
        ranges = {str(name): ChannelRange(float(most), int(width), float(low)) for name, most, width, low in channels}
        sound = all(name.isidentifier() for name in ranges) and len(ranges) == len(channels)
        sound = sound and all(
            0 < own.largest < math.inf and own.width in (1, 3) and -own.largest <= own.lowest <= 0
            for own in ranges.values()
        )
    except (TypeError, ValueError, OverflowError):
        sound = False
    if not sound:
        expected = "a name, a number above 0, 1 or 3, and a number from minus the first to 0, for each"
        raise ValueError(f"channels {channels!r}; expected {expected}")
    return ranges


def _advance_phase_in_time(b1: Tensor, W_t: Tensor, xi: Tensor, turn: float) -> Tensor:
    """Return the neurons' phases at time ``xi``, b1 + xi W_t, modulo ``turn``, which is 2 pi/omega0.

    The result is exact to float32 even for times far outside 0..1.
    """
    phase = b1.double() + xi * W_t.double()
    return (phase - turn * torch.round(phase.detach() / turn)).to(b1)


def _zero_time_parameters(width: int) -> Any:
    return lambda ctx: torch.zeros(ctx.count, width)


def _initial_velocity(ctx: InitContext) -> Tensor:
    return torch.zeros(ctx.count, 3) if ctx.velocities is None else ctx.velocities.float()


def _initial_time_window_center(ctx: InitContext) -> Tensor:
    """Return the (N, 1) initial centres of windows (spans of time in which primitives are active).

    The centres are the times of the starting points or, if these have no times, uniformly random in 0..1.
    """
    if "time" in ctx.conditions:
        return ctx.conditions["time"].float().reshape(-1, 1)
    return (ctx.uniform(1) + 1) / 2


def _initial_log_time_window(ctx: InitContext) -> Tensor:
    """Return (N, 1) logarithms of the initial half widths of windows (spans of time in which primitives are active).

    The setting ``window_frames`` limits half widths in frames, because longer sequences contain more events, but not
    longer events.
    """
    half = ctx.number("window", 0.2, 0)
    if ctx.settings.get("window_frames") is not None and "time" in ctx.steps:
        half = min(half, ctx.number("window_frames", 1.0, 0) * ctx.steps["time"])
    return torch.full((ctx.count, 1), math.log(half))


# ---------------------------------------------------------------- dropping a part of time

_MEAN_TIMES = 128  # times of a mean: the middles of as many equal parts of the sequence
_MIDDLE = 0.5  # reference time of motion without a window


def drop_time_terms(params: Params, geometry: Geometry, part: str, omega0: float) -> dict[str, Tensor]:
    """Replace one time-dependent part of a :class:`TimeDensity` by its mean over time; return the new tensors.

    Means are over xi in 0..1, weighted by the window if there is a window. The phase of a cosine cos(phi + xi a)
    changes at the rate a. The mean of this cosine is R cos(phi + psi), where R e^(i psi) is the mean of e^(i xi a). A
    window is replaced by its mean factor. A motion is replaced by the mean position, which changes "means". The result
    still contains the tensors of the replaced part.
    """
    if part == "phase":
        return {**params, **_mean_phase_over_time(params, omega0)}
    if part == "offset":
        return {**params, **_mean_offset_over_time(params)}
    return {**params, **(_mean_time_window if part == "window" else _mean_motion_over_time)(params, geometry)}


def _sequence_mean_times(like: Tensor) -> Tensor:
    return (torch.arange(_MEAN_TIMES, dtype=torch.float64, device=like.device) + 0.5) / _MEAN_TIMES


def _time_window_factor(params: Params, xi: Tensor) -> Tensor:
    """Return (N, 1) window factors on density: (1 - u^2)^2, or 0 for |u| > 1; u = (xi - window centre)/half width."""
    u = (xi - params["window_center"].double()) / params["log_window"].double().exp()
    return (1 - u * u).clamp_min(0.0).square()


def _time_weights(params: Params) -> list[tuple[Tensor, Tensor]]:
    """Return pairs (time, (N, 1) weights) for means over time, weighted by the windows if there are any.

    The weights of a primitive add up to 1.
    """
    times = _sequence_mean_times(params["b1"])
    if "window_center" not in params:
        even = torch.full_like(params["b2"].double(), 1.0 / _MEAN_TIMES)
        return [(xi, even) for xi in times]
    factors = [_time_window_factor(params, xi) for xi in times]
    total = torch.stack(factors).sum(0)
    active = total > 0
    divisor = total.where(active, torch.ones_like(total))
    weights = (torch.where(active, factor / divisor, 1.0 / _MEAN_TIMES) for factor in factors)
    return list(zip(times, weights, strict=True))


def _mean_phase_over_time(params: Params, omega0: float) -> dict[str, Tensor]:
    advance = omega0 * params["W_t"].double()
    real, imaginary = torch.zeros_like(advance), torch.zeros_like(advance)
    for xi, weight in _time_weights(params):
        real += weight * (xi * advance).cos()
        imaginary += weight * (xi * advance).sin()
    b1 = params["b1"].double() + torch.atan2(imaginary, real) / omega0
    w2 = params["w2"].double() * torch.hypot(real, imaginary)
    return {"b1": b1.to(params["b1"]), "w2": w2.to(params["w2"])}


def _mean_offset_over_time(params: Params) -> dict[str, Tensor]:
    cosines, sines = params["offset_cos"].double(), params["offset_sin"].double()
    order = math.pi * torch.arange(1, cosines.shape[1] + 1, dtype=torch.float64, device=cosines.device)
    b2 = params["b2"].double()
    for xi, weight in _time_weights(params):
        b2 = b2 + weight * (cosines @ (xi * order).cos() + sines @ (xi * order).sin())[:, None]
    return {"b2": b2.to(params["b2"])}


def _mean_time_window(params: Params, geometry: Geometry) -> dict[str, Tensor]:
    mean = torch.stack([_time_window_factor(params, xi) for xi in _sequence_mean_times(params["b1"])]).mean(0)
    names = [name for name in ("w2", "b2", *_OFFSETS) if name in params]
    faded = {name: (params[name].double() * mean).to(params[name]) for name in names}
    if "velocity" not in params:
        return faded
    later = _MIDDLE - params["window_center"].double()
    means = geometry.means.double() + (params["velocity"].double() + params["acceleration"].double() * later) * later
    moved = (params["velocity"].double() + 2 * params["acceleration"].double() * later).to(params["velocity"])
    return {**faded, "means": means.to(geometry.means), "velocity": moved}


def _mean_motion_over_time(params: Params, geometry: Geometry) -> dict[str, Tensor]:
    center = params["window_center"].double() if "window_center" in params else _MIDDLE
    means = geometry.means.double()
    for xi, weight in _time_weights(params):
        later = xi - center
        means = means + weight * (params["velocity"].double() + params["acceleration"].double() * later) * later
    return {"means": means.to(geometry.means)}
