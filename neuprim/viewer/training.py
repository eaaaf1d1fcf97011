"""A page beside a training: it draws between two steps, on the training's own thread, and leaves every bit of the model
as it would be without.

No step runs while a picture is drawn, so there is nothing to copy and nobody to wait for; the time of the budget stands
still meanwhile, as it does for the points of the held-out curve. Without anybody who looks, a step costs one question:
whether somebody asked for something.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from types import TracebackType
from typing import Self

import numpy as np

from neuprim.config import RunConfig
from neuprim.config.viewer import ViewerSettings
from neuprim.runs.events import Event, Events, Finishing, Note
from neuprim.runs.fit import Fitted
from neuprim.runs.training import save
from neuprim.viewer.desk import Desk
from neuprim.viewer.page import Page
from neuprim.viewer.progress import TrainingProgress
from neuprim.viewer.server import PageServer
from neuprim.viewer.session import Session
from neuprim.viewer.subject import Subject
from neuprim.viewer.training_controls import TrainingControls

__all__ = ["LiveTraining"]

_SHOW = 0.5
"""Seconds between two updates of the numbers in a page."""

_WAIT = 0.1
"""Seconds after which a training that stands still looks whether it is to end."""


class LiveTraining:
    """Context manager around a run, whose events it is called with and between whose steps :meth:`between` is called.

    Attributes:
        progress: of the training.
        paused: whether the training stands still.
        address: of the page, with its token.
    """

    def __init__(
        self, settings: ViewerSettings, config: RunConfig, opened: Callable[[str], None], events: Events
    ) -> None:
        """Opens the page; raises as :class:`~neuprim.viewer.server.PageServer`.

        Args:
            opened: told the address.
            events: also told everything that happens.
        """
        self.config, self.events = config, events
        self.desk, self.progress, self.paused = Desk(), TrainingProgress(), False
        self._steps, self._save, self._stop = 0, False, False
        self._controls: list[TrainingControls] = []
        self._page: Page | None = None
        self._shown = 0.0
        self._server = PageServer(settings, config.output_dir.name)
        self.address = self._server.address
        opened(self.address)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.close()

    def __call__(self, event: Event) -> None:
        """Listens."""
        self.progress(event)
        self.events(event)
        if isinstance(event, Finishing):
            for controls in self._controls:
                controls.session.tell(
                    f"the training has ended, {event.text}; afterwards `neuprim view {self.config.output_dir}` shows it"
                )

    # ------------------------------------------------------------ what a page may order, from any thread

    def pause(self, paused: bool) -> None:
        """Let the training stand still, or go on."""
        if paused != self.paused:
            self.events(Note("paused by its viewer" if paused else "goes on"))
        self.paused = paused

    def one_step(self) -> None:
        """Of a training that stands still."""
        self.pause(True)
        self._steps += 1

    def checkpoint(self) -> None:
        """Have checkpoint and model written before the next step."""
        self._save = True

    def stop(self) -> None:
        """End the training as Ctrl-C does: measured, reported, and ready to be resumed."""
        self._stop = True

    # ------------------------------------------------------------ between steps

    def between(self, fitted: Fitted, stop: threading.Event) -> None:
        """See :data:`~neuprim.runs.training.Between`."""
        if self._page is None:
            self._page = Page(self._server, self._subject(fitted), self.desk, None, self._add_controls)
        if not (self.desk.waiting or self.paused or self._save or self._stop):
            return
        self.desk.work(0.0)
        self._tell()
        while self._obey(fitted, stop):
            self.desk.work(_WAIT)
            self._tell()

    def _obey(self, fitted: Fitted, stop: threading.Event) -> bool:
        """Do what was ordered; whether the training is to stand still."""
        if self._stop:
            stop.set()
        if self._save:
            self._save = False
            save(fitted)
            for controls in self._controls:
                controls.session.tell(f"step {fitted.trainer.step} is saved in {self.config.output_dir}")
        if stop.is_set() or not self.paused:
            return False
        if self._steps:
            self._steps -= 1
            return False
        return True

    def _tell(self) -> None:
        now = time.monotonic()
        if now < self._shown + _SHOW:
            return
        self._shown = now
        self._controls = [controls for controls in self._controls if not controls.session.gone]
        for controls in self._controls:
            controls.show()

    def _add_controls(self, session: Session) -> None:
        self._controls.append(TrainingControls(session, self))

    def _subject(self, fitted: Fitted) -> Subject:
        dataset = fitted.dataset
        x, y, z = (float(value) for value in dataset.up)
        task = replace(fitted.task, conditions=tuple(spec.within(dataset.world) for spec in fitted.task.conditions))
        own = (
            task,
            lambda: fitted.trainer.model,
            fitted.channels,
            fitted.trainer.renderer,
            dataset.background,
            (x, y, z),
        )
        return Subject(
            self.config.output_dir.name,
            *own,
            center=np.asarray(dataset.center.numpy()),
            world=dataset.world,
            dataset=dataset,
        )
