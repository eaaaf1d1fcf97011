"""The words that ask for a result instead of a configuration: ``target.psnr=30 budget=10m``.

They stand among the words after ``neuprim run`` and are taken out of them here; what is left composes to the
configuration that the search starts from.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

from neuprim.config.duration import seconds_of
from neuprim.config.overrides import Assignment, key_of, parse, swept_keys
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.validation import Range, format_value, validate

__all__ = ["Target", "target_words"]


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


NAMES = tuple(field.name for field in dataclasses.fields(Target))


def target_words(words: Sequence[str]) -> tuple[tuple[Target, float] | None, list[str]]:
    """The target and its budget, seconds, and the other words; None where no target is asked for.

    Raises:
        ConfigError: a target without a budget or the reverse, no such target, or an impossible value.
    """
    own = [word for word in words if _is_own(word)]
    if not own:
        return None, list(words)
    for key in swept_keys(own):
        raise ConfigError(f"{key}: several values; expected one, as a target is for one run")
    said = {a.key: a for a in parse(own)}
    budget = said.pop("budget", None)
    if not said:
        assert budget is not None
        raise ConfigError(
            f"{budget.text}: no target; expected one of {_choices()} beside it, or train.max_seconds=S for a run without a target"
        )
    given = {_name(a): a.value for a in said.values()}
    target = validate(Target, given, "target")
    if not target.given():
        raise ConfigError(f"{next(iter(said.values())).text}: expected one of {_choices()}")
    if budget is None:
        raise ConfigError(
            f"{target}: expected a budget beside it, the time for search and training together, such as budget=10m"
        )
    if not isinstance(budget.value, str):
        raise ConfigError(f"budget={format_value(budget.value)}: expected a time such as 90s, 5m or 1h")
    return (target, seconds_of(budget.value, budget.text)), [word for word in words if not _is_own(word)]


def _is_own(word: str) -> bool:
    key = key_of(word)
    return key in ("budget", "target") or key.startswith(("target.", "budget."))


def _name(assignment: Assignment) -> str:
    head, _, name = assignment.key.partition(".")
    if head == "budget":
        raise ConfigError(f"{assignment.text}: no such setting; did you mean 'budget'?")
    if not name:
        raise ConfigError(f"{assignment.text}: expected one of {_choices()}")
    if name not in NAMES:
        raise ConfigError(f"{assignment.key}: no such target{nearest(name, NAMES)}")
    return name


def _choices() -> str:
    values: dict[str, Any] = {"psnr": "DB", "ssim": "S", "megabytes": "M", "fps": "F"}
    return ", ".join(f"target.{name}={values[name]}" for name in NAMES)
