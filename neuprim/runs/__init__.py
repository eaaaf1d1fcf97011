"""What the commands do, for Python too: fit, measure, draw, export and inspect runs, and weigh speed against accuracy.
Nothing here parses arguments or prints."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from neuprim.runs.compress import compress_run as compress_run
    from neuprim.runs.design.run import design_run as design_run
    from neuprim.runs.draw import render_run as render_run
    from neuprim.runs.export import export_run as export_run
    from neuprim.runs.fit import Fitted as Fitted
    from neuprim.runs.measure import evaluate_run as evaluate_run
    from neuprim.runs.open import load_dataset as load_dataset
    from neuprim.runs.open import load_run as load_run
    from neuprim.runs.open import read_metrics as read_metrics
    from neuprim.runs.tradeoff.run import tradeoff_run as tradeoff_run
    from neuprim.runs.trials import run_trial as run_trial

_HOMES = {
    "Fitted": "fit",
    "compress_run": "compress",
    "design_run": "design.run",
    "evaluate_run": "measure",
    "export_run": "export",
    "load_dataset": "open",
    "load_run": "open",
    "read_metrics": "open",
    "render_run": "draw",
    "run_trial": "trials",
    "tradeoff_run": "tradeoff.run",
}
__all__ = [*_HOMES]


def __getattr__(name: str) -> Any:
    """Loaded when first used, so that one of them does not load what all of them need."""
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_HOMES[name]}"), name)
