"""What commands show while several runs work: one table on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from types import TracebackType
from typing import Self

from rich import box
from rich.console import Console, ConsoleOptions, RenderResult
from rich.live import Live
from rich.table import Table
from rich.text import Text

from neuprim.runs.launch.status import ENDED, Status

__all__ = ["LaunchProgress"]

_EVERY = 0.25
"""Share of a training between two lines, where there is no terminal."""

_ORDER = ("training", "finishing", "preparing", "starting", "failed", "interrupted", "done", "waiting")
"""Of states, where not all rows fit the screen: what happens before what is over."""


class LaunchProgress:
    """Context manager around several jobs, whose statuses it is called with."""

    def __init__(self, console: Console, names: Sequence[str]) -> None:
        self.console, self.names, self.live = console, names, console.is_terminal
        self._statuses = [Status()] * len(names)
        self._begun: dict[int, float] = {}
        self._said: dict[int, tuple[object, ...]] = {}
        self._shown = (
            Live(self, console=console, refresh_per_second=4, transient=False, redirect_stdout=True)
            if self.live
            else None
        )

    def __enter__(self) -> Self:
        if self._shown is not None:
            self._shown.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._shown is not None:
            self._shown.stop()

    def __call__(self, number: int, status: Status) -> None:
        """Shows a job's status."""
        before, self._statuses[number] = self._statuses[number], status
        if status.state != "waiting":
            self._begun.setdefault(number, time.monotonic())
        if status.state in ENDED and before.state not in ENDED:
            self._begun[number] = time.monotonic() - self._begun[number]  # from now on how long it took
        if not self.live:
            self._line(number, status)

    # ------------------------------------------------------------ lines

    def _line(self, number: int, status: Status) -> None:
        said = (
            status.state,
            int(status.progress / _EVERY) if status.state in ("training", "waiting") else 0,
            status.text.rpartition(", ")[0] or status.text if status.state == "waiting" else "",
            status.text.startswith("no sign"),
            status.attempt,
        )
        if self._said.get(number) == said or status.state in (
            "starting",
            "failed",
            "interrupted",
        ):  # of which the command speaks
            return
        self._said[number] = said
        if status.state == "done" and not status.step:
            return  # kept from before
        text = " ".join(filter(None, (_state(status), _steps(status), _psnr(status, " dB held out"), status.text)))
        self.console.print(f"{self.names[number]}: {text}", highlight=False, soft_wrap=True, markup=False, emoji=False)

    # ------------------------------------------------------------ table

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
        table.add_column("run", overflow="fold")
        table.add_column("state", no_wrap=True)
        for name in ("steps", "held-out dB", "seconds"):
            table.add_column(name, justify="right", no_wrap=True)
        table.add_column("", overflow="ellipsis", no_wrap=True)
        room = max(console.size.height - 6, 4)
        order = sorted(range(len(self.names)), key=lambda n: (_ORDER.index(self._statuses[n].state), n))
        for number in sorted(order[:room]):
            status = self._statuses[number]
            cells = (
                self.names[number],
                _state(status),
                _steps(status),
                _psnr(status),
                self._seconds(number),
                status.text,
            )
            table.add_row(*(Text(cell, style=_style(status)) for cell in cells))
        yield table
        counts = Counter(status.state for status in self._statuses)
        more = f"; {len(order) - room} not shown" if len(order) > room else ""
        yield Text("  ".join(f"{counts[state]} {state}" for state in _ORDER if counts[state]) + more)

    def _seconds(self, number: int) -> str:
        if number not in self._begun:
            return ""
        ended = self._statuses[number].state in ENDED
        return f"{self._begun[number] if ended else time.monotonic() - self._begun[number]:.0f}"


def _state(status: Status) -> str:
    return status.state + (f", try {status.attempt + 1}" if status.attempt else "")


def _steps(status: Status) -> str:
    return f"step {status.step:,} ({status.progress:.0%})" if status.step else ""


def _psnr(status: Status, unit: str = "") -> str:
    return "" if status.psnr is None else f"{status.psnr:.2f}{unit}"


def _style(status: Status) -> str:
    return {"failed": "red", "done": "green", "waiting": "dim"}.get(status.state, "")
