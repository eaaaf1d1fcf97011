"""How long each model of the set trains, so that the whole fits the budget: all of them equally long in seconds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from neuprim.config import RunConfig
from neuprim.config.overrides import parse, quote_override
from neuprim.core.errors import ConfigError
from neuprim.search.design.variants import LENGTH, Variant, merged

__all__ = ["Plan", "planned"]

_LEAST = 20
"""The centre trains for at least this part of the steps that its words or preset say."""

_FEW = 100
"""The same in steps, where the budget is in seconds."""


@dataclass(frozen=True)
class Plan:
    """The lengths, as they were chosen once; a set that goes on keeps them.

    Attributes:
        steps: of the centre.
        seconds: that these take, about; all variants of the full length train as long.
        whole: steps that the centre's words or preset say; 0 where they say seconds.
        paces: name of a variant -> seconds per step over the centre's.
    """

    steps: int
    seconds: float
    whole: int
    paces: Mapping[str, float]

    def steps_of(self, variant: Variant) -> int:
        """Of a variant whose pace is known."""
        return max(1, round(self.steps * variant.length / self.paces[variant.name]))

    def words_of(self, variant: Variant, words: Sequence[str], centre: RunConfig) -> list[str]:
        """What trains a variant, after ``neuprim run``.

        Interventions into the population come as often in a run as they would in one of the length that the preset
        says.
        """
        steps = self.steps_of(variant)
        said = {assignment.key for assignment in parse(words)}
        budget = [quote_override(LENGTH, steps)]
        if centre.train.max_seconds is not None:
            budget.append("train.max_seconds=null")
        every = "train.population.every"
        scaled = (
            max(1, round(centre.train.population.every * steps / self.whole))
            if self.whole
            else centre.train.population.every
        )
        if every not in said and scaled != centre.train.population.every:
            budget.append(quote_override(every, scaled))
        return merged(words, [*variant.turned, *budget])

    def knowing(self, variant: Variant, pace: float) -> Plan:
        """The same with the pace of one more variant."""
        return replace(self, paces={**self.paces, variant.name: pace})

    def to_dict(self) -> dict[str, Any]:
        """JSON-able."""
        return {"steps": self.steps, "seconds": self.seconds, "whole": self.whole, "paces": dict(self.paces)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Plan:
        """What :meth:`to_dict` gave; KeyError, TypeError, AttributeError or ValueError for anything else."""
        paces = {str(name): float(pace) for name, pace in data["paces"].items()}
        plan = cls(int(data["steps"]), float(data["seconds"]), int(data["whole"]), paces)
        if plan.steps < 1 or not all(pace > 0 for pace in paces.values()):
            raise ValueError("steps and paces must be above 0")
        return plan


def planned(centre: RunConfig, pace: float, available: float, lengths: Sequence[float], starting: float) -> Plan:
    """Steps of the centre with which trainings of these lengths take the seconds that there are, but no more steps than
    its words or preset say, and not much less than a tenth of them: of a budget that is too small for that, variants
    are left out.

    Args:
        pace: seconds per step of the centre.
        available: seconds for all trainings.
        lengths: of the variants, as shares of the full length.
        starting: seconds that each takes before its first step.
    """
    if not lengths:
        raise ConfigError("nothing to train; expected the centre at least")
    if centre.train.iterations is None:
        assert centre.train.max_seconds is not None, "a configuration has a budget"
        most, least, whole = centre.train.max_seconds / pace, _FEW, 0
    else:
        most = whole = centre.train.iterations
        least = max(1, whole // _LEAST)
    fits = (available - starting * len(lengths)) / sum(lengths) / pace
    steps = max(1, int(min(most, max(fits, least))))
    return Plan(steps, steps * pace, whole, {Variant("").name: 1.0})
