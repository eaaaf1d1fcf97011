"""What several formats share: options with limits, where files go, and the model's header beside its configuration."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuprim.core.errors import CheckpointError, ConfigError, DataError
from neuprim.core.extensions import ExportJob
from neuprim.core.fields import Conditions

__all__ = ["Options", "conditions_of", "free", "model_box", "pack_header", "target", "unpack_header"]


class Options:
    """The user's words over the exporter's defaults, each checked when asked for."""

    def __init__(self, job: ExportJob, defaults: Mapping[str, tuple[Any, str]]) -> None:
        self._values = {name: default for name, (default, _) in defaults.items()} | dict(job.options)

    def number(self, name: str, low: float = -math.inf, high: float = math.inf) -> float | None:
        """A finite number from ``low`` to ``high``, or None where it is not set.

        Raises:
            ConfigError: something else.
        """
        value = self._values[name]
        if value is None:
            return None
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not (math.isfinite(value) and low <= value <= high):
            raise ConfigError(f"{name}={value}: expected a number from {low:g} to {high:g}")
        return float(value)

    def count(self, name: str, low: int, high: int) -> int | None:
        """As :meth:`number`, a whole one."""
        value = self.number(name, low, high)
        if value is not None and not value.is_integer():
            raise ConfigError(f"{name}={value}: expected a whole number from {low} to {high}")
        return None if value is None else int(value)

    def choice(self, name: str, *offered: str) -> str:
        """One of those offered."""
        value = self._values[name]
        if value not in offered:
            raise ConfigError(f"{name}={value}: expected {' or '.join(offered)}")
        return str(value)

    def flag(self, name: str) -> bool:
        """true or false."""
        value = self._values[name]
        if not isinstance(value, bool):
            raise ConfigError(f"{name}={value}: expected true or false")
        return value


def conditions_of(job: ExportJob, several: bool = False) -> list[dict[str, Tensor]]:
    """One mapping of the conditions that the user gave per frame; only one frame unless ``several``.

    Raises:
        ConfigError: a condition the task needs is missing, or has several values where one is wanted.
    """
    parsed = {}
    for spec in job.run.task.conditions:
        if spec.name not in job.conditions:
            raise ConfigError(
                f"{spec.name}=: required, as the model depends on it ({spec.unit}); for example {spec.name}={_example(spec.shape)}"
            )
        parsed[spec.name] = spec.parse(job.conditions[spec.name])
    counts = {name: len(values) for name, values in parsed.items() if len(values) > 1}
    if counts and (not several or len(set(counts.values())) > 1):
        name = next(iter(counts))
        expected = "one value" if not several else "as many values for each"
        raise ConfigError(f"{name}={job.conditions[name]}: {counts[name]} values; expected {expected}")
    frames = max(counts.values(), default=1)
    return [{name: values[i if len(values) > 1 else 0] for name, values in parsed.items()} for i in range(frames)]


def _example(shape: tuple[int, ...]) -> str:
    return ",".join(["1"] * math.prod(shape)) if shape else "0.5"


def target(job: ExportJob, default: str, suffixes: tuple[str, ...]) -> Path:
    """The one file to write: what the user named, or ``default`` in the run's folder ``export``.

    Raises:
        ConfigError: another suffix, or the file exists.
    """
    path = job.out if job.out is not None else job.run.directory / "export" / default
    if path.suffix.lower() not in suffixes or path.is_dir():
        raise ConfigError(f"--out {path}: expected a file name with {' or '.join(suffixes)}")
    free(job, path)
    return path


def free(job: ExportJob, path: Path) -> None:
    """Raises ConfigError if ``path`` exists and may not be replaced."""
    if path.exists() and not job.overwrite:
        raise ConfigError(f"{path}: exists; --force replaces it, --out PATH writes elsewhere")


def model_box(job: ExportJob, frames: list[Conditions]) -> tuple[Tensor, Tensor]:
    """Lower and upper corner (3,) float64 of a box around the ellipsoids of all frames, scene units.

    Raises:
        ConfigError: no primitive lives in any of them.
    """
    lows, highs = [], []
    with torch.no_grad():
        for conditions in frames:
            geometry, _ = job.run.model.lower_density(conditions)
            if geometry.count:
                reach = (geometry.rotations.double() * geometry.scales.double()[:, None, :]).norm(dim=-1)
                lows.append((geometry.means.double() - reach).min(0).values)
                highs.append((geometry.means.double() + reach).max(0).values)
    if not lows:
        raise ConfigError(f"{job.run.directory}: no primitive is there under these conditions; nothing to export")
    return torch.stack(lows).min(0).values, torch.stack(highs).max(0).values


# ---------------------------------------------------------------- whole models

_FORMAT = 1


def pack_header(job: ExportJob) -> str:
    """One line of JSON: the model's header, its parameters' shapes, and the run's ``config.yaml`` as it is."""
    run = job.run
    path = run.directory / "config.yaml"
    try:
        config = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise CheckpointError(f"{path}: cannot be read ({error})") from error
    record = {
        "format": _FORMAT,
        "model": dict(run.header),
        "parameters": {spec.name: list(spec.shape) for spec in run.model.specs},
        "config": config,
    }
    return json.dumps(record, allow_nan=False)


def unpack_header(text: str, path: Path) -> tuple[dict[str, Any], dict[str, tuple[int, ...]], str]:
    """Model header, parameter shapes and configuration out of :func:`pack_header`'s line; from an untrusted file.

    Raises:
        DataError: it is something else.
    """
    try:
        record = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise DataError(f"{path}: the neuprim header is not valid JSON ({error})") from error
    if not isinstance(record, dict) or record.get("format") != _FORMAT:
        found = record.get("format") if isinstance(record, dict) else type(record).__name__
        raise DataError(f"{path}: the neuprim header has format {found!r}; this neuprim reads {_FORMAT}")
    header, shapes, config = record.get("model"), record.get("parameters"), record.get("config")
    if not isinstance(header, dict) or not isinstance(shapes, dict) or not isinstance(config, str):
        raise DataError(f"{path}: the neuprim header lacks model, parameters or config")
    for name, shape in shapes.items():
        whole = isinstance(shape, list) and len(shape) <= 4 and all(type(n) is int and 0 <= n <= 10_000 for n in shape)
        if not whole or math.prod(shape) > 10_000:
            raise DataError(f"{path}: parameter {name[:40]!r} has shape {str(shape)[:60]}; expected up to 4 sizes")
    return header, {name: tuple(shape) for name, shape in shapes.items()}, config
