"""What is trained: the centre that the user's words name, and every knob turned alone from there."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest

from neuprim.config import RunConfig
from neuprim.config.overrides import parse, quote_override
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.task import TaskSpec
from neuprim.core.used_settings import build_settings
from neuprim.plugins.trading import traded
from neuprim.search.changed import value_of

__all__ = ["CENTRE", "COMBINED", "LENGTH", "Variant", "check_knobs", "in_turn", "merged", "singles"]

CENTRE, COMBINED = "centre", "combined"
"""In place of a knob's name: of the variant that turns none, and of those that turn several."""

LENGTH = "train.iterations"
"""The knob whose values are shares of the full length."""

_PARTS = {"model.primitives": (0.5, 2.0, 0.25, 4.0, 1 / 8, 1 / 16, 1 / 32, 1 / 64), LENGTH: (0.5, 0.25)}
"""Knobs of every task, as multiples of the centre's."""

_NAME = 80
"""Longest name of a folder."""


@dataclass(frozen=True)
class Variant:
    """A model to train.

    Attributes:
        knob: what it turns.
        turned: words over the centre's, none of them about the length.
        length: share of the full training.
    """

    knob: str
    turned: tuple[str, ...] = ()
    length: float = 1.0

    @property
    def name(self) -> str:
        """As people read it."""
        words = [word.removeprefix("model.") for word in self.turned]
        return " ".join([*words, *([f"{self.length:g} of the length"] if self.length != 1.0 else [])]) or CENTRE

    @property
    def folder(self) -> str:
        """A file-name-safe name; two variants of one set have different ones unless their words are longer than any
        that knobs make."""
        text = re.sub(r"[^A-Za-z0-9._+-]+", "-", "_".join(self.name.split(" "))).strip("._-")
        return text[:_NAME]


def merged(words: Sequence[str], over: Sequence[str]) -> list[str]:
    """Words with others over them, each setting once."""
    again = {assignment.key for assignment in parse(over)}
    return [*(a.text for a in parse(words) if a.key not in again), *over]


def singles(centre: RunConfig, task: TaskSpec) -> dict[str, list[Variant]]:
    """Knob -> its variants, those next to the centre first; without the centre's own values as far as its settings name
    them."""
    own = traded(task, build_settings(task, centre.model, centre.options))
    counts = dict.fromkeys(max(1, round(part * centre.model.primitives)) for part in _PARTS["model.primitives"])
    found: dict[str, list[Variant]] = {
        "model.primitives": [
            Variant("model.primitives", (quote_override("model.primitives", count),))
            for count in counts
            if count != centre.model.primitives
        ]
    }
    for knob, values in own.items():
        now = None if knob in centre.unused else value_of(centre, knob)
        ladder = [value for value in values if value != now]
        if now in values:
            place = values.index(now)
            ladder.sort(key=lambda value: abs(values.index(value) - place))
        found[knob] = [Variant(knob, (quote_override(knob, value),)) for value in ladder]
    found[LENGTH] = [Variant(LENGTH, length=part) for part in _PARTS[LENGTH]]
    return found


def check_knobs(names: Sequence[str], known: Mapping[str, object], task: str) -> None:
    """Raise :class:`ConfigError` for a name that is no knob of the task."""
    for name in names:
        if name not in known:
            raise ConfigError(f"--knobs {name}: no such knob of a model of task {task!r}{nearest(name, known)}")


def in_turn(ladders: Mapping[str, Sequence[Variant]]) -> Iterator[Variant]:
    """The first of every knob, then the second: so that short budgets turn as many knobs as they can."""
    for rung in zip_longest(*ladders.values()):
        yield from (variant for variant in rung if variant is not None)
