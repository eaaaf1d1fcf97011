"""What commands show while they work: a bar with ETA, PSNR and primitive count on a terminal, a line now and then
elsewhere."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from neuprim.runs.events import Evaluated, Event, Finishing, Note, Preparing, Step

__all__ = ["DrawProgress", "LineProgress", "RunProgress", "print_notes"]


class _Shown:
    """Context manager: the bar is there inside."""

    bar: Progress

    def __enter__(self) -> Self:
        self.bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.bar.stop()


class RunProgress(_Shown):
    """Context manager around one run, whose events it is called with."""

    def __init__(self, console: Console, title: str) -> None:
        self.console, self.title = console, title
        self.live = console.is_terminal
        self.bar = Progress(
            TextColumn("{task.description}", style="bold", markup=False),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f}%"),
            TimeElapsedColumn(),
            TextColumn("eta"),
            TimeRemainingColumn(),
            TextColumn("{task.fields[info]}", markup=False),
            console=console,
            disable=not self.live,
        )
        self.task: TaskID = self.bar.add_task(title, total=1.0, info="")
        self._stage = ""
        self._printed = -1.0
        self._smooth: float | None = None
        self._held_out = ""

    def __call__(self, event: Event) -> None:
        """Shows one event."""
        match event:
            case Preparing():
                self._preparing(event)
            case Step():
                self._step(event)
            case Evaluated():
                self._held_out = f"  held-out {event.psnr:.2f} dB"
            case Finishing():
                self._finishing(event)
            case Note():
                self._note(event.text)

    def _note(self, text: str) -> None:
        self.console.print(f"{self.title}: {text}", highlight=False, soft_wrap=True, markup=False, emoji=False)

    def _preparing(self, event: Preparing) -> None:
        text, fraction = event.text, event.fraction
        self.bar.update(self.task, description=self.title, completed=fraction, info=text)
        if not self.live and (text != self._stage or fraction >= self._printed + 0.25):
            self._printed = fraction
            self._note(f"{text}, {fraction:.0%}" if fraction > 0 else text)
        self._stage = text

    def _step(self, event: Step) -> None:
        report, progress = event.report, event.progress
        self._smooth = report.psnr if self._smooth is None else 0.98 * self._smooth + 0.02 * report.psnr
        if self._stage != "training":
            self._stage, self._printed = "training", -1.0
            self.bar.reset(self.task)
        info = f"step {report.step}  train {self._smooth:.2f} dB{self._held_out}  {report.primitives} primitives"
        self.bar.update(self.task, completed=progress, info=info)
        if not self.live and progress >= self._printed + 0.1:
            self._printed = progress
            self._note(f"{progress:4.0%}  {report.seconds:6.1f} s  {info}")

    def _finishing(self, event: Finishing) -> None:
        self.bar.update(self.task, completed=1.0, info=event.text)
        if not self.live:
            self._note(event.text)


class DrawProgress(_Shown):
    """Context manager around the drawing of images: a bar on a terminal that is gone afterwards, a line now and then
    elsewhere."""

    def __init__(self, console: Console) -> None:
        self.console = console
        self.live = console.is_terminal
        columns = (
            TextColumn("{task.description}", markup=False),
            BarColumn(),
            TextColumn("{task.percentage:>3.0f}%"),
            TextColumn("eta"),
            TimeRemainingColumn(),
        )
        self.bar = Progress(*columns, console=console, transient=True, disable=not self.live)
        self.task: TaskID = self.bar.add_task("", total=1.0)
        self._started = time.monotonic()

    def note(self, text: str) -> None:
        """A line that stays."""
        self.console.print(f"neuprim: {text}", highlight=False, soft_wrap=True, markup=False, emoji=False)

    def show(self, text: str, fraction: float) -> None:
        """How far it is; without a terminal, every half a minute."""
        self.bar.update(self.task, description=text, completed=fraction)
        if not self.live and fraction < 1.0 and time.monotonic() > self._started + 30.0:
            self._started = time.monotonic()
            self.note(f"{text}, {fraction:.0%}")


class LineProgress:
    """A line per stage and quarter."""

    def __init__(self, console: Console) -> None:
        self.console, self.last = console, ("", -1.0)

    def __call__(self, text: str, fraction: float) -> None:
        if text != self.last[0] or fraction >= self.last[1] + 0.25:
            self.last = (text, fraction)
            self.console.print(f"{text}, {fraction:.0%}" if fraction > 0 else text, highlight=False, soft_wrap=True)


def print_notes(event: Event) -> None:
    """On standard output, for commands whose notes are what they were asked for."""
    if isinstance(event, Note):
        print(event.text)
