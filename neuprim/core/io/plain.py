"""Parse untrusted JSON, YAML and npz as plain data; every such file of a run or a user is parsed here.

Numbers are finite, whole ones have at most 64 bits, and YAML may not use anchors, which let a few lines describe more
than memory holds. Arrays are checked before memory is allocated. Nothing is executed or looked up.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from tokenize import TokenError
from typing import TYPE_CHECKING, Any

import yaml

from neuprim.core.errors import DataError, cut_error_text

if TYPE_CHECKING:
    import numpy as np

_MAX_DIGITS = 20  # of a whole number of 64 bits


def finite_json_number(value: object) -> float | None:
    """A number of a file as a float; None for text, true, a list, NaN, 1e400 and the like."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return None
    try:
        number = float(value)
    except OverflowError:
        return None
    return number if math.isfinite(number) else None


def load_json(text: str | bytes, infinite: bool = False) -> Any:
    """Parse JSON text; ``infinite`` accepts NaN and infinity. Raises ValueError or RecursionError."""
    parse_float = float if infinite else _parse_json_float
    parse_constant = float if infinite else _refuse_json_constant
    return json.loads(text, parse_int=_parse_json_int, parse_float=parse_float, parse_constant=parse_constant)


def parse_yaml_file(text: str) -> Any:
    """Parse YAML text; raises yaml.YAMLError, ValueError or RecursionError."""
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
        raise ValueError(f"{cut_error_text(text)} is larger than any number here")
    return value


def _refuse_json_constant(text: str) -> float:
    raise ValueError(f"{text} is no finite number")


class _PlainYamlLoader(yaml.SafeLoader):
    """``yaml.SafeLoader`` with the limits of this module."""

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
                None, None, f"{cut_error_text(node.value)} is larger than any number here", node.start_mark
            )
        return value


for _kind in ("int", "float"):
    _PlainYamlLoader.add_constructor(f"tag:yaml.org,2002:{_kind}", _PlainYamlLoader.number)


ArrayType = tuple[Any, tuple[int | None, ...]]  # dtype and shape; None for any length


def read_npz_arrays(path: Path, wanted: Mapping[str, ArrayType]) -> dict[str, np.ndarray]:
    """Read the named arrays of an uncompressed file of ``numpy.savez``; raises DataError before memory is allocated."""
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
            raise ValueError(f"{name} claims shape {actual}, and has {entry.file_size} bytes")
    with archive.open(entry) as file:
        result: np.ndarray = np.lib.format.read_array(file, allow_pickle=False)
    return result
