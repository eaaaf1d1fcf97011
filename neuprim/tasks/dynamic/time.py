"""What a user may write after ``--time``."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from neuprim.core.conditions import FRAMES
from neuprim.core.errors import ConfigError

__all__ = ["parse_times"]


def parse_times(text: str) -> list[Tensor]:
    """Times xi in 0..1, each a 0-dim float32 tensor: "0.5" is one, "0:1" sixty from 0 to 1, "0:1:100" a hundred.

    Raises:
        ConfigError: no such form, times outside 0..1, or a count below 2.
    """
    expected = "expected a time in 0..1, as 0.5, or FIRST:LAST or FIRST:LAST:COUNT, as 0:1:100"
    parts = text.split(":")
    try:
        times = [float(part) for part in parts[:2]]
        count = int(parts[2]) if len(parts) == 3 else FRAMES
    except ValueError:
        raise ConfigError(f"--time {text}: {expected}") from None
    if len(parts) > 3 or not all(math.isfinite(t) and 0.0 <= t <= 1.0 for t in times) or not 2 <= count <= 100_000:
        raise ConfigError(f"--time {text}: {expected}")
    if len(times) == 1:
        return [torch.tensor(times[0])]
    return list(torch.linspace(times[0], times[1], count))
