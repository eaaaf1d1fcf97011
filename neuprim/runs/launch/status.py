"""How far a job is: made of its events where it works, read from a file where somebody waits for it."""

from __future__ import annotations

import json
import os
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import Any

from neuprim.core.errors import ConfigError
from neuprim.core.io.plain import load_json
from neuprim.core.validation import validate
from neuprim.runs.events import Evaluated, Event, Finishing, Preparing, Step

__all__ = ["ENDED", "Listener", "Status", "read_status", "write_status"]

ENDED = ("done", "failed", "interrupted")


@dataclass(frozen=True)
class Status:
    """Of one job.

    Attributes:
        state: waiting, starting, preparing, training, finishing, one of :data:`ENDED`.
        text: what it does, or why it ended so.
        step, progress: of the training; the used fraction of its budget, 0..1.
        psnr: held out, the last point of the curve, dB.
        attempt: how often its worker died before.
        beat: counts up while its worker lives.
    """

    state: str = "waiting"
    text: str = ""
    step: int = 0
    progress: float = 0.0
    psnr: float | None = None
    attempt: int = 0
    beat: int = 0


class Listener:
    """Makes a status of a run's events."""

    def __init__(self, attempt: int = 0) -> None:
        self.status = Status("starting", attempt=attempt)

    def __call__(self, event: Event) -> None:
        now = self.status
        match event:
            case Preparing():
                share = f", {event.fraction:.0%}" if event.fraction > 0 else ""
                self.status = replace(now, state="preparing", text=f"{event.text}{share}")
            case Step():
                report = event.report
                self.status = replace(now, state="training", text="", step=report.step, progress=event.progress)
            case Evaluated():
                self.status = replace(now, psnr=event.psnr)
            case Finishing():
                self.status = replace(now, state="finishing", text=event.text)


def write_status(file: Path, status: Status) -> None:
    """Replaces the file. What cannot be written is left out: a display must not end a run, which finds out by itself
    that its disk is full."""
    draft = file.with_name(f".{file.name}.{os.getpid()}")
    try:
        draft.write_text(json.dumps(asdict(status)), encoding="utf-8")
        os.replace(draft, file)
    except OSError:
        draft.unlink(missing_ok=True)


def read_status(file: Path) -> Status | None:
    """None where there is none yet, or none that can be read."""
    try:
        data: Any = load_json(file.read_text(encoding="utf-8"))
        return validate(Status, {f.name: data[f.name] for f in fields(Status)})
    except (OSError, ValueError, KeyError, TypeError, RecursionError, ConfigError):
        return None
