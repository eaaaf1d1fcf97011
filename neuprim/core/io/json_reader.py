"""Read fields of JSON objects; errors name the file, the field, the value and what was expected."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuprim.core.errors import DataError, cut_error_text
from neuprim.core.io.plain import finite_json_number, load_json

_MISSING = object()


def _describe_json(value: Any) -> str:
    """A short description of a JSON value for messages."""
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "an object"
    return cut_error_text(json.dumps(value), 60)


@dataclass(frozen=True)
class JsonReader:
    """One JSON object and where it is."""

    values: dict[str, Any]
    where: str  # prefix of messages, e.g. "/data/transforms.json: frames[3]"

    @classmethod
    def open(cls, path: Path, max_bytes: float = math.inf) -> JsonReader:
        """Read the object of a file of camera poses; raises DataError for anything else."""
        try:
            if path.stat().st_size > max_bytes:
                raise DataError(f"{path}: {path.stat().st_size} bytes; expected at most {max_bytes:.0f}")
            value = load_json(path.read_text(encoding="utf-8-sig"), infinite=True)
        except FileNotFoundError:
            raise DataError(f"{path}: file not found; expected a JSON file of camera poses") from None
        except OSError as error:
            raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
        except (ValueError, RecursionError) as error:  # also bad UTF-8 and numbers of thousands of digits
            raise DataError(f"{path}: not valid JSON ({error})") from None
        if not isinstance(value, dict):
            raise DataError(f"{path}: top level is {_describe_json(value)}; expected an object")
        return cls(value, str(path))

    def has(self, key: str) -> bool:
        """Whether the field is there and not null."""
        return self.values.get(key) is not None

    def fail(self, key: str, expected: str) -> DataError:
        """The error for a field that is missing or wrong."""
        value = self.values.get(key, _MISSING)
        actual = "is missing" if value is _MISSING else f"is {_describe_json(value)}"
        return DataError(f"{self.where}: {key} {actual}; expected {expected}")

    def number(
        self, key: str, expected: str = "a finite number", low: float = -math.inf, high: float = math.inf
    ) -> float:
        """A finite number strictly between ``low`` and ``high``."""
        value = finite_json_number(self.values.get(key))
        if value is None or not low < value < high:
            raise self.fail(key, expected)
        return value

    def number_or(self, key: str, default: float, expected: str = "a finite number", low: float = -math.inf) -> float:
        """As :meth:`number`, or ``default`` if the field is absent or null."""
        return self.number(key, expected, low) if self.has(key) else default

    def count(self, key: str) -> int:
        """A positive whole number; exporters also write 800.0."""
        value = self.number(key, "a positive whole number", 0.0)
        if value != int(value):
            raise self.fail(key, "a positive whole number")
        return int(value)

    def text(self, key: str) -> str:
        """A text that is not empty."""
        value = self.values.get(key)
        if not isinstance(value, str) or not value or "\0" in value:
            raise self.fail(key, "a non-empty text")
        return value

    def texts(self, key: str) -> list[str]:
        """A list of texts that are not empty."""
        value = self.values.get(key)
        if not isinstance(value, list) or not all(isinstance(v, str) and v and "\0" not in v for v in value):
            raise self.fail(key, "a list of texts")
        return value

    def array(self, key: str, shape: tuple[int, ...], expected: str) -> Tensor:
        """(n,) or (rows, columns) float64 from nested lists of exactly that shape, all finite numbers."""

        def read(value: Any, shape: tuple[int, ...], place: str) -> Any:
            if not shape:
                number = finite_json_number(value)
                if number is None:
                    raise DataError(f"{self.where}: {key}{place} is {_describe_json(value)}; expected a finite number")
                return number
            if not isinstance(value, list) or len(value) != shape[0]:
                raise self.fail(key, expected)
            return [read(item, shape[1:], f"{place}[{i}]") for i, item in enumerate(value)]

        return torch.tensor(read(self.values.get(key), shape, ""), dtype=torch.float64)

    def matrix(self, key: str) -> Tensor:
        """(4, 4) float64 from 3 or 4 rows of 4 finite numbers; a fourth row must be 0 0 0 1."""
        rows = self.values.get(key)
        expected = "4 rows of 4 numbers"
        if not isinstance(rows, list) or len(rows) not in (3, 4):
            raise self.fail(key, expected)
        matrix = self.array(key, (len(rows), 4), expected)
        last = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)
        if len(rows) == 4 and (matrix[3] - last[0]).abs().max() > 1e-6:
            raise DataError(f"{self.where}: {key}[3] is {cut_error_text(str(rows[3]))}; expected 0 0 0 1")
        return torch.cat([matrix[:3], last])

    def objects(self, key: str) -> Iterator[JsonReader]:
        """Readers of the objects in a list that is not empty."""
        value = self.values.get(key)
        if not isinstance(value, list) or not value:
            raise self.fail(key, "a non-empty list of objects")
        for i, item in enumerate(value):
            if not isinstance(item, dict):
                raise DataError(f"{self.where}: {key}[{i}] is {_describe_json(item)}; expected an object")
            yield JsonReader(item, f"{self.where}: {key}[{i}]")
