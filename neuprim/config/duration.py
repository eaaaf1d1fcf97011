"""A time in words: 90s, 10m, 1h."""

from __future__ import annotations

import re

from neuprim.core.errors import ConfigError

__all__ = ["seconds_of"]

_UNITS = {"s": 1.0, "m": 60.0, "h": 3600.0}


def seconds_of(text: str, asked: str) -> float:
    """Seconds of a time such as 90s, 5m or 1h.

    Args:
        asked: what the user typed, for the message.

    Raises:
        ConfigError: it is something else.
    """
    match = re.fullmatch(r"(\d+(?:\.\d+)?)([smh])", text)
    if match is None or float(match[1]) == 0:
        raise ConfigError(f"{asked}: expected a time such as 90s, 5m or 1h")
    return float(match[1]) * _UNITS[match[2]]
