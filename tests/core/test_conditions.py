"""The grammar of conditions, and what is within their range."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from neuprim.core.conditions import (
    FRAMES,
    conditions_per_frame,
    count_condition_frames,
    frame_interval,
    read_conditions,
    split_conditions,
)
from neuprim.core.errors import ConfigError
from neuprim.core.light_conditions import light_orbit_in_frames, parse_light_positions
from neuprim.core.model.fields import ConditionSpec


def number(text: str) -> list[Tensor]:
    """What the documentation tells authors to write."""
    try:
        return [torch.tensor(float(text))]
    except ValueError:
        raise ConfigError(f"--wavelength-shift {text}: expected a number from 0 to 1") from None


def vector(text: str) -> list[Tensor]:
    values = [torch.tensor([float(x) for x in part.split(",")]) for part in text.split(";")]
    assert all(len(v) == 3 for v in values)
    return values


SHIFT = ConditionSpec("wavelength_shift", (), "of the spectrum", (0.0, 1.0), number)
SUN = ConditionSpec("sun", (3,), "m", (-2.0, 2.0), vector)
SPECS = (SHIFT, SUN)


def shifts(text: str, spec: ConditionSpec = SHIFT) -> list[float]:
    return [float(value) for value in read_conditions([spec], {spec.name: text})[spec.name]]


# ---------------------------------------------------------------- words


@pytest.mark.parametrize(
    "words",
    [
        ["--wavelength-shift", "0.3"],
        ["--wavelength_shift", "0.3"],
        ["--wavelength-shift=0.3"],
        ["--wavelength_shift=0.3"],
    ],
)
def test_every_spelling_is_the_same(words: list[str]) -> None:
    assert split_conditions(["a", *words, "b=1", "--c"], SPECS) == ({"wavelength_shift": "0.3"}, ["a", "b=1", "--c"])


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--sun"], "--sun: expected a value after it"),
        (["--sun", "--camera"], "--sun: expected a value after it"),
        (["--sun=1,1,1", "--sun=0,0,0"], "--sun: given twice"),
        (["--wavelength-shift=0", "--wavelength_shift=0"], "--wavelength-shift: given twice"),
    ],
)
def test_a_condition_is_given_once_with_a_value(words: list[str], text: str) -> None:
    with pytest.raises(ConfigError, match=text):
        split_conditions(words, SPECS)


# ---------------------------------------------------------------- texts


def test_one_number_a_list_a_range_and_any_mixture() -> None:
    assert shifts("0.25") == [0.25] and shifts("0.25, 1,0") == [0.25, 1.0, 0.0]
    assert shifts("0:1:5") == [0.0, 0.25, 0.5, 0.75, 1.0] and shifts("1:0:3") == [1.0, 0.5, 0.0]
    assert shifts("0:1") == pytest.approx([i / (FRAMES - 1) for i in range(FRAMES)], abs=1e-7)
    assert shifts("0:0.5:2,1,.5:1e0:2") == [0.0, 0.5, 1.0, 0.5, 1.0]


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("x", "--wavelength-shift x: expected a number from 0 to 1"),
        ("0,x", "--wavelength-shift x: expected a number"),
        ("0:x", "--wavelength-shift 0:x: expected a number"),
        ("0:1:1", r"--wavelength-shift 0:1:1: expected FIRST:LAST or FIRST:LAST:COUNT, 2 to 100000"),
        ("0:1:100001", "expected FIRST:LAST or FIRST:LAST:COUNT"),
        ("0:1:2.5", "--wavelength-shift 0:1:2.5: expected a number"),
        ("", "--wavelength-shift : expected a number"),
        ("0:1:60000,0:1:60000", "at least 120000 values; expected at most 100000"),
    ],
)
def test_what_cannot_be_read(text: str, expected: str) -> None:
    with pytest.raises(ConfigError, match=expected):
        shifts(text)


# ---------------------------------------------------------------- ranges


def warnings(texts: dict[str, str], specs: Sequence[ConditionSpec] = SPECS) -> list[str]:
    said: list[str] = []
    read_conditions(specs, texts, said.append)
    return said


def test_beyond_the_range_there_is_one_warning_per_condition() -> None:
    assert warnings({"wavelength_shift": "0:1", "sun": "2,-2,0"}) == []
    assert warnings({"wavelength_shift": "0,5,7", "sun": "0,0,-2.5"}) == [
        "warning: --wavelength-shift 0,5,7: 5 is outside its range, 0 to 1 (of the spectrum)",
        "warning: --sun 0,0,-2.5: -2.5 is outside its range, -2 to 2 (m)",
    ]


def test_a_strict_task_has_it_refused() -> None:
    strict = replace(SHIFT, strict=True)
    with pytest.raises(
        ConfigError, match=r"^--wavelength-shift 7: 7 is outside its range, 0 to 1 \(of the spectrum\); expected values"
    ):
        shifts("7", strict)
    with pytest.raises(ConfigError, match="--wavelength-shift 0:2:3: 2 is outside"):
        shifts("0:2:3", strict)
    assert shifts("0:1:2", strict) == [0.0, 1.0]


@pytest.mark.parametrize("text", ["nan", "inf", "-inf", "0,nan"])
def test_numbers_that_are_not_finite_are_always_refused(text: str) -> None:
    endless = replace(SHIFT, range=(-math.inf, math.inf))
    with pytest.raises(ConfigError, match="expected finite numbers"):
        shifts(text, endless)
    assert shifts("1e30", endless) == [pytest.approx(1e30)]


# ---------------------------------------------------------------- frames of an export


def test_an_export_has_every_condition_in_each_frame() -> None:
    frames = conditions_per_frame(SPECS, {"sun": "1,2,0", "wavelength_shift": "0,1"}, several=True)
    assert [(float(f["wavelength_shift"]), f["sun"].tolist()) for f in frames] == [(0.0, [1, 2, 0]), (1.0, [1, 2, 0])]
    assert conditions_per_frame((), {}) == [{}]
    for texts, several, expected in (
        ({"wavelength_shift": "0,1", "sun": "0,0,0"}, False, "--wavelength-shift 0,1: 2 values; expected one value"),
        (
            {"wavelength_shift": "0:1:3", "sun": "1,2,0;0,0,0"},
            True,
            "3 frames and --sun 1,2,0;0,0,0 has 2 frames; expected equal numbers of frames",
        ),
        (
            {"wavelength_shift": "0"},
            True,
            r"--sun: required, as the model depends on it \(m\); for example --sun 1,1,1",
        ),
    ):
        with pytest.raises(ConfigError, match=expected):
            conditions_per_frame(SPECS, texts, several)


@pytest.mark.parametrize(
    ("times", "interval"),
    [
        ([0.3], 0.1),
        ([0.0, 0.2, 0.4], 0.1),  # every second source frame
        ([0.4, 0.425, 0.45], 0.025),  # slow motion
        ([0.4, 0.402, 0.404], 0.002),
    ],
)
def test_in_slow_motion_frames_are_closer_than_those_of_the_source(times: list[float], interval: float) -> None:
    assert frame_interval({"data": {"frames": [11, 21]}}, times) == pytest.approx(interval)
    assert frame_interval({}, times) == (pytest.approx(times[1] - times[0]) if len(times) > 1 else None)


# ---------------------------------------------------------------- two animations at once


TIME = ConditionSpec("time", (), "s", (0.0, 1.0), number)
LIGHT = ConditionSpec("light", (3,), "scene units", (-1e6, 1e6), parse_light_positions, in_frames=light_orbit_in_frames)


def lengths(time: str, light: str) -> tuple[int, int]:
    found = read_conditions([TIME, LIGHT], {"time": time, "light": light})
    return len(found["time"]), len(found["light"])


@pytest.mark.parametrize(
    ("time", "light", "count"),
    [
        ("0:1:48", "orbit", 48),
        ("0:1:48", "orbit:3", 48),
        ("0:1", "orbit:3:30:24", 24),
        ("0:1", "orbit", FRAMES),
        ("0:1:24", "orbit:3:30:24", 24),
        ("0.1,0.5,0.9", "orbit", 3),
        ("0:0.5, 1", "orbit:3:30:61", 61),
    ],
)
def test_an_animation_without_a_length_takes_the_others(time: str, light: str, count: int) -> None:
    assert lengths(time, light) == (count, count)
    found = read_conditions([TIME, LIGHT], {"time": time, "light": light})
    assert count_condition_frames({}, found) == count
    assert float(found["time"][0]) == pytest.approx(float(time.replace(":", ",").split(",")[0]))
    assert len({tuple(place.tolist()) for place in found["light"]}) == count, "once round, no place twice"
