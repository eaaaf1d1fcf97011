"""Settings beside the number of primitives that save bytes, in the order in which they are tried."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from neuprim.config import RunConfig
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.task import TaskSpec
from neuprim.core.used_settings import build_settings
from neuprim.plugins.trading import traded
from neuprim.search.changed import changed, value_of
from neuprim.search.target.record import Setting, Turn

__all__ = ["ladders", "next_turn", "pays"]

_WHOLE = ("model.sh_degree", "model.neurons")
"""Shared settings that may have any whole number between those that a task names."""

_WORTH = 0.97
"""Of the bytes that must be left for a turn to be worth it."""

_REFUSED = 2
"""Values of a setting that may turn out not to be worth it."""


def ladders(config: RunConfig, task: TaskSpec, dataset: Dataset) -> dict[str, tuple[Setting, ...]]:
    """Setting -> values with which a primitive has fewer numbers, the least first and the value of now last; that
    setting first on which most of a primitive's numbers hang."""
    whole = _numbers(config, task, dataset)
    made: dict[str, tuple[Setting, ...]] = {}
    least: dict[str, int] = {}
    for key, values in traded(task, build_settings(task, config.model, config.options)).items():
        now = value_of(config, key)
        if key in config.unused or now is None:
            continue
        offered = range(min(values), now) if key in _WHOLE else values
        sizes: dict[Setting, int] = {}
        for value in offered:
            try:
                sizes[value] = _numbers(changed(config, {key: value}), task, dataset)
            except ConfigError:  # not beside the other settings
                continue
        fewer = sorted((value for value in sizes if sizes[value] < whole), key=lambda value: sizes[value])
        if fewer:
            made[key], least[key] = (*fewer, now), sizes[fewer[0]]
    return dict(sorted(made.items(), key=lambda pair: least[pair[0]]))


def _numbers(config: RunConfig, task: TaskSpec, dataset: Dataset) -> int:
    """That the fields of a primitive have."""
    settings = build_settings(task, config.model, config.options)
    task.check(settings)
    return sum(spec.size for field in task.build(settings, dataset) for spec in field.parameters())


def next_turn(known: Mapping[str, Sequence[Setting]], turns: Sequence[Turn]) -> tuple[str, Setting, Setting] | None:
    """(setting, value now, value to try); None when all are through.

    A setting goes down by about half its ladder at a time while that pays; where it does not, the value between is
    tried once.
    """
    for key, ladder in known.items():
        own = [turn for turn in turns if turn.key == key]
        now = min((ladder.index(turn.after) for turn in own if turn.adopted), default=len(ladder) - 1)
        refused = [ladder.index(turn.after) for turn in own if not turn.adopted]
        after = now // 2 if not refused else (now + max(refused)) // 2
        if after < now and after not in refused and len(refused) < _REFUSED:
            return key, ladder[now], ladder[after]
    return None


def pays(loss: float, size: float, slope: float) -> bool:
    """Whether a model is smaller with a setting turned when primitives make up for the loss.

    Args:
        loss: dB at equal primitives; size: bytes of a primitive over those before.
        slope: dB that twice as many primitives gain.
    """
    return bool(size * 2 ** (max(loss, 0.0) / slope) < _WORTH)
