"""``neuprim run -m``, and a single run that works elsewhere: launched, shown, and what is said at the end."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from pathlib import Path

from neuprim.cli.console import plain_console
from neuprim.cli.launching import LaunchProgress
from neuprim.config import RunConfig
from neuprim.config.launcher import LauncherSettings
from neuprim.config.overrides import CommandLine
from neuprim.runs.ground_truth import before_runs
from neuprim.runs.launch.jobs import Result
from neuprim.runs.launch.status import Status
from neuprim.runs.launch.table import FOLDER, launch
from neuprim.runs.sweep.one import job_of
from neuprim.runs.sweep.run import sweep_run

__all__ = ["launch_one", "sweep"]


def sweep(configs: Sequence[RunConfig], words: list[str], settings: LauncherSettings, typed: CommandLine) -> int:
    """Launch all runs of a sweep; the exit status.

    Args:
        words: what the sweep was asked for.
        typed: all that was typed, for the command that goes on.
    """
    folder = configs[0].output_dir.parent
    shown = _Shown(configs)
    with shown:
        _, results = sweep_run(configs, words, settings, shown)
    status = _told(configs, results, shown.live, typed)
    print(folder / "sweep.html")
    return status


def launch_one(config: RunConfig, settings: LauncherSettings, typed: CommandLine) -> int:
    """Launch one run somewhere else; the exit status."""
    shown = _Shown([config])
    with shown:
        before_runs([config], settings, shown)
        results = launch([job_of(config)], settings, config.output_dir / FOLDER, shown)
    return _told([config], results, shown.live, typed)


class _Shown(LaunchProgress):
    """Without a terminal, what is begun and done is also said on standard output."""

    def __init__(self, configs: Sequence[RunConfig]) -> None:
        super().__init__(plain_console(stderr=True), [config.output_dir.name for config in configs])
        self._configs = configs

    def __call__(self, number: int, status: Status) -> None:
        fresh = self._statuses[number].state == "waiting"
        super().__call__(number, status)
        directory, many = self._configs[number].output_dir, len(self._configs)
        if not self.live and many > 1 and fresh and status.state == "starting" and not status.attempt:
            print(f"[{number + 1}/{many}] {directory}", flush=True)
        if not self.live and status.state == "done":
            print(directory, flush=True)
        if not self.live and status.state == "failed":
            _print_error(directory, status.text)


def _print_error(directory: Path, line: str) -> None:
    print(f"neuprim: error: {directory}: {line}", file=sys.stderr, flush=True)


def _told(configs: Sequence[RunConfig], results: Sequence[Result | None], live: bool, typed: CommandLine) -> int:
    """Says what failed, and what is to be done after Ctrl-C; the exit status: 2 for the input's fault, 1 for a bug."""
    status = 0
    for config, result in zip(configs, results, strict=True):
        if result is None or result.state == "interrupted":
            continue
        if result.state == "done":
            if live:
                print(config.output_dir)
            continue
        if result.trace:
            print(result.trace, end="", file=sys.stderr)
        if live:
            _print_error(config.output_dir, result.line)
        status = 1 if result.trace or status == 1 else 2
    left = [
        config
        for config, result in zip(configs, results, strict=True)
        if result is None or result.state == "interrupted"
    ]
    if left:
        raise KeyboardInterrupt(_to_go_on(configs, left, typed))
    return status


def _to_go_on(configs: Sequence[RunConfig], left: Sequence[RunConfig], typed: CommandLine) -> str:
    begun = [config.output_dir for config in left if (config.output_dir / "checkpoint.safetensors").exists()]
    if len(configs) == 1:
        where = f"{left[0].output_dir} {'has the run up to here' if begun else 'has no checkpoint yet'}"
    else:
        over = len(configs) - len(left)
        where = (
            f"{left[0].output_dir.parent} has {over} of {len(configs)} runs, and {len(begun)} of the others up to here"
        )
    return f"; {where}; to go on:\n  {shlex.join(['neuprim', 'run', *typed.resume_arguments(left[0].output_dir)])}"
