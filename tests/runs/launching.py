"""Jobs for the tests of launchers: each a function that a worker finds by its name."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import neuprim.runs.evaluate
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.compute.threads import core_count
from neuprim.core.errors import DataError
from neuprim.runs.fit import Event, Events, Preparing, Step
from neuprim.runs.launch.jobs import LaunchJob
from neuprim.runs.run import fit_job

PHASES = ("loading", "training")
"""Without a checkpoint, and with one; tests/runs/test_resume.py kills at any moment."""


def job(name: str, function: Any, data: Any = None) -> LaunchJob:
    return LaunchJob(name, f"{__name__}:{function.__name__}", data)


def processes(workers: int = 1, **more: Any) -> LauncherSettings:
    return LauncherSettings("processes", workers, **more)


def double(data: int, attempt: int, events: Events) -> int:
    return 2 * data


def share(data: None, attempt: int, events: Events) -> tuple[int, str, int]:
    import torch

    return core_count(), os.environ["OMP_NUM_THREADS"], torch.get_num_threads()


def refuse(data: str, attempt: int, events: Events) -> None:
    raise DataError(data)


def bug(data: None, attempt: int, events: Events) -> None:
    raise ZeroDivisionError("a bug")


def die(data: int, attempt: int, events: Events) -> int:
    """Killed as often as ``data`` says."""
    print("about to die", flush=True)
    if attempt < data:
        os.kill(os.getpid(), signal.SIGKILL)
    return attempt


def doze(data: float, attempt: int, events: Events) -> float:
    """Asleep for so many seconds, which Ctrl-C ends."""
    events(Preparing("dozing"))
    time.sleep(data)
    return data


def toil(data: float, attempt: int, events: Events) -> None:
    """Busy for so many seconds, as a training is."""
    events(Preparing("at it"))
    late = time.monotonic() + data
    while time.monotonic() < late:
        time.sleep(0.01)


def fit_and_die(data: Mapping[str, Any], attempt: int, events: Events) -> str:
    """A run whose worker is killed in a phase, the first time; without film."""
    neuprim.runs.evaluate._ORBIT_FRAMES = 2
    phase = data["phase"] if attempt == 0 else None

    def heard(event: Event) -> None:
        events(event)
        now = "loading" if isinstance(event, Preparing) else ""
        if isinstance(event, Step) and event.report.step == 40:
            now = "training"
        if now == phase:
            os.kill(os.getpid(), signal.SIGKILL)

    return fit_job(data["config"], attempt, heard)


def wait_for(file: Path, seconds: float = 60.0) -> None:
    late = time.monotonic() + seconds
    while not file.exists():
        assert time.monotonic() < late, f"{file} is not there"
        time.sleep(0.05)
