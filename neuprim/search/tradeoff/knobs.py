"""What is tried: a ladder of operating points for every knob, each turned alone from the reference."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from neuprim.core.compute.threads import core_count
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, backends
from neuprim.runs.render_config import FLOAT32, FORMATS, GROUPS, RenderConfig

__all__ = ["COMBINED", "Candidate", "LeftOut", "candidates", "check_knobs", "joined", "knobs_of"]

COMBINED = "combined"
"""In place of a knob's name, for points that turn several."""


@dataclass(frozen=True)
class Candidate:
    """A point to measure; ``knob`` is what it turns."""

    knob: str
    point: RenderConfig


@dataclass(frozen=True)
class LeftOut:
    """What was not measured, and why."""

    knob: str
    words: tuple[str, ...]
    reason: str


Ladder = Callable[[RenderConfig, Primitives], Iterable[RenderConfig]]


def _setting(name: str, *values: Any) -> Ladder:
    """One setting of the renderer at several values."""

    def ladder(reference: RenderConfig, model: Primitives) -> Iterator[RenderConfig]:
        for value in values:
            yield replace(reference, settings=replace(reference.settings, **{name: value}))

    return ladder


def _resolution(reference: RenderConfig, model: Primitives) -> Iterator[RenderConfig]:
    for part in (1.0, 0.75, 0.5, 0.25):
        yield replace(reference, resolution=part)


def _backends(reference: RenderConfig, model: Primitives) -> Iterator[RenderConfig]:
    for name in backends.backend_names():
        yield replace(reference, settings=replace(reference.settings, backend=name))


def _threads(reference: RenderConfig, model: Primitives) -> Iterator[RenderConfig]:
    counts = sorted({1, 0, *(2**k for k in range(1, 7) if 2**k < core_count())})
    yield from _setting("threads", *(counts if core_count() > 1 else ()))(reference, model)


def _stored(reference: RenderConfig, model: Primitives) -> Iterator[RenderConfig]:
    for name in FORMATS:
        if name != FLOAT32:
            for group in GROUPS:
                yield replace(reference, storage=dict(sorted({**reference.storage, group: name}.items())))
            yield replace(reference, storage=dict.fromkeys(sorted(GROUPS), name))


LADDERS: Mapping[str, Ladder] = {
    "alpha_min": _setting("alpha_min", 0.0, *(2.0**-k for k in (10, 9, 8, 7, 6, 5))),
    "transmittance_min": _setting("transmittance_min", 0.0, 1e-4, 1e-3, 3e-3, 1e-2, 3e-2, 1e-1),
    "alpha_max": _setting("alpha_max", 0.9, 0.95, 0.99, 0.999, 0.9999),
    "sort": _setting("sort", "center", "entry"),
    "samples": _setting("samples", 1, 2, 4),
    "resolution": _resolution,
    "backend": _backends,
    "threads": _threads,
    "store": _stored,
}
"""The knobs that every model has. What its fields can do with less of comes to these, as density.NAME and
colour.NAME."""


def _less(kind: str, name: str, values: Sequence[int]) -> Ladder:
    def ladder(reference: RenderConfig, model: Primitives) -> Iterator[RenderConfig]:
        for value in values:
            yield replace(reference, reduced=dict(sorted({**reference.reduced, (kind, name): value}.items())))

    return ladder


def knobs_of(model: Primitives) -> dict[str, Ladder]:
    """The knobs of a model by name."""
    fields = (("density", model.density), ("colour", model.colour))
    own = {
        f"{kind}.{name}": _less(kind, name, values)
        for kind, field in fields
        for name, values in field.reductions().items()
    }
    return {**LADDERS, **own}


def check_knobs(names: Sequence[str], model: Primitives) -> None:
    """Raise :class:`ConfigError` for a name that is no knob of the model."""
    for name in names:
        if name not in knobs_of(model):
            raise ConfigError(f"--knobs {name}: no such knob of this run{nearest(name, knobs_of(model))}")


def candidates(
    names: Sequence[str],
    reference: RenderConfig,
    model: Primitives,
    fault: Callable[[RenderConfig], str | None],
    usual: RenderSettings,
) -> tuple[list[Candidate], list[LeftOut]]:
    """Every point that turns one of these knobs, without the reference itself, and what cannot be.

    Args:
        names: of knobs, checked; empty for all.
        fault: why a point cannot be drawn here; None if it can.
        usual: the settings that words are over.
    """
    found: list[Candidate] = []
    out: list[LeftOut] = []
    for name, ladder in knobs_of(model).items():
        if names and name not in names:
            continue
        turned = [point for point in ladder(reference, model) if point != reference]
        if not turned:
            why = "this process has one core" if name == "threads" else "nothing but what the run has"
            out.append(LeftOut(name, (), why))
        for point in turned:
            reason = fault(point)
            if reason is None:
                found.append(Candidate(name, point))
            else:
                out.append(LeftOut(name, point.to_overrides(usual), reason))
    for kind, field in (("density", model.density), ("colour", model.colour)):
        if not names and not field.reductions():
            out.append(
                LeftOut(
                    kind, (), f"{type(field).__name__} as it is has nothing that a finished model can do with less of"
                )
            )
    return found, out


def joined(reference: RenderConfig, points: Iterable[RenderConfig]) -> RenderConfig:
    """The point that has everything in which any of these differs from the reference; the last one's, where they
    disagree."""
    result = reference
    for point in points:
        changed = {
            name: getattr(point.settings, name)
            for name in RenderSettings.__dataclass_fields__
            if getattr(point.settings, name) != getattr(reference.settings, name)
        }
        result = RenderConfig(
            replace(result.settings, **changed),
            result.resolution if point.resolution == reference.resolution else point.resolution,
            dict(sorted({**result.reduced, **point.reduced}.items())),
            dict(sorted({**result.storage, **point.storage}.items())),
        )
    return result
