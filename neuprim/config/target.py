"""A result asked for instead of a configuration, ``target.psnr=30 budget=10m``: a search finds the configuration."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

from neuprim.config.overrides import take_group
from neuprim.core.errors import ConfigError
from neuprim.core.validation import Range, format_value, validate

__all__ = ["Target", "parse_duration", "take_target"]


@dataclass(frozen=True)
class Target:
    """What a model is to reach. With ``psnr`` or ``ssim``, or both, the smallest model that has them is wanted, and
    ``megabytes`` and ``fps`` are limits beside them; without, the best model within the limits is.

    Attributes:
        psnr: mean over views, dB.
        ssim: mean over views.
        megabytes: at most; millions of bytes of the compressed model, ``model.neuprim``.
        fps: at least; frames per second on this machine, at the size of the views.
    """

    psnr: Annotated[float, Range(above=0, at_most=100, says="decibels, above 0 and at most 100")] | None = None
    ssim: Annotated[float, Range(above=0, below=1, says="a number between 0 and 1")] | None = None
    megabytes: Annotated[float, Range(above=0, says="a positive number of megabytes")] | None = None
    fps: Annotated[float, Range(above=0, says="a positive number of frames per second")] | None = None

    def given(self) -> dict[str, float]:
        """Name -> value of what was asked for."""
        return {name: value for name, value in dataclasses.asdict(self).items() if value is not None}

    @property
    def quality(self) -> dict[str, float]:
        """Name -> value of the measures of quality among them."""
        return {name: value for name, value in self.given().items() if name in ("psnr", "ssim")}

    def __str__(self) -> str:
        return " ".join(f"target.{name}={value:g}" for name, value in self.given().items())


def take_target(overrides: Sequence[str]) -> tuple[tuple[Target, float] | None, list[str]]:
    """Return the target and its budget in seconds, None where none is asked for, and the other overrides.

    Raises:
        ConfigError: a target without a budget or the reverse, no such target, or an impossible value.
    """
    values, others = take_group(overrides, "target")
    budgets, others = take_group(others, "budget")
    if not values and not budgets:
        return None, others
    if budgets.keys() - {""}:
        raise ConfigError(f"budget.{next(iter(budgets.keys() - {''}))}: no such setting; did you mean 'budget'?")
    budget = budgets.get("")
    if not values:
        raise ConfigError(
            f"budget={format_value(budget)}: no target; expected one of {_CHOICES} beside it, "
            "or train.max_seconds=S for a run without a target"
        )
    if "" in values:
        raise ConfigError(f"target={format_value(values[''])}: expected one of {_CHOICES}")
    target = validate(Target, values, "target")
    if not target.given():
        raise ConfigError(f"target.{next(iter(values))}=null: expected one of {_CHOICES}")
    if not budgets:
        raise ConfigError(
            f"{target}: expected a budget beside it, the time for search and training together, such as budget=10m"
        )
    text = format_value(budget)
    return (target, parse_duration(budget if isinstance(budget, str) else "", f"budget={text}")), others


def parse_duration(text: str, asked: str) -> float:
    """Return the seconds of a time such as 90s, 5m or 1h.

    Args:
        asked: what the user typed, for the message.

    Raises:
        ConfigError: it is something else.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", text)
    if match is None or float(match[1]) == 0:
        raise ConfigError(f"{asked}: expected a time such as 90s, 5m or 1h")
    return float(match[1]) * {"s": 1.0, "m": 60.0, "h": 3600.0}[match[2]]


_CHOICES = "target.psnr=DB, target.ssim=S, target.megabytes=M, target.fps=F"
