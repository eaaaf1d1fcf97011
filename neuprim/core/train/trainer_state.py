"""Checks of a training's settings, and of saved states from :meth:`~neuprim.core.train.trainer.Trainer.state`."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.data import Dataset
from neuprim.core.errors import CheckpointError, ConfigError, DataError, nearest
from neuprim.core.model.primitives import Primitives
from neuprim.core.train.settings import TrainSettings

_FIXED = ("params", "adam", "exposure", "correction")
"""Groups of state tensors; the tensor "adam.age" belongs to the group "adam". All states with the same settings have
the same tensors in each of these groups."""


def select_state_tensors(tensors: Mapping[str, Tensor], prefix: str) -> dict[str, Tensor]:
    """Return the tensors whose names begin with ``prefix``, by their names without the prefix."""
    return {name.removeprefix(prefix): value for name, value in tensors.items() if name.startswith(prefix)}


def check_state(
    tensors: Mapping[str, Tensor],
    header: Mapping[str, Any],
    where: str,
    own_tensors: Mapping[str, Tensor],
    own_header: Mapping[str, Any],
) -> None:
    """Check that a saved state fits the trainer that will continue from it.

    Args:
        tensors, header: the saved state.
        where: file of the saved state, for messages.
        own_tensors, own_header: current state of the trainer.

    Raises:
        CheckpointError: the saved state belongs to other settings or data; the message says what differs.
    """
    step, elapsed, views = (header.get(name) for name in ("step", "elapsed", "views"))
    if not isinstance(step, int) or not isinstance(elapsed, (int, float)) or step < 0 or not math.isfinite(elapsed):
        raise CheckpointError(f"{where}: step is {step!r} and elapsed is {elapsed!r}; expected numbers of at least 0")
    if views != own_header["views"]:
        raise CheckpointError(
            f"{where}: trained on {views} views, but the data set now has {own_header['views']}; "
            "continue with the original views"
        )
    if header.get("names") != own_header["names"]:
        raise CheckpointError(
            f"{where}: trained on {views} views, which now have other names; continue with the original views"
        )
    fault = _find_state_fault(tensors, own_tensors, step, own_header["views"])
    if fault is not None:
        raise CheckpointError(f"{where}: does not fit this run's settings ({fault})")


def _find_state_fault(tensors: Mapping[str, Tensor], own: Mapping[str, Tensor], step: int, views: int) -> str | None:
    means = tensors.get("params.means", torch.zeros(()))
    count = len(means) if means.dim() else 0
    # order, population and zeros may be of other shapes, or missing, at another step
    names = [name for name in own if name.partition(".")[0] in (*_FIXED, "generator")]
    for name in names:
        like, found = own[name], tensors.get(name)
        shape = (count, *like.shape[1:]) if name.startswith(("params.", "adam.")) else tuple(like.shape)
        if found is None:
            return f"it has no {name}"
        if found.dtype != like.dtype or found.shape != shape or not bool(found.isfinite().all()):
            return f"{name} is {found.dtype} {tuple(found.shape)}; expected finite {like.dtype} {shape}"
    for name, value in tensors.items():
        kind, _, rest = name.partition(".")
        if kind == "population" and value.dim() > 0 and value.shape != (count,):
            return f"{name} has shape {tuple(value.shape)}; expected ({count},)"
        if kind == "zeros" and (
            f"params.{rest}" not in names or value.shape != tensors[f"params.{rest}"].shape or value.dtype != torch.bool
        ):
            return f"{name} is {value.dtype} {tuple(value.shape)}"
        if kind in _FIXED and name not in names:
            return f"it has {name}, which these settings do not use"
    order, age = tensors.get("order"), tensors["adam.age"]
    fits = order is not None and order.dim() == 1 and order.dtype == torch.int64
    if order is None or not fits or not bool(((order >= 0) & (order < views)).all()):
        return "the order of views is out of range"
    if not bool(((age >= 0) & (age <= step)).all()):
        return f"ages are {int(age.min())} to {int(age.max())} steps; expected 0 to {step}"
    try:
        torch.Generator().set_state(tensors["generator"])
    except RuntimeError as error:
        return str(error)
    return None


def check_training_settings(settings: TrainSettings, model: Primitives, dataset: Dataset) -> TrainSettings:
    """Check that settings fit the model and the data; return them with ``supervision="auto"`` resolved.

    "auto" becomes "both" if the data set has points with known extinction, else "images".
    """
    if len(dataset.train) == 0:
        raise DataError(f"{dataset.name}: the training split is empty")
    names = [spec.name for spec in model.specs]
    for group, given in (("rates", settings.rates), ("rate_units", settings.rate_units)):
        for key in given:
            if key not in names:
                raise ConfigError(f"train.{group}.{key}: no such parameter{nearest(key, names)}")
    if settings.supervision == "auto":
        settings = replace(settings, supervision="images" if dataset.points is None else "both")
    if settings.supervision != "images" and dataset.points is None:
        raise ConfigError(
            f"train.supervision={settings.supervision}: {dataset.name} has no voxels to learn from; expected images"
        )
    if settings.exposure_rate > 0 and dataset.train.pixels(0).alpha is not None:
        raise ConfigError(
            f"train.exposure_rate={settings.exposure_rate:g}: images of {dataset.name} have alpha; expected opaque "
            "photographs, because a learned exposure would also change the background. Set train.exposure_rate=0."
        )
    return settings
