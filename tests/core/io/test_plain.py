"""Text of files as plain data: numbers that a computer holds, and nothing that describes more than it says."""

from __future__ import annotations

import time
from pathlib import Path

import pytest
import yaml

from neuprim.core.checkpoint import read_header, write_tensors
from neuprim.core.errors import CheckpointError, cut_error_text, one_line
from neuprim.core.io.json_reader import JsonReader, finite_json_number, load_json, parse_yaml_file

HUGE = ["1e400", "-1e999", "NaN", "Infinity", "9" * 400, "9" * 100_000, "-" + "1" * 30, str(2**64)]


@pytest.mark.parametrize("number", HUGE)
def test_numbers_beyond_the_limits_are_refused_in_a_short_line(number: str) -> None:
    with pytest.raises(ValueError) as refused:
        load_json(f'{{"a": [{number}]}}')
    assert len(str(refused.value)) < 150


def test_numbers_within_them_are_as_they_were() -> None:
    assert load_json("[1, -2.5, 1e300, 18446744073709551615, true, null]") == [1, -2.5, 1e300, 2**64 - 1, True, None]
    found = parse_yaml_file("a: [1, 0x10, 1_000, 1.5e+3, 1:30, .inf, yes, 2**3]")
    assert found["a"] == [1, 16, 1000, 1500.0, 90, float("inf"), True, "2**3"]


@pytest.mark.parametrize("value", [True, "1", [1], None, float("nan"), float("inf"), 10**400])
def test_what_is_no_finite_number(value: object) -> None:
    assert finite_json_number(value) is None


@pytest.mark.parametrize(
    "text",
    ["a: &x 1", "a: &x [1]\nb: *x", "a: *x", "? &k a\n: 1", f"a: {'9' * 400}", "a: " + ":".join(["59"] * 100_000),
     "a: !!int abc", "a: !!python/object:os.system {}"],
)  # fmt: skip
def test_yaml_with_references_huge_numbers_or_code_is_refused_at_once(text: str) -> None:
    begun = time.perf_counter()
    with pytest.raises((yaml.YAMLError, ValueError)):
        parse_yaml_file(text)
    assert time.perf_counter() - begun < 1.5


@pytest.mark.parametrize("key", ["elapsed", "iterations", "train_seconds", "background"])
@pytest.mark.parametrize("value", ["many", -1, True, [[1.0]], ["x" * 10**5]])
def test_a_header_with_anything_but_numbers_is_one_line(tmp_path: Path, key: str, value: object) -> None:
    write_tensors(tmp_path / "m.safetensors", "model", {}, {key: value})
    with pytest.raises(CheckpointError, match=rf"m\.safetensors: {key} is .*; expected") as refused:
        read_header(tmp_path / "m.safetensors", "model")
    assert len(str(refused.value)) < 300


def test_messages_are_short() -> None:
    assert cut_error_text("x" * 80) == "x" * 80 and cut_error_text("x" * 10**6) == "x" * 77 + "..."
    assert len(str(JsonReader({"a": "x" * 10**6}, "f").fail("a", "a number"))) < 150
    message = one_line(CheckpointError("f: key is " + "x" * 10**6 + "; expected a number")) or ""
    assert len(message) < 1600 and message.startswith("f: key is x") and message.endswith("; expected a number")
