"""What lies in the folder of a set already, and whether the same set goes on there."""

from __future__ import annotations

import platform
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuprim.config import RunConfig, compose
from neuprim.config.outputs import ROOT
from neuprim.config.overrides import parse
from neuprim.core.compute.threads import core_count, cpu_name
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError, DataError
from neuprim.runs.open import LOGS
from neuprim.search.design.plan import Plan
from neuprim.search.design.record import Model
from neuprim.search.design.request import DesignRequest, Tell
from neuprim.search.design.variants import CENTRE
from neuprim.search.tradeoff.record import Measured, Record
from neuprim.search.truths import truths_of
from neuprim.version import __version__

__all__ = ["TRIALS", "centre_of", "check_folder", "kept_record", "number_of", "old_plan", "same_of"]

TRIALS = "trials"
"""Folder of the models, inside that of the set."""

_OWN_WORDS = ("output_dir", "resume", "budget")


def centre_of(request: DesignRequest) -> tuple[list[str], Path, RunConfig]:
    """Words of the centre, without those of its place; the set's folder; and the centre's configuration."""
    said = parse(request.words)
    words = [a.text for a in said if a.key not in _OWN_WORDS]
    places = [a.value for a in said if a.key == "output_dir" and a.value is not None]
    centre = compose([*words, "output_dir=null"], check_output=False)
    folder = Path(str(places[-1])).expanduser() if places else ROOT / f"tradeoff-{centre.task}-{centre.scene_name}"
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"output_dir={folder}: is a file; expected a directory")
    return words, folder, centre


def _settings(centre: RunConfig) -> dict[str, Any]:
    """The centre as a record holds it."""
    own = ("output_dir", "resume", "overrides", "non_default", "made_by")
    return {name: value for name, value in centre.to_dict().items() if name not in own}


def check_folder(folder: Path, before: Record | None, centre: RunConfig, request: DesignRequest) -> None:
    if before is None:
        if folder.is_dir() and any(entry.name != LOGS for entry in folder.iterdir()) and not (folder / TRIALS).is_dir():
            raise ConfigError(f"output_dir={folder}: holds something else; expected a new directory, or that of a set")
        return
    if before.same.get("kind") != "models":
        raise DataError(
            f"{folder / 'tradeoff.json'}: of a finished run's drawing; expected another output_dir=DIR for trainings"
        )
    asked = {"centre": _settings(centre), "seeds": request.seeds}
    changed = [name for name, value in asked.items() if before.same.get(name) != value]
    if changed:
        raise ConfigError(
            f"{folder}: holds a set with another {' and '.join(changed)}; expected the same words, or another output_dir=DIR"
        )


def same_of(centre: RunConfig, dataset: Dataset, request: DesignRequest) -> dict[str, Any]:
    """What makes an earlier measurement worth keeping; JSON-able."""
    truths = truths_of(dataset, request.views)
    camera = truths[0].view.camera
    return {
        "kind": "models",
        "centre": _settings(centre),
        "seeds": request.seeds,
        "views": [truth.view.name for truth in truths],
        "image_size": [camera.width, camera.height],
        "lpips": str(request.lpips or centre.metrics.lpips or ""),
        "machine": {"cpu": cpu_name(), "cores": core_count()},
        "versions": {
            "neuprim": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
    }


def kept_record(folder: Path, before: Record | None, same: dict[str, Any], tell: Tell) -> Record:
    """The record so far; without its points where they were measured otherwise."""
    if before is None:
        return Record(same)
    facts: dict[str, Any] = {name: before.facts[name] for name in ("spent_seconds", "exact") if name in before.facts}
    changed = [name for name in same if before.same.get(name) != same[name]]
    if changed:
        tell(
            f"{folder / 'tradeoff.json'}: measured with {' and '.join(changed)} of before; models are kept, and measured anew"
        )
        return Record(same, facts)
    points = [
        point
        for point in before.points
        if isinstance(point, Model) and (folder / point.run_dir / "model.safetensors").exists()
    ]
    if not points or points[0].name != CENTRE:
        points = []
    if points:
        tell(
            f"{folder / 'tradeoff.json'}: {len(points)} models trained already are kept; delete the folder to train anew"
        )
    return Record(same, facts, list[Measured](points))


def old_plan(folder: Path, before: Record | None) -> Plan | None:
    if before is None or "plan" not in before.facts:
        return None
    try:
        return Plan.from_dict(before.facts["plan"])
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        what = f"{type(error).__name__}: {error}"
        raise DataError(
            f"{folder / 'tradeoff.json'}: plan is damaged ({what}); delete the folder to train anew"
        ) from error


def number_of(record: Record, name: str) -> float:
    value = record.facts.get(name, 0.0)
    return float(value) if isinstance(value, int | float) else 0.0
