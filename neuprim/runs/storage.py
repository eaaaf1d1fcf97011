"""How a model's numbers may be stored, and what comes back of them: the one table of formats. A new one is a row here.

A model file of neuprim holds float32, unless it was compressed (:mod:`neuprim.core.compression`). What it would be
otherwise is tried in memory: values are rounded to what the format brings back, and its bytes are counted.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from neuprim.core.checkpoint import read_header
from neuprim.core.compression import is_compressed
from neuprim.core.compression.columns import fit_columns
from neuprim.core.errors import ConfigError
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.core.model.primitives import Primitives

__all__ = ["ALL", "FORMATS", "FULL", "GROUPS", "Format", "file_bytes", "parameters_of", "rounded", "stored_bytes"]


@dataclass(frozen=True)
class Format:
    """One way to store a tensor.

    Attributes:
        summary: one line for messages.
        round: what is read back of an (N, ...) float32 tensor, of the same type and shape.
        bytes: of a tensor so stored.
    """

    summary: str
    round: Callable[[Tensor], Tensor]
    bytes: Callable[[Tensor], int]


_BITS = 8


def _codes(value: Tensor) -> Tensor:
    """(N, ...) as even steps between the ends of every column bring it back, as compressed files do."""
    flat = value.detach().cpu().reshape(len(value), math.prod(value.shape[1:]))
    columns = fit_columns(flat, [_BITS] * flat.shape[1])
    return columns.values(columns.codes(flat)).reshape(value.shape).to(value)


def _code_bytes(value: Tensor) -> int:
    return value.numel() + 8 * math.prod(value.shape[1:])  # two ends for a column


FULL = "float32"
"""What model files hold."""

FORMATS: Mapping[str, Format] = {
    FULL: Format("32-bit floats, as model files hold them", lambda value: value, lambda value: 4 * value.numel()),
    "float16": Format(
        "16-bit floats, 11 bits of precision", lambda value: value.half().float(), lambda value: 2 * value.numel()
    ),
    "uint8": Format("8-bit codes, even steps between the ends of each column", _codes, _code_bytes),
}


GROUPS = ("means", "shape", "density", "colour")
"""Of parameters: the centres, the other numbers of the ellipsoids, and those of both fields."""

ALL = "all"
"""In words: every group."""


def parameters_of(model: Primitives, group: str) -> tuple[str, ...]:
    """Names of a group's parameters."""
    if group == "means":
        return ("means",)
    if group == "shape":
        return tuple(spec.name for spec in GEOMETRY_SPECS if spec.name != "means")
    return tuple(spec.name for spec in (model.density if group == "density" else model.colour).parameters())


def rounded(model: Primitives, stored: Mapping[str, str]) -> Primitives:
    """The model as it is read back when groups are stored in formats; itself if all are as they are.

    Raises:
        ConfigError: a value is beyond what its format holds.
    """
    if all(name == FULL for name in stored.values()):
        return model
    params = dict(model.params)
    for group, name in stored.items():
        for parameter in parameters_of(model, group):
            params[parameter] = FORMATS[name].round(params[parameter].detach())
            if not bool(torch.isfinite(params[parameter]).all()):
                raise ConfigError(f"store.{group}={name}: {parameter} has values that {name} does not hold")
    return Primitives(model.density, model.colour, params)


def stored_bytes(model: Primitives, stored: Mapping[str, str]) -> int:
    """Bytes of the model's tensors, each group in its format."""
    return sum(
        FORMATS[stored.get(group, FULL)].bytes(model.params[name])
        for group in GROUPS
        for name in parameters_of(model, group)
    )


def file_bytes(path: Path, whole: Primitives, part: Primitives, stored: Mapping[str, str]) -> int:
    """Bytes of a run's model file if it held ``part`` of the ``whole`` model that is in it, in formats.

    A compressed file, and one that leaves zeros out, has its own size as it is; less of it, or other formats, are
    counted as the tensors of a file that is not compressed and leaves nothing out.
    """
    size, after = path.stat().st_size, stored_bytes(part, stored)
    if not is_compressed(path) and "apart" not in read_header(path, "model"):
        return size - stored_bytes(whole, {}) + after
    return size if after == stored_bytes(whole, {}) else after
