"""One run: fit, measure, draw and report, all in one directory that can be resumed."""

from __future__ import annotations

from pathlib import Path

from neuprim.config import RunConfig, suspects_of
from neuprim.runs.events import Events, Finishing, silent
from neuprim.runs.finish import finish
from neuprim.runs.lock import held
from neuprim.runs.open import LOGS
from neuprim.runs.training import Between, alone, train

__all__ = ["run"]


def run(config: RunConfig, events: Events = silent, between: Between = alone) -> Path:
    """Fit, measure and report; returns the run directory.

    Ctrl-C finishes the step, writes a checkpoint and a report, and raises KeyboardInterrupt; a second one stops at once.

    Args:
        events: told what happens.
        between: called between training steps, see :data:`~neuprim.runs.training.Between`.

    Raises:
        NeuprimError: the input's fault, another process that is at work there, or numbers that left the finite; whatever was on disk before
            is intact.
    """
    directory = config.output_dir
    suspects = suspects_of(config)
    with held(directory), suspects.watch(directory / LOGS):
        fitted, interrupted = train(config, suspects, events, between=between)
        events(Finishing("measuring held-out views"))
        finish(fitted, directory)
    if interrupted:
        raise KeyboardInterrupt
    return directory
