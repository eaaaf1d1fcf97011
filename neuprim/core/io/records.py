"""JSON files read with their place in mind: every wrong value is reported with file, field, found and expected."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuprim.core.errors import DataError, cut
from neuprim.core.io.plain import finite

__all__ = ["Record", "read_json"]

_MISSING = object()


def _found(value: Any) -> str:
    """A short description of a JSON value for error messages."""
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "an object"
    return cut(json.dumps(value), 60)


@dataclass(frozen=True)
class Record:
    """One JSON object and where it is.

    Attributes:
        values: the object's fields.
        where: prefix of messages, e.g. ``"/data/transforms.json: frames[3]"``.
    """

    values: dict[str, Any]
    where: str

    def has(self, key: str) -> bool:
        return self.values.get(key) is not None

    def fail(self, key: str, expected: str) -> DataError:
        """The error for a field that is missing or wrong."""
        value = self.values.get(key, _MISSING)
        found = "is missing" if value is _MISSING else f"is {_found(value)}"
        return DataError(f"{self.where}: {key} {found}; expected {expected}")

    def number(
        self, key: str, expected: str = "a finite number", low: float = -math.inf, high: float = math.inf
    ) -> float:
        """A finite number strictly between ``low`` and ``high``."""
        value = finite(self.values.get(key))
        if value is None or not low < value < high:
            raise self.fail(key, expected)
        return value

    def number_or(self, key: str, default: float, expected: str = "a finite number", low: float = -math.inf) -> float:
        """As :meth:`number`, or ``default`` where the field is absent or null."""
        return self.number(key, expected, low) if self.has(key) else default

    def count(self, key: str) -> int:
        """A positive whole number; exporters also write 800.0."""
        value = self.number(key, "a positive whole number", 0.0)
        if value != int(value):
            raise self.fail(key, "a positive whole number")
        return int(value)

    def text(self, key: str) -> str:
        value = self.values.get(key)
        if not isinstance(value, str) or not value or "\0" in value:
            raise self.fail(key, "a non-empty text")
        return value

    def texts(self, key: str) -> list[str]:
        value = self.values.get(key)
        if not isinstance(value, list) or not all(isinstance(v, str) and v and "\0" not in v for v in value):
            raise self.fail(key, "a list of texts")
        return value

    def matrix(self, key: str) -> Tensor:
        """(4, 4) float64 from 3 or 4 rows of 4 finite numbers; a fourth row must be 0 0 0 1."""
        rows = self.values.get(key)
        if (
            not isinstance(rows, list)
            or len(rows) not in (3, 4)
            or not all(isinstance(r, list) and len(r) == 4 for r in rows)
        ):
            raise self.fail(key, "4 rows of 4 numbers")
        numbers = [[finite(v) for v in row] for row in rows]
        for i, row in enumerate(numbers):
            for j, number in enumerate(row):
                if number is None:
                    raise DataError(f"{self.where}: {key}[{i}][{j}] is {_found(rows[i][j])}; expected a finite number")
        if (
            len(numbers) == 4
            and max(abs(float(a or 0.0) - b) for a, b in zip(numbers[3], (0, 0, 0, 1), strict=True)) > 1e-6
        ):
            raise DataError(f"{self.where}: {key}[3] is {cut(str(rows[3]))}; expected 0 0 0 1")
        return torch.tensor([*numbers[:3], [0.0, 0.0, 0.0, 1.0]], dtype=torch.float64)

    def array(self, key: str, shape: tuple[int, ...], expected: str) -> Tensor:
        """(n,) or (rows, columns) float64 of nested lists of exactly that shape, all finite numbers."""

        def read(value: Any, shape: tuple[int, ...], place: str) -> Any:
            if not shape:
                number = finite(value)
                if number is None:
                    raise DataError(f"{self.where}: {key}{place} is {_found(value)}; expected a finite number")
                return number
            if not isinstance(value, list) or len(value) != shape[0]:
                raise self.fail(key, expected)
            return [read(item, shape[1:], f"{place}[{i}]") for i, item in enumerate(value)]

        return torch.tensor(read(self.values.get(key), shape, ""), dtype=torch.float64)

    def objects(self, key: str) -> Iterator[Record]:
        """The records of a non-empty list of objects."""
        value = self.values.get(key)
        if not isinstance(value, list) or not value:
            raise self.fail(key, "a non-empty list of objects")
        for i, item in enumerate(value):
            if not isinstance(item, dict):
                raise DataError(f"{self.where}: {key}[{i}] is {_found(item)}; expected an object")
            yield Record(item, f"{self.where}: {key}[{i}]")


def read_json(path: Path, most: float = math.inf) -> Record:
    """The JSON object in a file.

    Args:
        most: bytes, beyond which a file is not read.

    Raises:
        DataError: missing, unreadable or larger file, not UTF-8, not JSON, or not an object at top level.
    """
    try:
        if path.stat().st_size > most:
            raise DataError(f"{path}: {path.stat().st_size} bytes; expected at most {most:.0f}")
        value = json.loads(path.read_text(encoding="utf-8-sig"))
    except FileNotFoundError:
        raise DataError(f"{path}: file not found; expected a JSON file of camera poses") from None
    except OSError as error:
        raise DataError(f"{path}: cannot be read ({error.strerror or error})") from None
    except (ValueError, RecursionError) as error:  # also bad UTF-8 and numbers of thousands of digits
        raise DataError(f"{path}: not valid JSON ({error})") from None
    if not isinstance(value, dict):
        raise DataError(f"{path}: top level is {_found(value)}; expected an object")
    return Record(value, str(path))
