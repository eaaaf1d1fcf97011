"""Show the progress of commands, as a bar on a terminal or as occasional lines; and train a run while showing it."""

from __future__ import annotations

import math
import shlex
import sys
import time
from collections import Counter
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Self

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table
from rich.text import Text

from neuprim.cli.command import describe_interrupted_command, plain_console
from neuprim.config import RunConfig
from neuprim.config.command_settings import LOOPBACK, LauncherSettings, ViewerSettings
from neuprim.config.overrides import CommandLine
from neuprim.runs.fit import Evaluated, Event, Finishing, Note, Preparing, Step
from neuprim.runs.launch.jobs import JobStatus

_REFRESH = 0.1  # seconds between two updates of a training's bar


class _ProgressBar:
    """Context manager that shows a progress bar inside its block."""

    def __init__(self, console: Console | None, columns: tuple[ProgressColumn, ...], transient: bool) -> None:
        self.console = console or plain_console(stderr=True)
        self.live = self.console.is_terminal
        left = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.percentage:>3.0f}%"))
        self.bar = Progress(*left, *columns, console=self.console, transient=transient, disable=not self.live)
        self.task = self.bar.add_task("", total=1.0, info="")

    def __enter__(self) -> Self:
        self.bar.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.stop()


class RunProgress(_ProgressBar):
    """Progress display of one run: a context manager, and a listener that is called with the run's events.

    Args:
        title: text at the beginning of every line, e.g. ``static/solids``.
        search: whether the run is a search with many short trainings. Output that is not a terminal then gets only the
            texts of :class:`~neuprim.runs.fit.Note` events.
    """

    def __init__(self, title: str, console: Console | None = None, search: bool = False) -> None:
        info = TextColumn("{task.fields[info]}", markup=False)
        super().__init__(console, (TimeElapsedColumn(), TextColumn("eta"), TimeRemainingColumn(), info), False)
        self.title, self._quiet = title, search and not self.live
        self._stage, self._printed, self._started = "", -1.0, time.monotonic()
        self._smooth: float | None = None
        self._shown = -math.inf
        self._held_out = ""

    def __call__(self, event: Event) -> None:
        """Show one event of the run."""
        if isinstance(event, Note):
            self._print(event.text)
        elif self._quiet:
            return
        elif isinstance(event, Preparing):
            self._show_preparing(event)
        elif isinstance(event, Step):
            self._show_step(event)
        elif isinstance(event, Evaluated):
            self._held_out = f"  held-out {event.psnr:.2f} dB"
        elif isinstance(event, Finishing):
            self.bar.update(self.task, completed=1.0, info=event.text)
            if not self.live:
                self._print(event.text)

    def _print(self, text: str) -> None:
        self.console.print(f"{self.title}: {text}")

    def _show_preparing(self, event: Preparing) -> None:
        text, fraction = event.text, event.fraction
        self.bar.update(self.task, description=self.title, completed=fraction, info=text)
        if text != self._stage:
            self._started = time.monotonic()
        if not self.live and (text != self._stage or fraction >= self._printed + 0.25):
            self._printed = fraction
            left = _format_time_left(time.monotonic() - self._started, fraction)
            self._print(f"{text}, {fraction:.0%}{left}" if fraction > 0 else text)
        self._stage = text

    def _show_step(self, event: Step) -> None:
        report, progress = event.report, event.progress
        if self._stage != "training":
            self._stage, self._printed, self._shown = "training", -1.0, -math.inf
            self.bar.reset(self.task)
        prints = not self.live and progress >= self._printed + 0.1
        if time.monotonic() < self._shown + _REFRESH and not prints and progress < 1.0:
            return  # reading a report waits for a GPU
        self._shown = time.monotonic()
        self._smooth = report.psnr if self._smooth is None else 0.9 * self._smooth + 0.1 * report.psnr
        info = f"step {report.step}  train {self._smooth:.2f} dB{self._held_out}  {report.primitives} primitives"
        self.bar.update(self.task, completed=progress, info=info)
        if prints:
            self._printed = progress
            self._print(
                f"{progress:4.0%}  {report.seconds:6.1f} s{_format_time_left(report.seconds, progress)}  {info}"
            )


def _format_time_left(seconds: float, fraction: float) -> str:
    """Return e.g. ", about 40 s left" if ``fraction`` of the work took ``seconds``; "" below 1 % and at the end."""
    if not 0.01 <= fraction < 1.0:
        return ""
    left = seconds * (1.0 - fraction) / fraction
    return f", about {left / 60:.0f} min left" if left > 100 else f", about {left:.0f} s left"


class DrawProgress(_ProgressBar):
    """Context manager that shows a progress bar while images are rendered, and removes it afterwards."""

    def __init__(self, console: Console | None = None) -> None:
        super().__init__(console, (TextColumn("eta"), TimeRemainingColumn()), True)
        self._started = time.monotonic()

    def print_note(self, text: str) -> None:
        """Print a line that remains on the screen after the progress bar is removed."""
        self.console.print(f"neuprim: {text}")

    def show(self, text: str, fraction: float) -> None:
        """Show ``text`` and the completed ``fraction``, 0..1. Without a terminal, print a line every 30 seconds."""
        self.bar.update(self.task, description=text, completed=fraction)
        if not self.live and fraction < 1.0 and time.monotonic() > self._started + 30.0:
            self._started = time.monotonic()
            self.print_note(f"{text}, {fraction:.0%}")


def print_notes(event: Event) -> None:
    """Print the text of an event if it is a :class:`~neuprim.runs.fit.Note`; ignore all other events."""
    if isinstance(event, Note):
        print(event.text)


# ---------------------------------------------------------------- several jobs

_LINE_INTERVAL = 0.25
"""Progress of one of several runs, as a fraction, between two printed lines, if the output is not a terminal."""


class RunLaunchProgress:
    """Progress display of several runs: a context manager, and a listener that is called with (index of a run, status).

    A terminal shows a table. Other output gets a line when a run's state changes, and a few lines during training.
    """

    def __init__(self, configs: Sequence[RunConfig]) -> None:
        self.console = plain_console(stderr=True)
        self.live = self.console.is_terminal
        self._directories = [config.output_dir for config in configs]
        self._statuses = [JobStatus()] * len(configs)
        self._printed: dict[int, tuple[object, ...]] = {}
        self._display = Live(self, console=self.console, redirect_stdout=True)

    def __enter__(self) -> Self:
        if self.live:
            self._display.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._display.stop()

    def __call__(self, number: int, status: JobStatus) -> None:
        """Show the new ``status`` of the run with index ``number``."""
        before, self._statuses[number] = self._statuses[number], status
        if not self.live:
            self._print_line(number, status)
            self._print_change(number, before, status)

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
        cells = (_format_state(status), _format_steps(status), _format_psnr(status, " dB held out"), status.text)
        self.console.print(f"{self._directories[number].name}: {' '.join(filter(None, cells))}")

    def _print_change(self, number: int, before: JobStatus, status: JobStatus) -> None:
        """Print a line when run ``number`` fails and, if there are several runs, when it starts or is done."""
        directory, many = self._directories[number], len(self._directories)
        if many > 1 and before.state == "waiting" and status.state == "starting" and not status.attempt:
            print(f"[{number + 1}/{many}] {directory}", flush=True)
        elif status.state == "done" and many > 1:
            print(directory, flush=True)
        elif status.state == "failed":
            print(f"neuprim: error: {directory}: {status.text}", file=sys.stderr, flush=True)

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        for name in ("run", "state", "steps", "held-out dB", ""):
            table.add_column(name, overflow="fold" if name == "run" else "ellipsis", no_wrap=name != "run")
        for directory, status in zip(self._directories, self._statuses, strict=True):
            if status.state not in ("waiting", "done"):
                cells = (_format_state(status), _format_steps(status), _format_psnr(status), status.text)
                table.add_row(*(Text(cell) for cell in (directory.name, *cells)))
        yield table
        counts = Counter(status.state for status in self._statuses)
        yield Text("  ".join(f"{count} {state}" for state, count in counts.items()))


def _format_state(status: JobStatus) -> str:
    return status.state + (f", try {status.attempt + 1}" if status.attempt else "")


def _format_steps(status: JobStatus) -> str:
    return f"step {status.step:,} ({status.progress:.0%})" if status.step else ""


def _format_psnr(status: JobStatus, unit: str = "") -> str:
    return "" if status.psnr is None else f"{status.psnr:.2f}{unit}"


# ---------------------------------------------------------------- a run in this process


def run_command_here(
    config: RunConfig,
    typed: CommandLine,
    viewer: ViewerSettings | None = None,
    launcher: LauncherSettings | None = None,
) -> Path:
    """Run one configuration in this process and return its directory.

    After Ctrl-C, the message of the KeyboardInterrupt has the run's directory and the command that continues the run.

    Args:
        viewer: settings of the live viewer in the browser; None for no viewer.
        launcher: where to train the parts of a scene that ``scene.chunks`` divides; None: in this process.
    """
    from neuprim.runs.run import run

    try:
        with RunProgress(f"{config.task}/{config.scene_name}") as events:
            if viewer is not None:
                return _run_with_viewer(config, events, viewer)
            return run(config, events, launcher=launcher or LauncherSettings())
    except KeyboardInterrupt:
        raise KeyboardInterrupt(describe_interrupted_command(config.output_dir, typed)) from None


def print_run_summary(run_dir: Path) -> None:
    """Print the quality of a finished run, the path of its report, and a next command to try."""
    from neuprim.runs.run import summarize_run

    print(summarize_run(run_dir))
    words = ["view", str(run_dir)] if find_spec("viser") is not None else ["render", str(run_dir), "--camera", "orbit"]
    print(f"next: {shlex.join(['neuprim', *words])}", flush=True)


def _run_with_viewer(config: RunConfig, events: RunProgress, settings: ViewerSettings) -> Path:
    from neuprim.runs.run import run
    from neuprim.viewer.view import LiveTraining

    warn_of_open_host(settings)
    with LiveTraining(settings, config, lambda address: events(Note(f"the viewer is at {address}")), events) as live:
        return run(config, live, live.between)


def warn_of_open_host(settings: ViewerSettings) -> None:
    """Print a warning if other machines can reach the viewer's address."""
    from neuprim.viewer.server import is_loopback

    if not is_loopback(settings.host):
        port = settings.port or 8080
        print(
            f"neuprim: warning: other machines can reach the viewer at {settings.host}, without encryption: whoever "
            "can read the network can read its token. Safer: leave the host out, and type on the other machine "
            f"`ssh -L {port}:{LOOPBACK}:{port} THIS_MACHINE`",
            file=sys.stderr,
        )
