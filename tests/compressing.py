"""Models of every built-in field for tests of compressed files, and the loss that codes alone explain."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from neuprim.core.compression.codec import Quantizers, canonical_model, fit_quantizers, storage_order
from neuprim.core.compression.quantizers import BitTable
from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.fields import ColourField, DensityField, prunable_units_of_model
from neuprim.core.model.gaussian import GaussianDensity
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import PrunableUnit, zero_units
from neuprim.core.model.schema import InitContext
from neuprim.core.task import TaskSpec
from neuprim.plugins.registry import load_task


def field(task: str, name: str, **settings: object) -> DensityField | ColourField:
    """A field of a built-in task."""
    known = load_task(task).fields or {}
    made = known[name](**settings)  # type: ignore[call-arg]
    assert isinstance(made, DensityField | ColourField)
    return made


def random_model(density: DensityField, colour: ColourField, count: int = 40, seed: int = 0) -> Primitives:
    """Primitives whose every parameter is spread out, as after training: phases of several turns, weights of both
    signs."""
    generator = torch.Generator().manual_seed(seed)

    def u(*shape: int) -> Tensor:
        return 2 * torch.rand(*shape, generator=generator) - 1

    context = InitContext(u(count, 3), 0.1 + 0.05 * u(count), 0.5 + 0.4 * u(count, colour.channels), generator)
    model = Primitives.initialise(density, colour, context)
    for name, value in model.params.items():
        model.params[name] = value + (0.7 if name != "means" else 0.0) * u(*value.shape)
    return model


FIELDS: dict[str, tuple[str, Callable[[], tuple[DensityField, ColourField]]]] = {
    "static": ("static", lambda: (CosineDensity(3), field("static", "SphericalHarmonics", degree=3))),
    "soft": ("static", lambda: (CosineDensity(2, edge=2, gain=True), field("static", "SphericalHarmonics", degree=1))),
    "bare": ("static", lambda: (CosineDensity(0), field("static", "SphericalHarmonics", degree=0))),
    "grey": ("static", lambda: (CosineDensity(1), field("static", "SphericalHarmonics", degree=2, channels=1))),
    "lobes": ("static", lambda: (CosineDensity(2), field("static", "SphericalLobes", lobes=2))),
    "dynamic": (
        "dynamic",
        lambda: (
            field("dynamic", "TimeDensity", neurons=3, time="phase+offset+window+motion", gain=True),
            field("dynamic", "TimeHarmonics", degree=2, powers=2, waves=3),
        ),
    ),
    "volume": (
        "dynamic",
        lambda: (
            field("dynamic", "TimeDensity", neurons=0, time="window+motion", edge=2, gain=True),
            field("dynamic", "TimeHarmonics", degree=0),
        ),
    ),
    "additive": ("relight", lambda: (CosineDensity(2), field("relight", "LightNetwork", hidden=4))),
    "multiplicative": (
        "relight",
        lambda: (CosineDensity(2), field("relight", "LightNetwork", hidden=3, form="multiplicative")),
    ),
    "surface": ("relight", lambda: (CosineDensity(0), field("relight", "SurfaceColour", lobes=2))),
    "harmonics": ("relight", lambda: (CosineDensity(2), field("relight", "LightHarmonics", degree=4))),
}  # type: ignore[dict-item]
"""Name -> task, and a density and a colour."""


def example(name: str, count: int = 40) -> tuple[TaskSpec, Primitives]:
    """A task, and a model with its fields."""
    task, make = FIELDS[name]
    return load_task(task), random_model(*make(), count=count)


def goners(model: Primitives) -> dict[str, tuple[PrunableUnit, Tensor]]:
    """Of every piece of a model, every k-th primitive, with another k for each."""
    pieces = prunable_units_of_model(model.density, model.colour)
    return {
        name: (piece, torch.arange(model.count) % (2 + i % 3) == 0) for i, (name, piece) in enumerate(pieces.items())
    }


def without_pieces(model: Primitives) -> Primitives:
    """The model as pruning leaves it: :func:`goners` are zero."""
    return Primitives(model.density, model.colour, zero_units(goners(model), model.params))


def gaussians(count: int = 30) -> Primitives:
    """A model of a density that no task of ours has."""
    return random_model(GaussianDensity(), field("static", "SphericalHarmonics", degree=1), count)  # type: ignore[arg-type]


def stored(model: Primitives, table: BitTable) -> tuple[Primitives, Quantizers]:
    """The model before any number is rounded, folded and in the order of the file, and how its numbers are coded."""
    whole = canonical_model(model)
    made = fit_quantizers(whole, table)
    rows = storage_order(whole, made)
    return Primitives(model.density, model.colour, {name: value[rows] for name, value in whole.params.items()}), made
