"""Settings beside the number of primitives that save bytes, in the order in which they are tried."""

from __future__ import annotations

from collections.abc import Sequence

from neuprim.config import RunConfig
from neuprim.runs.target.record import Turn

__all__ = ["next_turn", "pays"]

_LADDERS: tuple[tuple[str, int], ...] = (("model.sh_degree", 0), ("model.neurons", 1))
"""Setting and its least value, the one first that most of a primitive's numbers hang on."""

_WORTH = 0.97
"""Of the bytes that must be left for a turn to be worth it."""


def next_turn(config: RunConfig, turns: Sequence[Turn]) -> tuple[str, int, int] | None:
    """(setting, value now, value to try); None when all are through.

    A setting goes down by about half at a time while that pays; where it does not, the value between is tried once.
    """
    for key, least in _LADDERS:
        if key in config.unused:
            continue
        group, _, name = key.partition(".")
        start = int(getattr(getattr(config, group), name))
        own = [turn for turn in turns if turn.key == key]
        now = min((turn.after for turn in own if turn.adopted), default=start)
        refused = [turn.after for turn in own if not turn.adopted]
        after = now // 2 if not refused else (now + max(refused)) // 2
        if now > least and least <= after < now and after not in refused and len(refused) < 2:
            return key, now, after
    return None


def pays(loss: float, size: float, slope: float) -> bool:
    """Whether a model is smaller with a setting turned when primitives make up for the loss.

    Args:
        loss: dB at equal primitives; size: bytes of a primitive over those before.
        slope: dB that twice as many primitives gain.
    """
    return bool(size * 2 ** (max(loss, 0.0) / slope) < _WORTH)
