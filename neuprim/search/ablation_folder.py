"""The request of an ablation, and the folder of its set: what it may continue from."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuprim.config import RunConfig, compose
from neuprim.config.command_settings import LauncherSettings
from neuprim.config.outputs import ROOT
from neuprim.config.overrides import parse
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError, DataError
from neuprim.search.ablation_plan import CENTRE, Plan
from neuprim.search.eval_views import eval_views
from neuprim.search.measuring import describe_machine
from neuprim.search.points import TRADEOFF_FILE, Record
from neuprim.version import __version__

__all__ = [
    "TRIALS",
    "AblationRequest",
    "check_folder",
    "compose_centre",
    "describe_identity",
    "parse_plan",
    "resume_record",
]

TRIALS = "trials"
"""Folder of the models."""

Tell = Callable[[str], None]


@dataclass(frozen=True)
class AblationRequest:
    """What to train and measure.

    Attributes:
        words: overrides of ``neuprim run``; they define the centre and, with ``output_dir``, the folder of the set.
        budget: seconds for everything, about; what does not fit is left out.
        views: evaluation views, evenly spread.
        repeats: rounds of timing.
        knobs: names of those to change; empty for all.
        seeds: trainings of every model.
        lpips: weights for LPIPS; None for those of the configuration.
        launcher: where models are trained; they are measured here.
    """

    words: Sequence[str]
    budget: float = 1200.0
    views: int = 5
    repeats: int = 15
    knobs: Sequence[str] = ()
    seeds: int = 1
    lpips: Path | None = None
    launcher: LauncherSettings = LauncherSettings()  # noqa: RUF009 (frozen)


def compose_centre(request: AblationRequest) -> tuple[list[str], Path, RunConfig]:
    """Return the centre's overrides, the folder of the set, and the centre's configuration."""
    said = parse(request.words)
    words = [a.text for a in said if a.key not in ("output_dir", "resume", "budget")]
    places = [a.value for a in said if a.key == "output_dir" and a.value is not None]
    centre = compose([*words, "output_dir=null"], check_output=False)
    folder = Path(str(places[-1])).expanduser() if places else ROOT / f"tradeoff-{centre.task}-{centre.scene_name}"
    if folder.exists() and not folder.is_dir():
        raise ConfigError(f"output_dir={folder}: is a file; expected a directory")
    return words, folder, centre


def _centre_settings(centre: RunConfig) -> dict[str, Any]:
    own = ("output_dir", "resume", "overrides", "non_default", "made_by")
    return {name: value for name, value in centre.to_dict().items() if name not in own}


def check_folder(folder: Path, before: Record | None, centre: RunConfig, request: AblationRequest) -> None:
    """Refuse a folder that holds something else, or another set."""
    if before is None:
        if folder.is_dir() and any(folder.iterdir()) and not (folder / TRIALS).is_dir():
            raise ConfigError(f"output_dir={folder}: holds something else; expected a new directory, or that of a set")
        return
    if before.same.get("kind") != "models":
        raise DataError(f"{folder / TRADEOFF_FILE}: of a finished run; expected another output_dir=DIR for trainings")
    wanted = {"centre": _centre_settings(centre), "seeds": request.seeds}
    changed = [name for name, value in wanted.items() if before.same.get(name) != value]
    if changed:
        expected = "expected the same overrides, or another output_dir=DIR"
        raise ConfigError(f"{folder}: holds a set with another {' and '.join(changed)}; {expected}")


def describe_identity(centre: RunConfig, dataset: Dataset, request: AblationRequest) -> dict[str, Any]:
    """Return what must be equal to keep earlier measurements; JSON-able."""
    views, about = eval_views(dataset, request.views), describe_machine()
    if not views:
        raise DataError(f"{dataset.name} has no test views; expected some to measure on")
    return {
        "kind": "models",
        "centre": _centre_settings(centre),
        "seeds": request.seeds,
        "views": [one.view.name for one in views],
        "image_size": [views[0].view.camera.width, views[0].view.camera.height],
        "lpips": str(request.lpips or centre.metrics.lpips or ""),
        "machine": about["machine"],
        "versions": {"neuprim": __version__, **about["versions"]},
    }


def resume_record(folder: Path, before: Record | None, identity: dict[str, Any], tell: Tell) -> Record:
    """Return the earlier record; without points if they were measured otherwise."""
    if before is None:
        return Record(identity)
    facts: dict[str, Any] = {name: before.facts[name] for name in ("spent_seconds", "exact") if name in before.facts}
    changed = [name for name in identity if before.same.get(name) != identity[name]]
    if changed:
        what = " and ".join(changed)
        tell(f"{folder / TRADEOFF_FILE}: measured with another {what}; models are kept, and measured anew")
        return Record(identity, facts)
    points = [p for p in before.points if p.run_dir and (folder / p.run_dir / "model.safetensors").exists()]
    if not points or points[0].name != CENTRE:
        return Record(identity, facts)
    tell(f"{folder / TRADEOFF_FILE}: {len(points)} models are kept; delete the folder to train anew")
    return Record(identity, facts, points)


def parse_plan(file: Path, record: Record | None) -> Plan | None:
    if record is None or "plan" not in record.facts:
        return None
    try:
        data = record.facts["plan"]
        paces = {str(name): float(pace) for name, pace in data["paces"].items()}
        plan = Plan(int(data["steps"]), float(data["seconds"]), int(data["whole"]), paces)
        if plan.steps < 1 or not all(pace > 0 for pace in paces.values()):
            raise ValueError("steps and paces must be above 0")
    except (KeyError, TypeError, AttributeError, ValueError) as error:
        what = f"{type(error).__name__}: {error}"
        raise DataError(f"{file}: plan is damaged ({what}); delete the folder to train anew") from error
    return plan
