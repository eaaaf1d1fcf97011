"""A training's state on its way to a file and back: what is kept by row, and whether what was read can be gone on
from."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from neuprim.core.data import ViewSet
from neuprim.core.errors import CheckpointError
from neuprim.core.model.primitives import Primitives
from neuprim.core.train.exposure import Exposures
from neuprim.core.train.optimizer import RowAdam

__all__ = ["Restored", "by_row", "by_row_name", "names_of", "part", "restored"]


def by_row(name: str, value: Tensor) -> bool:
    """Whether a tensor of the state has a row for each primitive."""
    return by_row_name(name) and value.dim() > 0


def by_row_name(name: str) -> bool:
    """The same of one that is not a single number."""
    return name.split(".")[0] in ("params", "adam", "population", "zeros")


def part(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Those whose names begin so, without it."""
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}


def names_of(views: ViewSet) -> str:
    """A short hash of views' names: other frames or images of the same number are other data."""
    text = "\n".join(views.view(i).name for i in range(len(views)))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True)
class Restored:
    """A state that fits: what :meth:`~neuprim.core.train.trainer.Trainer.load_state` takes over."""

    model: Primitives
    optimizer: RowAdam
    generator: torch.Generator
    population: dict[str, Tensor]
    zeros: dict[str, Tensor]
    step: int
    elapsed: float


def restored(
    tensors: dict[str, Tensor],
    header: dict[str, Any],
    where: str,
    like: Primitives,
    beta2: float,
    train: ViewSet,
    exposures: Exposures | None,
) -> Restored:
    """Read :meth:`~neuprim.core.train.trainer.Trainer.state`; ``exposures`` are taken over.

    Raises:
        CheckpointError: it belongs to other settings or data; names what differs.
    """
    step, elapsed, views = header.get("step"), header.get("elapsed"), header.get("views")
    if not isinstance(step, int) or not isinstance(elapsed, (int, float)) or step < 0 or not math.isfinite(elapsed):
        raise CheckpointError(f"{where}: step {step!r}, elapsed {elapsed!r}; expected numbers")
    if views != len(train):
        raise CheckpointError(f"{where}: trained on {views} views, the data set now has {len(train)}")
    if header.get("names", names_of(train)) != names_of(train):  # earlier checkpoints have none
        raise CheckpointError(f"{where}: trained on {views} views with other names than those of the data set now")
    try:
        model = Primitives(like.density, like.colour, part(tensors, "params."))
        optimizer = RowAdam(model.specs, model.params, beta2)
        optimizer.load_state(part(tensors, "adam."))
        for name, value in (*model.params.items(), *optimizer.m.items(), *optimizer.v.items()):
            shape = model.params[name].shape
            if value.shape != shape or value.dtype != torch.float32 or not bool(torch.isfinite(value).all()):
                raise ValueError(
                    f"{name} or a moment of it is {value.dtype} {tuple(value.shape)}; expected finite float32 {tuple(shape)}"
                )
        if optimizer.age.shape != (model.count,) or optimizer.age.dtype != torch.int64:
            raise ValueError(
                f"ages are {optimizer.age.dtype} {tuple(optimizer.age.shape)}; expected int64 ({model.count},)"
            )
        if model.count and not 0 <= int(optimizer.age.min()) <= int(optimizer.age.max()) <= step:
            raise ValueError(
                f"ages are {int(optimizer.age.min())} to {int(optimizer.age.max())} steps; expected 0 to {step}"
            )
        order = tensors["order"]
        if (
            order.dim() != 1
            or order.dtype != torch.int64
            or (len(order) and (int(order.min()) < 0 or int(order.max()) >= views))
        ):
            raise ValueError("the order of views is out of range")
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        population = part(tensors, "population.")
        for name, value in population.items():
            if value.dim() > 0 and value.shape != (model.count,):
                raise ValueError(f"statistic {name} has shape {tuple(value.shape)}; expected ({model.count},)")
        zeros = part(tensors, "zeros.")
        for name, zero in zeros.items():
            if name not in model.params or zero.shape != model.params[name].shape or zero.dtype != torch.bool:
                raise ValueError(f"zeros of {name!r} are {zero.dtype} {tuple(zero.shape)}")
        given = part(tensors, "exposure.")
        if bool(given) != (exposures is not None):
            raise ValueError(
                f"it has {'' if given else 'no '}exposures, train.exposure_rate is {0.0 if exposures is None else exposures.rate:g}"
            )
        if exposures is not None:
            exposures.load_state(given)
    except (ValueError, KeyError, RuntimeError, TypeError, IndexError) as error:
        raise CheckpointError(f"{where}: does not fit this run's settings ({error})") from error
    return Restored(model, optimizer, generator, population, zeros, step, float(elapsed))
