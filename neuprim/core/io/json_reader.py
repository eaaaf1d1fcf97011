"""Read untrusted JSON, YAML and npz files as plain data, and check the fields of JSON objects.

Errors name the file, the field, the value and what was expected. Numbers must be finite, integers must fit in 64 bits,
and YAML anchors are refused: a few lines with anchors can describe more data than fits in memory. Arrays are checked
before memory is allocated. Nothing is executed or looked up.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any

import torch
import yaml
from torch import Tensor

from neuprim.core.errors import DataError, cut_error_text

if TYPE_CHECKING:
    import numpy as np

_MISSING = object()


def _describe_json(value: Any) -> str:
    """Return a short description of a JSON value for error messages."""
    if isinstance(value, list):
        return f"a list of {len(value)}"
    if isinstance(value, dict):
        return "an object"
    return cut_error_text(json.dumps(value), 60)


@dataclass(frozen=True)
class JsonReader:
    """Reads the fields of one JSON object; the methods raise DataError for a wrong type or range."""

    values: dict[str, Any]
    where: str  # prefix of messages, e.g. "/data/transforms.json: frames[3]"

    @classmethod
    def open(cls, path: Path, max_bytes: float = math.inf) -> JsonReader:
        """Open a JSON file of camera poses that holds one object; raises DataError for any other content."""
        try:
            if path.stat().st_size > max_bytes:
                raise DataError(f"{path}: the file has {path.stat().st_size} bytes; expected at most {max_bytes:.0f}")
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
        """Return whether the object has the field ``key`` and its value is not null."""
        return self.values.get(key) is not None

    def fail(self, key: str, expected: str) -> DataError:
        """Return (do not raise) the DataError for a field that is missing or wrong."""
        value = self.values.get(key, _MISSING)
        actual = "is missing" if value is _MISSING else f"is {_describe_json(value)}"
        return DataError(f"{self.where}: {key} {actual}; expected {expected}")

    def number(
        self, key: str, expected: str = "a finite number", low: float = -math.inf, high: float = math.inf
    ) -> float:
        """Return the finite number in field ``key``, above ``low`` and below ``high``; else raise DataError."""
        value = finite_json_number(self.values.get(key))
        if value is None or not low < value < high:
            raise self.fail(key, expected)
        return value

    def number_or(self, key: str, default: float, expected: str = "a finite number", low: float = -math.inf) -> float:
        """Return the number as :meth:`number` does, or ``default`` if the field is missing or null."""
        return self.number(key, expected, low) if self.has(key) else default

    def count(self, key: str) -> int:
        """Return a field that is a positive integer. A float such as 800.0 is accepted, as some exporters write it."""
        value = self.number(key, "a positive whole number", 0.0)
        if value != int(value):
            raise self.fail(key, "a positive whole number")
        return int(value)

    def text(self, key: str) -> str:
        """Return a field that is a non-empty string."""
        value = self.values.get(key)
        if not isinstance(value, str) or not value or "\0" in value:
            raise self.fail(key, "a non-empty text")
        return value

    def texts(self, key: str) -> list[str]:
        """Return a field that is a list of non-empty strings."""
        value = self.values.get(key)
        if not isinstance(value, list) or not all(isinstance(v, str) and v and "\0" not in v for v in value):
            raise self.fail(key, "a list of texts")
        return value

    def array(self, key: str, shape: tuple[int, ...], expected: str) -> Tensor:
        """Return a field of nested lists of finite numbers as float64 of ``shape``, (n,) or (rows, columns)."""

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
        """Return a field of 3 or 4 rows of 4 finite numbers as (4, 4) float64; a fourth row must be 0 0 0 1."""
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
        """Yield a reader for each object of a field that is a non-empty list of objects."""
        value = self.values.get(key)
        if not isinstance(value, list) or not value:
            raise self.fail(key, "a non-empty list of objects")
        for i, item in enumerate(value):
            if not isinstance(item, dict):
                raise DataError(f"{self.where}: {key}[{i}] is {_describe_json(item)}; expected an object")
            yield JsonReader(item, f"{self.where}: {key}[{i}]")


_MAX_DIGITS = 20  # digits of a whole number of 64 bits


def finite_json_number(value: object) -> float | None:
    """Return a parsed JSON value as a float; None for all but finite numbers: text, true, a list, NaN, 1e400."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def load_json(text: str | bytes, infinite: bool = False) -> Any:
    """Parse JSON text. NaN and infinity are errors unless ``infinite``. Raises ValueError or RecursionError."""
    parse_float = float if infinite else _parse_json_float
    parse_constant = float if infinite else _refuse_json_constant
    return json.loads(text, parse_int=_parse_json_int, parse_float=parse_float, parse_constant=parse_constant)


def parse_yaml_file(text: str) -> Any:
    """Parse YAML text with the limits of this module; raises yaml.YAMLError, ValueError or RecursionError."""
    loader = _PlainYamlLoader(text)
    try:
        return loader.get_single_data()
    finally:
        loader.dispose()


def _parse_json_int(text: str) -> int:
    if len(text.lstrip("-")) > _MAX_DIGITS or not -(2**63) <= int(text) < 2**64:
        raise ValueError(f"{cut_error_text(text)} has more than 64 bits")
    return int(text)


def _parse_json_float(text: str) -> float:
    value = float(text)
    if math.isinf(value):
        raise ValueError(f"{cut_error_text(text)} is too large for a 64-bit float")
    return value


def _refuse_json_constant(text: str) -> float:
    raise ValueError(f"{text} is no finite number")


class _PlainYamlLoader(yaml.SafeLoader):
    """``yaml.SafeLoader`` that refuses anchors and enforces the number limits of this module."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()
        if getattr(event, "anchor", None) is not None:  # also an alias
            raise yaml.composer.ComposerError(None, None, "anchors and aliases are not read", event.start_mark)
        return super().compose_node(parent, index)

    def number(self, node: Any) -> Any:
        kind = node.tag.rpartition(":")[2]
        construct = self.construct_yaml_int if kind == "int" else self.construct_yaml_float
        try:
            value = None if len(node.value) > 4 * _MAX_DIGITS else construct(node)
        except (ValueError, OverflowError):
            value = None
        if value is None or (kind == "int" and not -(2**63) <= value < 2**64):
            raise yaml.constructor.ConstructorError(
                None, None, f"{cut_error_text(node.value)} is too large for a 64-bit number", node.start_mark
            )
        return value


for _kind in ("int", "float"):
    _PlainYamlLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", _PlainYamlLoader.number)


ArrayType = tuple[Any, tuple[int | None, ...]]  # dtype and shape; None for any length


def read_npz_arrays(path: Path, wanted: Mapping[str, ArrayType]) -> dict[str, np.ndarray]:
    """Read arrays of an uncompressed ``numpy.savez`` file; ``wanted`` maps names to (dtype, shape).

    Raises DataError for a damaged file, or a missing or different array, before memory is allocated for that array.
    """
    damaged = (OSError, ValueError, KeyError, EOFError, RuntimeError, SyntaxError, TokenError, zipfile.BadZipFile)
    try:
        size = path.stat().st_size
        with zipfile.ZipFile(path) as archive:
            entries = {entry.filename: entry for entry in archive.infolist()}
            return {
                name: _read_npz_array(archive, entries.get(f"{name}.npy"), name, array_type, size)
                for name, array_type in wanted.items()
            }
    except damaged as error:
        raise DataError(f"{path}: damaged ({' '.join(str(error).split()) or type(error).__name__})") from error


def _read_npz_array(
    archive: zipfile.ZipFile, entry: zipfile.ZipInfo | None, name: str, array_type: ArrayType, size: int
) -> np.ndarray:
    import numpy as np

    dtype, shape = array_type
    if entry is None:
        raise ValueError(f"no array {name!r}")
    if entry.compress_type != zipfile.ZIP_STORED or entry.file_size > size:
        raise ValueError(f"{name} claims {entry.file_size} bytes of a file of {size}")
    with archive.open(entry) as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        actual, _, kind = read(file)
        fits = len(actual) == len(shape) and all(w is None or n == w for n, w in zip(actual, shape, strict=True))
        if kind != np.dtype(dtype) or not fits:
            expected = f"{np.dtype(dtype)} of {str(shape).replace('None', 'N')}"
            raise ValueError(f"{name} is {kind} of shape {actual}; expected {expected}")
        if math.prod(actual) * kind.itemsize > entry.file_size:
            raise ValueError(f"{name} claims shape {actual}, but has only {entry.file_size} bytes")
    with archive.open(entry) as file:
        result: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
    return result
