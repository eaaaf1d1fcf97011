"""Read and check a training's state, as :meth:`~neuprim.core.train.trainer.Trainer.state` makes it."""

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

__all__ = ["TrainerState", "hash_names", "parse_state"]


@dataclass(frozen=True)
class TrainerState:
    """A checked state: what :meth:`~neuprim.core.train.trainer.Trainer.load_state` takes over."""

    model: Primitives
    optimizer: RowAdam
    generator: torch.Generator
    population: dict[str, Tensor]
    zero_masks: dict[str, Tensor]
    exposures: dict[str, Tensor]
    step: int
    elapsed: float


def hash_names(views: ViewSet) -> str:
    """Hash the names of views: other frames or images of the same number are other data."""
    text = "\n".join(views.view(i).name for i in range(len(views)))
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def parse_state(
    tensors: dict[str, Tensor],
    header: dict[str, Any],
    where: str,
    like: Primitives,
    beta2: float,
    train: ViewSet,
    exposures: Exposures | None,
) -> TrainerState:
    """Check a state against a trainer's model, settings and data, which do not change.

    Args:
        where: file of the state, for messages.
        like: a model of the same fields.
        beta2: of the optimizer.
        train: the training views.
        exposures: of the trainer; None for a training without.

    Raises:
        CheckpointError: it belongs to other settings or data; names what differs.
    """
    step, elapsed, views = header.get("step"), header.get("elapsed"), header.get("views")
    if not isinstance(step, int) or not isinstance(elapsed, (int, float)) or step < 0 or not math.isfinite(elapsed):
        raise CheckpointError(f"{where}: step {step!r}, elapsed {elapsed!r}; expected numbers")
    if views != len(train):
        raise CheckpointError(f"{where}: trained on {views} views, the data set now has {len(train)}")
    if header.get("names") != hash_names(train):
        raise CheckpointError(f"{where}: trained on {views} views with other names than those of the data set now")
    try:
        model = Primitives(like.density, like.colour, _select(tensors, "params."))
        optimizer = RowAdam(model.specs, model.params, beta2)
        optimizer.load_state(_select(tensors, "adam."))
        _check_optimizer(model, optimizer, step)
        order = tensors["order"]
        if (
            order.dim() != 1
            or order.dtype != torch.int64
            or (len(order) and (int(order.min()) < 0 or int(order.max()) >= views))
        ):
            raise ValueError("the order of views is out of range")
        generator = torch.Generator()
        generator.set_state(tensors["generator"])
        population = _select(tensors, "population.")
        for name, value in population.items():
            if value.dim() > 0 and value.shape != (model.count,):
                raise ValueError(f"statistic {name} has shape {tuple(value.shape)}; expected ({model.count},)")
        zero_masks = _select(tensors, "zeros.")
        for name, mask in zero_masks.items():
            if name not in model.params or mask.shape != model.params[name].shape or mask.dtype != torch.bool:
                raise ValueError(f"zeros of {name!r} are {mask.dtype} {tuple(mask.shape)}")
        gains = _select(tensors, "exposure.")
        if bool(gains) != (exposures is not None):
            rate = 0.0 if exposures is None else exposures.rate
            raise ValueError(f"it has {'' if gains else 'no '}exposures, train.exposure_rate is {rate:g}")
        if exposures is not None:
            exposures.check_state(gains)
    except (ValueError, KeyError, RuntimeError, TypeError, IndexError) as error:
        raise CheckpointError(f"{where}: does not fit this run's settings ({error})") from error
    return TrainerState(model, optimizer, generator, population, zero_masks, gains, step, float(elapsed))


def _check_optimizer(model: Primitives, optimizer: RowAdam, step: int) -> None:
    """Raise ValueError where parameters, moments or ages have other shapes or types, or impossible values."""
    for name, value in (*model.params.items(), *optimizer.m.items(), *optimizer.v.items()):
        shape = model.params[name].shape
        if value.shape != shape or value.dtype != torch.float32 or not bool(torch.isfinite(value).all()):
            raise ValueError(
                f"{name} or a moment of it is {value.dtype} {tuple(value.shape)}; "
                f"expected finite float32 {tuple(shape)}"
            )
    age = optimizer.age
    if age.shape != (model.count,) or age.dtype != torch.int64:
        raise ValueError(f"ages are {age.dtype} {tuple(age.shape)}; expected int64 ({model.count},)")
    if model.count and not 0 <= int(age.min()) <= int(age.max()) <= step:
        raise ValueError(f"ages are {int(age.min())} to {int(age.max())} steps; expected 0 to {step}")


def _select(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Tensors whose names begin with a prefix, without it."""
    return {name[len(prefix) :]: value for name, value in tensors.items() if name.startswith(prefix)}
