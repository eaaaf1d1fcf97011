"""``neuprim run -m``, and a run that works elsewhere: launch, show progress, and report what failed or is left."""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.table import Table
from rich.text import Text

from neuprim.cli.command import describe_interruption, plain_console
from neuprim.config import RunConfig
from neuprim.config.command_settings import LauncherSettings
from neuprim.config.overrides import CommandLine
from neuprim.runs.ground_truth import render_ground_truth_of_runs
from neuprim.runs.launch.jobs import ENDED, JobResult, JobStatus
from neuprim.runs.launch.launcher import LAUNCH_FOLDER, launch
from neuprim.runs.launch_record import run_job
from neuprim.runs.sweep import run_sweep

_LINE_INTERVAL = 0.25
"""Share of a training between two lines, where there is no terminal."""

_STATE_ORDER = ("training", "finishing", "preparing", "starting", "failed", "interrupted", "done", "waiting")
"""Jobs that go first where not all rows fit the screen."""

_STYLES = {"failed": "red", "done": "green", "waiting": "dim"}


def launch_runs(
    configs: Sequence[RunConfig], overrides: list[str], settings: LauncherSettings, typed: CommandLine
) -> int:
    """Launch the runs of a sweep, or a single run in another process; return the exit status.

    Args:
        overrides: what the sweep was asked for.
        typed: all that was typed, for the command that continues.
    """
    with _RunProgress(configs) as progress:
        if len(configs) > 1:
            _, results = run_sweep(configs, overrides, settings, progress)
        else:
            render_ground_truth_of_runs(configs, settings, progress)
            results = launch([run_job(configs[0])], settings, configs[0].output_dir / LAUNCH_FOLDER, progress)
    status = _report(configs, results, progress.live, typed)
    if len(configs) > 1:
        print(configs[0].output_dir.parent / "sweep.html")
    return status


class LaunchProgress:
    """Show several jobs: one table on a terminal, a line now and then elsewhere. Call it with their statuses."""

    def __init__(self, console: Console, names: Sequence[str]) -> None:
        self.console, self.names, self.live = console, names, console.is_terminal
        self._statuses = [JobStatus()] * len(names)
        self._seconds: dict[int, float] = {}
        self._printed: dict[int, tuple[object, ...]] = {}
        self._display = Live(self, console=console, redirect_stdout=True) if self.live else None

    def __enter__(self) -> Self:
        if self._display is not None:
            self._display.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._display is not None:
            self._display.stop()

    def __call__(self, number: int, status: JobStatus) -> None:
        """Show a job's status."""
        before, self._statuses[number] = self._statuses[number], status
        if status.state != "waiting":
            self._seconds.setdefault(number, time.monotonic())
        if status.state in ENDED and before.state not in ENDED:
            self._seconds[number] = time.monotonic() - self._seconds[number]  # a time, from now on a duration
        if not self.live:
            self._print_line(number, status)

    # ------------------------------------------------------------ lines

    def _print_line(self, number: int, status: JobStatus) -> None:
        shown = (
            status.state,
            int(status.progress / _LINE_INTERVAL) if status.state in ("training", "waiting") else 0,
            status.text.rpartition(", ")[0] or status.text if status.state == "waiting" else "",
            status.attempt,
        )
        if self._printed.get(number) == shown or status.state in ("starting", "failed", "interrupted"):
            return  # the command reports these states
        self._printed[number] = shown
        if status.state == "done" and not status.step:
            return  # it was done before
        text = " ".join(filter(None, (_state(status), _steps(status), _psnr(status, " dB held out"), status.text)))
        self.console.print(f"{self.names[number]}: {text}")

    # ------------------------------------------------------------ table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        table.add_column("run", overflow="fold")
        table.add_column("state", no_wrap=True)
        for name in ("steps", "held-out dB", "seconds"):
            table.add_column(name, justify="right", no_wrap=True)
        table.add_column("", overflow="ellipsis", no_wrap=True)
        room = max(console.size.height - 6, 4)
        order = sorted(range(len(self.names)), key=lambda n: (_STATE_ORDER.index(self._statuses[n].state), n))
        for number in sorted(order[:room]):
            status = self._statuses[number]
            cells = (
                self.names[number],
                _state(status),
                _steps(status),
                _psnr(status),
                self._elapsed(number),
                status.text,
            )
            table.add_row(*(Text(cell, style=_STYLES.get(status.state, "")) for cell in cells))
        yield table
        counts = Counter(status.state for status in self._statuses)
        more = f"; {len(order) - room} not shown" if len(order) > room else ""
        yield Text("  ".join(f"{counts[state]} {state}" for state in _STATE_ORDER if counts[state]) + more)

    def _elapsed(self, number: int) -> str:
        if number not in self._seconds:
            return ""
        seconds = self._seconds[number]
        return f"{seconds if self._statuses[number].state in ENDED else time.monotonic() - seconds:.0f}"


def _state(status: JobStatus) -> str:
    return status.state + (f", try {status.attempt + 1}" if status.attempt else "")


def _steps(status: JobStatus) -> str:
    return f"step {status.step:,} ({status.progress:.0%})" if status.step else ""


def _psnr(status: JobStatus, unit: str = "") -> str:
    return "" if status.psnr is None else f"{status.psnr:.2f}{unit}"


class _RunProgress(LaunchProgress):
    """Without a terminal, also print started and finished runs on standard output."""

    def __init__(self, configs: Sequence[RunConfig]) -> None:
        super().__init__(plain_console(stderr=True), [config.output_dir.name for config in configs])
        self._configs = configs

    def __call__(self, number: int, status: JobStatus) -> None:
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


def _report(configs: Sequence[RunConfig], results: Sequence[JobResult | None], live: bool, typed: CommandLine) -> int:
    """Print failures, and raise KeyboardInterrupt with the command that continues; return the exit status: 2 for bad
    input, 1 for a bug."""
    status, left = 0, []
    for config, result in zip(configs, results, strict=True):
        if result is None or result.state == "interrupted":
            left.append(config.output_dir)
        elif result.state == "done":
            if live:
                print(config.output_dir)
        else:
            if result.trace:
                print(result.trace, end="", file=sys.stderr)
            if live:
                _print_error(config.output_dir, result.line)
            status = 1 if result.trace or status == 1 else 2
    if left and len(configs) == 1:
        raise KeyboardInterrupt(describe_interruption(left[0], typed))
    if left:
        over = f"{left[0].parent} has {len(configs) - len(left)} of {len(configs)} runs"
        begun = sum((directory / "checkpoint.safetensors").exists() for directory in left)
        command = typed.resume_command(left[0])
        raise KeyboardInterrupt(f"; {over}, and {begun} of the others up to here; to go on:\n  {command}")
    return status
