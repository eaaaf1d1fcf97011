"""One run: fit, measure, draw and report, all in one directory that can be resumed."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

from neuprim.config import RunConfig, find_run_plugins
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.metrics.image import format_metrics
from neuprim.core.train.distributed.process_group import ProcessGroup
from neuprim.runs.chunks import train_in_chunks
from neuprim.runs.evaluate import evaluate_fitted
from neuprim.runs.events import Events, Finishing, Note, ignore_event
from neuprim.runs.fit import is_chunked, refuse_chunks
from neuprim.runs.run_directory import lock_directory
from neuprim.runs.training import BetweenSteps, do_nothing_between, train_in_directory


def run(
    config: RunConfig,
    events: Events = ignore_event,
    between: BetweenSteps = do_nothing_between,
    group: ProcessGroup | None = None,
    launcher: LauncherSettings = LauncherSettings(),  # noqa: B008 (frozen)
) -> Path:
    """Fit, measure and report; returns the run directory.

    Ctrl-C finishes the step, writes a checkpoint and a report, and raises KeyboardInterrupt; a second one stops at
    once.

    Args:
        events: told what happens.
        between: called between training steps, see :data:`~neuprim.runs.training.BetweenSteps`.
        group: the processes that train this model, each of which calls this with the same configuration; the first one
            alone writes files. None for one process.
        launcher: where the chunks of a scene are fitted, if it is fitted in chunks.

    Raises:
        NeuprimError: the input's fault, another process that is at work there, or numbers that are not finite;
            whatever was on disk before is intact.
        RankError: another rank ended; what was trained is in the checkpoint.
    """
    directory = config.output_dir
    first = group is None or group.is_first
    if group is not None:
        refuse_chunks(config, "several ranks train one model together")
    with lock_directory(directory) if first else nullcontext(), find_run_plugins(config).attribute_errors():
        if is_chunked(config):
            fitted, interrupted = train_in_chunks(config, events, launcher, between)
        else:
            fitted, interrupted = train_in_directory(config, events, between=between, group=group)
        if first:
            events(Finishing("measuring held-out views"))
            events(Note(format_metrics(evaluate_fitted(fitted, directory))))
    if interrupted:
        raise KeyboardInterrupt
    return directory
