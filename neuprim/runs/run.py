"""One run: fit, measure, draw and report, all in one directory that can be resumed."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

from neuprim.config import RunConfig, suspects_of
from neuprim.config.launcher import LauncherSettings
from neuprim.core.metrics.words import in_words
from neuprim.core.train.distributed import ALONE, Alone
from neuprim.runs.chunks.asked import asked, refuse_chunks
from neuprim.runs.chunks.train import train_in_chunks
from neuprim.runs.evaluate import evaluate_fitted
from neuprim.runs.events import Events, Finishing, Note, silent
from neuprim.runs.lock import held
from neuprim.runs.open import LOGS
from neuprim.runs.parts import assemble
from neuprim.runs.training import Between, alone, train

__all__ = ["run"]


def run(
    config: RunConfig,
    events: Events = silent,
    between: Between = alone,
    ranks: Alone = ALONE,
    launcher: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
) -> Path:
    """Fit, measure and report; returns the run directory.

    Ctrl-C finishes the step, writes a checkpoint and a report, and raises KeyboardInterrupt; a second one stops at
    once.

    Args:
        events: told what happens.
        between: called between training steps, see :data:`~neuprim.runs.training.Between`.
        ranks: the processes that train this model, each of which calls this with the same configuration; the first one
        alone writes files. launcher: where the chunks of a scene are fitted, if it is fitted in chunks.

    Raises:
        NeuprimError: the input's fault, another process that is at work there, or numbers that left the finite;
        whatever was on disk before
            is intact.
        RankError: another rank is gone; what was trained is in the checkpoint.
    """
    directory = config.output_dir
    if ranks.size > 1:
        refuse_chunks(config, "several ranks train one model together")
    suspects = suspects_of(config)
    with held(directory) if ranks.first else nullcontext(), suspects.watch(directory / LOGS):
        if asked(config):
            fitted, interrupted = train_in_chunks(config, suspects, events, launcher, between)
        else:
            fitted, interrupted = train(config, suspects, events, between=between, ranks=ranks)
        if ranks.first:
            events(Finishing("measuring held-out views"))
            assemble(fitted, directory)
            events(Note(in_words(evaluate_fitted(fitted, directory))))
    if interrupted:
        raise KeyboardInterrupt
    return directory
