"""Which frames are looked at, on which grid, and the scale that all of them share."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from neuprim.core.conditions import Warn, flag, read_conditions
from neuprim.core.errors import ConfigError, DataError
from neuprim.core.model.fields import Conditions, ConditionSpec
from neuprim.core.model.primitives import Primitives
from neuprim.inspect.field import FieldFrame

__all__ = ["Given", "box_of", "condition_frames", "corners", "in_words", "round_up"]

_OUTSIDE = 0.002  # part of all that is absorbed which may lie outside a box, at each of its faces


class Given(dict[str, Tensor]):
    """Conditions of a frame; one that is asked for and was not given is the user's to give."""

    def __missing__(self, name: str) -> Tensor:
        raise ConfigError(f"this needs the {name}; give {flag(name)}")


def condition_frames(
    specs: Sequence[ConditionSpec], texts: Mapping[str, str], warn: Warn = lambda text: None
) -> list[Conditions]:
    """One entry per frame. A number may be several, as "0:1:5" or "0,0.5"; the middle of its range where it is not
    given.

    Of two animated conditions the shorter is stretched. What is not a number and was not given is left out.

    Raises:
        ConfigError: as :func:`neuprim.core.conditions.read_conditions`.
    """
    given = read_conditions(specs, texts, warn)
    found: dict[str, list[Tensor]] = {}
    for spec in specs:
        if spec.name in given:
            found[spec.name] = given[spec.name]
        elif not spec.shape and all(map(math.isfinite, spec.range)):
            found[spec.name] = [torch.tensor(sum(spec.range) / 2)]
    count = max((len(values) for values in found.values()), default=1)
    return [Given({name: values[i * len(values) // count] for name, values in found.items()}) for i in range(count)]


def in_words(conditions: Conditions) -> str:
    """For example "time 0.5"."""
    parts = []
    for name, value in conditions.items():
        numbers = [f"{x:.3g}" for x in value.flatten().tolist()]
        parts.append(f"{name} {numbers[0] if len(numbers) == 1 else '(' + ', '.join(numbers[:4]) + ')'}")
    return ", ".join(parts)


def corners(numbers: Sequence[float]) -> np.ndarray:
    """(2, 3) box of ``--box``.

    Raises:
        ConfigError: not six numbers, or a box without a volume.
    """
    if len(numbers) != 6 or not all(a < b for a, b in zip(numbers[:3], numbers[3:], strict=True)):
        raise ConfigError(
            f"--box {','.join(f'{x:g}' for x in numbers)}: expected the lower and the upper corner, as -1,-1,-1,1,1,1"
        )
    return np.array(numbers, np.float64).reshape(2, 3)


def box_of(model: Primitives, frames: Sequence[Conditions]) -> np.ndarray:
    """(2, 3) float64 box around nearly all that the model absorbs in some of the frames; a few far primitives do not
    widen it.

    Raises:
        DataError: the model absorbs nothing.
    """
    lows, highs = [], []
    for conditions in frames[:: max(1, len(frames) // 5)]:
        frame = FieldFrame(model, conditions, "", torch.eye(4, dtype=torch.float64), (1, 1, 1), 1.0, 1.0)
        geometry, weights = frame.geometry, np.nan_to_num(frame.masses, posinf=0.0)
        if not weights.sum() > 0:
            continue
        reach = (geometry.rotations * geometry.scales[:, None, :]).norm(dim=2).double().numpy()
        means = geometry.means.double().numpy()
        lows.append([_quantile(means[:, a] - reach[:, a], weights, _OUTSIDE) for a in range(3)])
        highs.append([_quantile(means[:, a] + reach[:, a], weights, 1 - _OUTSIDE) for a in range(3)])
    if not lows:
        raise DataError("the model absorbs nothing in any of these frames; there is nothing to look at")
    return np.stack([np.min(lows, 0), np.max(highs, 0)])


def _quantile(values: np.ndarray, weights: np.ndarray, part: float) -> float:
    order = values.argsort()
    total = weights[order].cumsum()
    return float(values[order[min(int(np.searchsorted(total, part * total[-1])), len(order) - 1)]])


def round_up(value: float) -> float:
    """The next number of two digits, for the end of a scale; 1 for 0."""
    if not value > 0:
        return 1.0
    unit = 10.0 ** (math.floor(math.log10(value)) - 1)
    return float(f"{math.ceil(value / unit - 1e-9) * unit:.6g}")
