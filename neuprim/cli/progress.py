"""Show the progress of commands: a bar on a terminal, otherwise a line now and then."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from neuprim.cli.command import plain_console
from neuprim.runs.fit import Evaluated, Event, Finishing, Note, Preparing, Step


class _Bar:
    """Context manager: the bar is there inside."""

    def __init__(self, console: Console | None, columns: tuple[ProgressColumn, ...], transient: bool) -> None:
        self.console = console or plain_console(stderr=True)
        self.live = self.console.is_terminal
        left = (TextColumn("{task.description}", markup=False), BarColumn(), TextColumn("{task.percentage:>3.0f}%"))
        self.bar = Progress(*left, *columns, console=self.console, transient=transient, disable=not self.live)
        self.task = self.bar.add_task("", total=1.0, info="")

    def __enter__(self) -> Self:
        self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bar.stop()


class RunProgress(_Bar):
    """Context manager around one run, which calls it with its events.

    Args:
        search: whether many short trainings follow each other; without a terminal only notes are shown then.
    """

    def __init__(self, title: str, console: Console | None = None, search: bool = False) -> None:
        info = TextColumn("{task.fields[info]}", markup=False)
        super().__init__(console, (TimeElapsedColumn(), TextColumn("eta"), TimeRemainingColumn(), info), False)
        self.title, self._quiet = title, search and not self.live
        self._stage, self._printed = "", -1.0
        self._smooth: float | None = None
        self._held_out = ""

    def __call__(self, event: Event) -> None:
        """Show one event."""
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
        if not self.live and (text != self._stage or fraction >= self._printed + 0.25):
            self._printed = fraction
            self._print(f"{text}, {fraction:.0%}" if fraction > 0 else text)
        self._stage = text

    def _show_step(self, event: Step) -> None:
        report, progress = event.report, event.progress
        self._smooth = report.psnr if self._smooth is None else 0.98 * self._smooth + 0.02 * report.psnr
        if self._stage != "training":
            self._stage, self._printed = "training", -1.0
            self.bar.reset(self.task)
        info = f"step {report.step}  train {self._smooth:.2f} dB{self._held_out}  {report.primitives} primitives"
        self.bar.update(self.task, completed=progress, info=info)
        if not self.live and progress >= self._printed + 0.1:
            self._printed = progress
            self._print(f"{progress:4.0%}  {report.seconds:6.1f} s  {info}")


class DrawProgress(_Bar):
    """Context manager around the drawing of images; the bar is gone afterwards."""

    def __init__(self, console: Console | None = None) -> None:
        super().__init__(console, (TextColumn("eta"), TimeRemainingColumn()), True)
        self._started = time.monotonic()

    def note(self, text: str) -> None:
        """Print a line that stays."""
        self.console.print(f"neuprim: {text}")

    def show(self, text: str, fraction: float) -> None:
        """Show how far it is; without a terminal, every half a minute."""
        self.bar.update(self.task, description=text, completed=fraction)
        if not self.live and fraction < 1.0 and time.monotonic() > self._started + 30.0:
            self._started = time.monotonic()
            self.note(f"{text}, {fraction:.0%}")


class LineProgress:
    """Print a line per stage and quarter."""

    def __init__(self) -> None:
        self.console, self.last = plain_console(stderr=True), ("", -1.0)

    def __call__(self, text: str, fraction: float) -> None:
        if text != self.last[0] or fraction >= self.last[1] + 0.25:
            self.last = (text, fraction)
            self.console.print(f"{text}, {fraction:.0%}" if fraction > 0 else text)


def print_notes(event: Event) -> None:
    """Print notes on standard output, for commands whose notes are what they were asked for."""
    if isinstance(event, Note):
        print(event.text)
