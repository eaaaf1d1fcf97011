"""Losses for linear light of high dynamic range."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from neuprim.core.errors import ConfigError, nearest
from neuprim.core.task import Loss

__all__ = ["LOSSES", "hdr_loss"]

_MU = 16.0
_DARK = 0.05


def _l1(rendered: Tensor, truth: Tensor) -> Tensor:
    return (rendered - truth).abs().mean()


def _compressed(rendered: Tensor, truth: Tensor) -> Tensor:
    """L1 of log(1 + mu x) / log(1 + mu): shadows count more, highlights less."""
    scale = torch.log1p(torch.tensor(_MU))
    a, b = (torch.log1p(_MU * x.clamp_min(0.0)) / scale for x in (rendered, truth))
    return (a - b).abs().mean()


def _relative(rendered: Tensor, truth: Tensor) -> Tensor:
    """Squared error over the squared rendered value (Mildenhall et al. 2022, RawNeRF), which carries no gradient itself."""
    return ((rendered - truth) / (rendered.detach().clamp_min(0.0) + _DARK)).square().mean()


LOSSES = {"l1": _l1, "compressed": _compressed, "relative": _relative}
"""By name, as ``task.options.loss``. Over exposure: 1 is the exposure's white, more is possible."""


def hdr_loss(settings: Mapping[str, Any]) -> Loss:
    """The loss of a run, from ``options.loss`` (l1 unless given).

    Raises:
        ConfigError: no such loss.
    """
    name = str(settings["options"].get("loss", "l1"))
    if name not in LOSSES:
        raise ConfigError(f"task.options.loss={name}: no such loss{nearest(name, LOSSES)}")
    measure = LOSSES[name]

    def loss(rendered: Tensor, truth: Tensor) -> tuple[Tensor, dict[str, float]]:
        value = measure(rendered, truth)
        return value, {name: value.item()}

    return loss
