"""What happens in a run while it works, as one stream: the console, a test or a viewer listens, and nothing here
prints.

A listener is a function of one event. It is called from the thread that trains, so what it takes is added to the step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from neuprim.core.train.trainer import StepReport


@dataclass(frozen=True)
class Preparing:
    """Work before the training loop; ``fraction`` of it done, 0..1."""

    text: str
    fraction: float = 0.0


@dataclass(frozen=True)
class Step:
    """One training step; ``progress`` is the used fraction of the budget, 0..1."""

    report: StepReport
    progress: float


@dataclass(frozen=True)
class Evaluated:
    """A new point of the held-out curve: mean PSNR of a few held-out views, dB."""

    psnr: float


@dataclass(frozen=True)
class Finishing:
    """Work after the training loop."""

    text: str


@dataclass(frozen=True)
class Note:
    """Something the user should know; it stays on the screen."""

    text: str


Event = Preparing | Step | Evaluated | Finishing | Note
Events = Callable[[Event], None]


def ignore_event(event: Event) -> None:
    """Nobody listens."""
