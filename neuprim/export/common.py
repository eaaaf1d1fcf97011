"""What several formats share: the box around a model, and its header beside its configuration."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuprim.core.errors import CheckpointError, ConfigError, DataError
from neuprim.core.extensions import ExportJob
from neuprim.core.io.plain import load_json
from neuprim.core.model.fields import Conditions

__all__ = ["model_box", "pack_header", "unpack_header"]


def model_box(job: ExportJob, frames: Sequence[Conditions]) -> tuple[Tensor, Tensor]:
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
        record = load_json(text)
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
