"""What the functions of a task or loss return, checked where it enters neuprim."""

from __future__ import annotations

from typing import Any

from torch import Tensor

from neuprim.core.data import Dataset
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.task import Loss, Supervision
from neuprim.plugins.blame import blamed
from neuprim.plugins.mechanism import PluginError

__all__ = ["check_fields", "checked_loss"]


def check_fields(density: object, colour: object, dataset: Dataset, where: str) -> None:
    """Refuse what ``build`` returned unless it is two fields, the colour with the data set's channels.

    Raises:
        PluginError: begins with ``where``.
    """
    for name, made, kind in (("density", density, DensityField), ("colour", colour, ColourField)):
        if not isinstance(made, kind):
            raise PluginError(
                f"{where}: the {name} is of type {type(made).__name__}; expected a neuprim.core.model.fields.{kind.__name__}"
            )
    channels = getattr(colour, "channels", None)
    if channels != dataset.channels:
        raise PluginError(
            f"{where}: the colour has channels={channels}; expected {dataset.channels}, as data set {dataset.name!r} has"
        )


def checked_loss(loss: Loss, guard: blamed) -> Loss:
    """The loss, of which every call is in ``guard`` and every result is what :data:`~neuprim.core.task.Loss` says.

    Raises:
        PluginError: when called, for a crash or a result of another kind.
    """

    def call(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, float]]:
        with guard:
            value, parts = loss(rendered, truth, frame)
        wrong = _fault(value, parts, rendered)
        if wrong:
            raise PluginError(f"{guard.party.who}: returned {wrong}")
        return value, parts

    return call


def _fault(value: Any, parts: Any, rendered: Tensor) -> str | None:
    if not isinstance(value, Tensor):
        return f"a {type(value).__name__} as its value; expected one number as a tensor"
    if value.dim():
        return f"a tensor of shape {tuple(value.shape)} as its value; expected one number"
    if rendered.requires_grad and not value.requires_grad:
        return "a value without gradient; expected one that depends on the rendered image"
    if not isinstance(parts, dict):
        return f"parts of type {type(parts).__name__}; expected a dictionary of names to numbers"
    for name, part in parts.items():
        if not isinstance(part, (int, float)):
            return f"part {name!r} of type {type(part).__name__}; expected a number"
    return None
