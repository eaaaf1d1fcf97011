"""Read the conditions of a task, such as time or light, from command-line text, and check their ranges.

Users write ``--NAME TEXT`` or ``--NAME=TEXT``, with ``-`` or ``_`` inside the name. A condition that is one number
accepts a number, a list ``A,B,C``, or a range ``FIRST:LAST`` or ``FIRST:LAST:COUNT``. Each value of the list or range
gives one frame. The task's :attr:`ConditionSpec.parse <neuprim.core.model.fields.ConditionSpec>` reads each number. For
any other condition, ``parse`` reads the whole text, such as ``x,y,z`` or ``orbit`` for a light.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.model.fields import ConditionSpec

FRAMES = 60
"""Number of frames of a range ``FIRST:LAST`` without ``COUNT``."""

_MOST = 100_000
_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_RANGE = re.compile(rf"({_NUMBER}):({_NUMBER})(?::([+-]?\d+))?")

Warn = Callable[[str], None]
"""Function that shows a warning, one line of text, to the user."""


def _ignore_condition_warning(text: str) -> None:
    pass


# ---------------------------------------------------------------- names


def condition_flag(name: str) -> str:
    """Return the command-line flag of a condition, such as ``"--light-intensity"`` for ``light_intensity``."""
    return "--" + name.replace("_", "-")


def named(word: str, specs: Sequence[ConditionSpec]) -> str | None:
    """Return the name of the condition that ``word`` means, written with ``-`` or ``_``; None if there is none."""
    return next((spec.name for spec in specs if spec.name.replace("-", "_") == word.replace("-", "_")), None)


def split_conditions(words: Sequence[str], specs: Sequence[ConditionSpec]) -> tuple[dict[str, str], list[str]]:
    """Split command-line arguments into condition name -> text, and a list of the other arguments."""
    found: dict[str, str] = {}
    rest: list[str] = []
    queue = list(words)
    while queue:
        word = queue.pop(0)
        key, equals, text = word.partition("=")
        name = named(key.removeprefix("--"), specs) if key.startswith("--") else None
        if name is None:
            rest.append(word)
            continue
        if not equals:
            if not queue or queue[0].startswith("--"):
                raise ConfigError(f"{word}: expected a value after it")
            text = queue.pop(0)
        if name in found:
            raise ConfigError(f"{condition_flag(name)}: given twice")
        found[name] = text
    return found, rest


# ---------------------------------------------------------------- frame numbers

_FRAME_RANGE = re.compile(r"(-?[0-9]{1,18})(?:-(-?[0-9]{1,18})(?:x([0-9]{1,18}))?)?")


def parse_frame_numbers(text: str) -> list[int]:
    """Return the frame numbers of ``--frame``: numbers and ranges FIRST-LAST or FIRST-LASTxSTEP, separated by commas.

    Raises:
        ConfigError: the text has another form, or gives more than 100,000 frames.
    """
    numbers: list[int] = []
    for part in text.split(","):
        found = _FRAME_RANGE.fullmatch(part.strip())
        first, last, step = (int(x) for x in (found[1], found[2] or found[1], found[3] or 1)) if found else (0, -1, 1)
        if last < first or step < 1 or len(numbers) + (last - first) // step >= _MOST:
            raise ConfigError(f"--frame {text}: expected numbers and ranges such as 1001-1048x2,1060")
        numbers += range(first, last + 1, step)
    return numbers


def source_frames(header: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return the numbers of the first and the last frame of the files from which a model was trained.

    These frames have the times 0 and 1. Returns None if the model's header names no numbered frames; raises DataError
    if the header is invalid.
    """
    facts = header.get("data")
    if not isinstance(facts, dict) or "frames" not in facts:
        return None
    first, last = JsonReader(facts, "the model's header: data").array("frames", (2,), "2 numbers").tolist()
    return int(first), int(last)


def frame_numbers(header: Mapping[str, Any], frames: Sequence[Mapping[str, Tensor]]) -> list[int]:
    """Return the numbers of the source files at the times of ``frames``.

    If a time lies between two files, if numbers repeat, or if ``header`` names no numbered files, return 0, 1, ...
    instead.
    """
    known = source_frames(header)
    if known is not None and all("time" in conditions for conditions in frames):
        exact = [known[0] + float(conditions["time"]) * (known[1] - known[0]) for conditions in frames]
        numbers = [round(x) for x in exact]
        if len(set(numbers)) == len(numbers) and all(abs(x - n) < 0.01 for x, n in zip(exact, numbers, strict=True)):
            return numbers
    return list(range(len(frames)))


def frames_to_times(
    text: str, conditions: Mapping[str, str], header: Mapping[str, Any]
) -> tuple[list[int], dict[str, str]]:
    """Return the frame numbers of ``--frame``, and the texts of ``conditions`` with the times of these frames.

    Args:
        text: the numbers, see :func:`parse_frame_numbers`.
        conditions: condition name -> text, as the user gave them.
        header: header of the model.

    Raises:
        ConfigError: the model has no frame with such a number, or ``conditions`` also has the condition "time".
    """
    numbers, known = parse_frame_numbers(text), source_frames(header)
    if known is None:
        raise ConfigError(f"--frame {text}: this model has no frame numbers; expected a model of .vdb files")
    if "time" in conditions:
        raise ConfigError("--frame and --time: give only one of these flags")
    first, last = known
    if min(numbers) < first or max(numbers) > last:
        raise ConfigError(f"--frame {text}: not in the sequence; expected frames from {first} to {last}")
    times = ",".join(repr((number - first) / max(last - first, 1)) for number in numbers)
    return numbers, {**conditions, "time": times}


def frame_interval(header: Mapping[str, Any], times: Iterable[float]) -> float | None:
    """Return the time between two frames, in units of the condition "time"; None if it is unknown.

    If all ``times`` are those of source frames, the result is the time between two source frames. Otherwise, e.g. in
    slow motion, it is the mean distance between neighbouring ``times``.

    Args:
        header: header of the model, which may name source frames.
        times: times of the frames that are rendered or exported.
    """
    frames, ordered = source_frames(header), sorted(set(times))
    if frames is not None and (gaps := frames[1] - frames[0]) > 0:
        if len(ordered) < 2 or all(abs(time * gaps - round(time * gaps)) < 0.01 for time in ordered):
            return 1 / gaps
    return (ordered[-1] - ordered[0]) / (len(ordered) - 1) if len(ordered) > 1 else None


# ---------------------------------------------------------------- values


def read_conditions(
    specs: Sequence[ConditionSpec], texts: Mapping[str, str], warn: Warn = _ignore_condition_warning
) -> dict[str, list[Tensor]]:
    """Parse the texts of conditions; return condition name -> values, one per frame, in the task's order.

    An animation such as ``0:1`` or ``orbit`` need not state its number of frames. Without this number, the animation
    gets as many frames as the other conditions.

    Args:
        texts: condition name -> text, for the conditions that the user gave.
        warn: called with a message for each condition outside its range. Strict conditions raise ConfigError instead.
    """
    given = [spec for spec in specs if spec.name in texts]
    said = {}
    for spec in given:
        found = _read_condition(spec, texts[spec.name], _ignore_condition_warning)
        if len(found) > 1 and _condition_with_frame_count(spec, texts[spec.name], len(found)) is None:
            said[spec.name] = len(found)
    count = max(said.values(), default=0)
    lengths = {
        spec.name: None
        if spec.name in said or not count
        else _condition_with_frame_count(spec, texts[spec.name], count)
        for spec in given
    }
    return {spec.name: _read_condition(spec, lengths[spec.name] or texts[spec.name], warn) for spec in given}


def check_file_condition(
    spec: ConditionSpec, where: str, numbers: Sequence[float], warn: Warn = _ignore_condition_warning
) -> list[Tensor]:
    """Return the numbers of a file as values of a condition, checked as :func:`read_conditions` checks typed numbers.

    Messages begin with ``where``, the file and its key. Raises ConfigError for numbers that the user could not type.
    """
    values = [torch.tensor(number) for number in numbers]
    for value in values:
        try:
            spec.parse(_format_condition_number(float(value)))
        except (NeuprimError, ValueError) as error:
            _check_condition_range(replace(spec, strict=True), where, [value], warn)
            raise ConfigError(f"{where}: {error}") from error
    _check_condition_range(spec, where, values, warn)
    return values


def count_condition_frames(texts: Mapping[str, str], found: Mapping[str, Sequence[Tensor]]) -> int:
    """Return the common number of frames of the conditions ``found``; a condition with one value is constant.

    Raises ConfigError if two conditions have different numbers of frames.
    """
    counts = {name: len(values) for name, values in found.items() if len(values) > 1}
    if len(set(counts.values())) > 1:
        each = " and ".join(
            f"{condition_flag(name)} {texts[name]} has {count} frames" for name, count in counts.items()
        )
        raise ConfigError(
            f"{each}; expected equal numbers of frames, or several frames in only one of these conditions"
        )
    return max(counts.values(), default=1)


def _condition_with_frame_count(spec: ConditionSpec, text: str, count: int) -> str | None:
    """Return the animation ``text`` with a number of frames added.

    Return None if the text already states a number of frames, or is no animation.
    """
    if spec.shape:
        return spec.in_frames(text, count)
    found = _RANGE.fullmatch(text.strip())
    return f"{text.strip()}:{count}" if found is not None and found[3] is None else None


def _read_condition(spec: ConditionSpec, text: str, warn: Warn) -> list[Tensor]:
    parts = [part.strip() for part in text.split(",")] if not spec.shape else [text]
    values: list[Tensor] = []
    for part in parts:
        values += _read_condition_number_or_range(spec, part)
        if len(values) > _MOST:  # before the next part takes more memory
            shown = f"{condition_flag(spec.name)} {text[:40]}..."
            raise ConfigError(f"{shown}: at least {len(values)} values; expected at most {_MOST}")
    _check_condition_range(spec, f"{condition_flag(spec.name)} {text}", values, warn)
    return values


def _read_condition_number_or_range(spec: ConditionSpec, text: str) -> list[Tensor]:
    """Read one number or range. If the task's ``parse`` refuses a range, this function expands the range."""
    try:
        return _condition_values_from_text(spec, text)
    except NeuprimError:
        found = None if spec.shape else _RANGE.fullmatch(text)
        if found is None:
            raise
        first, last = float(found[1]), float(found[2])
        try:
            ends = [
                value
                for end in (first, last)
                for value in _condition_values_from_text(spec, _format_condition_number(end))
            ]
        except NeuprimError:
            pass  # the task's message about the whole text says more than one about an end
        else:
            count = FRAMES if found[3] is None else int(found[3])
            if not 2 <= count <= _MOST:
                expected = f"FIRST:LAST or FIRST:LAST:COUNT, 2 to {_MOST} frames"
                raise ConfigError(f"{condition_flag(spec.name)} {text}: expected {expected}") from None
            dtype = ends[0].dtype if ends[0].is_floating_point() else torch.float64
            numbers = torch.linspace(first, last, count, dtype=dtype).tolist()
            return [value for x in numbers for value in _condition_values_from_text(spec, _format_condition_number(x))]
        raise


def _condition_values_from_text(spec: ConditionSpec, text: str) -> list[Tensor]:
    try:
        values = spec.parse(text)
    except ValueError as error:  # as float("x") raises it; the user typed the text
        raise ConfigError(
            f"{condition_flag(spec.name)} {text}: cannot be read ({' '.join(str(error).split())})"
        ) from error
    if not values:
        raise ConfigError(f"{condition_flag(spec.name)} {text}: contains no value; expected at least one")
    return list(values)


def _format_condition_number(number: float) -> str:
    """Format a number as a user would: whole numbers without a point, all other numbers exactly."""
    return repr(number).removesuffix(".0")


def _check_condition_range(spec: ConditionSpec, shown: str, values: Sequence[Tensor], warn: Warn) -> None:
    """Check a condition's values against the condition's range; messages begin with ``shown``.

    For values outside, call ``warn``, or raise ConfigError if the condition is strict. Values that are not finite
    always raise ConfigError. Bounds are rounded to the dtype of the values, so that float32 0.3 lies within 0 to 0.3.
    """
    low, high = spec.range
    for value in values:
        if not bool(torch.isfinite(value).all()):
            raise ConfigError(f"{shown}: {_first_where(value, ~torch.isfinite(value)):g}; expected finite numbers")
    for value in values:
        ends = torch.tensor([low, high], dtype=value.dtype if value.is_floating_point() else torch.float64)
        outside = (value < ends[0]) | (value > ends[1])
        if bool(outside.any()):
            line = f"{shown}: {_first_where(value, outside):g} is outside its range, {low:g} to {high:g} ({spec.unit})"
            if spec.strict:
                raise ConfigError(f"{line}; expected values in this range")
            warn(f"warning: {line}")
            return


def _first_where(value: Tensor, where: Tensor) -> float:
    return float(value[where].flatten()[0])


# ---------------------------------------------------------------- frames of an export


def conditions_per_frame(
    specs: Sequence[ConditionSpec], texts: Mapping[str, str], several: bool = False
) -> list[dict[str, Tensor]]:
    """Return condition name -> value for each frame.

    Raises ConfigError if a condition in ``specs`` has no text, or if there are several frames and ``several`` is False.
    """
    for spec in specs:
        if spec.name not in texts:
            what = f"{condition_flag(spec.name)}: required, as the model depends on it ({spec.unit})"
            raise ConfigError(f"{what}; for example {condition_flag(spec.name)} {_example_condition_text(spec)}")
    found = read_conditions(specs, texts)
    counts = {name: len(values) for name, values in found.items() if len(values) > 1}
    if counts and not several:
        name = next(iter(counts))
        raise ConfigError(f"{condition_flag(name)} {texts[name]}: {counts[name]} values; expected one value")
    frames = count_condition_frames(texts, found)
    return [{name: values[i if len(values) > 1 else 0] for name, values in found.items()} for i in range(frames)]


def _example_condition_text(spec: ConditionSpec) -> str:
    """Return an example text of a condition for messages; the value is within the condition's range."""
    low, high = spec.range
    usual = 1.0 if spec.shape else 0.5
    value = usual if low <= usual <= high else (low + high) / 2
    return ",".join([_format_condition_number(value)] * math.prod(spec.shape))
