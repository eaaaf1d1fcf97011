"""Browser viewers of a finished run (``neuprim view``) and of a running training.

During a training, images are rendered between two training steps, on the training thread. The trained model is
bit-identical to a model trained without a viewer. Rendering time does not count towards the training budget. While no
page is open, the viewer only checks its queue of jobs once per training step.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from neuprim.config import RunConfig
from neuprim.config.command_settings import ViewerSettings
from neuprim.runs.fit import Evaluated, Event, Events, Finishing, Fitted, Note, Preparing, Step
from neuprim.runs.training import save_run_training
from neuprim.viewer.controls import SessionManager
from neuprim.viewer.server import ViewerServer
from neuprim.viewer.session import RenderQueue, Session
from neuprim.viewer.viewer_scene import ViewerScene, Viewpoint, open_viewer_scene

__all__ = ["view_run"]

_POLL_SECONDS = 0.25  # between checks whether the viewer is to end
_UPDATE_SECONDS = 0.5  # between updates of a page's numbers
_PAUSE_SECONDS = 0.1  # between checks of a paused training
_PLOT_HEIGHT, _PLOT_POINTS = 150, 1000  # pixels; points of a curve
_SMOOTHING = 0.98


def view_run(
    run_dir: Path,
    settings: ViewerSettings,
    on_open: Callable[[str], None],
    warn: Callable[[str], None] = lambda text: None,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
    end: threading.Event | None = None,
) -> None:
    """Show a finished run in the browser until ``end`` is set or the user presses Ctrl-C.

    Args:
        on_open: function that is called with the address of the page, including its token.

    Raises:
        CheckpointError: a file of the run is missing or damaged.
        ConfigError: a setting is wrong.
    """
    end = end or threading.Event()
    queue, scene = RenderQueue(), open_viewer_scene(run_dir, warn, progress)
    progress("preparing the renderer", 0.0)  # the first image compiles kernels, once per installation
    start = scene.start_view
    scene.draw(Viewpoint(start.camera.resized(32, 32), start.conditions), scene.settings)
    server = ViewerServer(settings, scene.name)
    try:
        SessionManager(server, scene, queue)
        on_open(server.address)
        while not end.is_set():
            queue.work(_POLL_SECONDS)
    finally:
        server.close()


# ---------------------------------------------------------------- a running training


class TrainingProgress:
    """Event listener that collects a training's progress for the viewer's pages.

    Attributes:
        fraction: used fraction of the budget, 0..1.
        text: the current activity of the run, for the user.
        curves: "training views" (smoothed) or "held-out views" -> points (training step, PSNR in dB).
    """

    def __init__(self) -> None:
        self.step, self.fraction, self.text = 0, 0.0, ""
        self.curves: dict[str, list[tuple[int, float]]] = {"training views": [], "held-out views": []}
        self._mean: float | None = None

    def __call__(self, event: Event) -> None:
        match event:
            case Step():
                report = event.report
                self.step, self.fraction = report.step, event.progress
                if math.isfinite(report.psnr):
                    mean = report.psnr if self._mean is None else self._mean
                    self._mean = _SMOOTHING * mean + (1 - _SMOOTHING) * report.psnr
                    self.curves["training views"].append((report.step, self._mean))
                self.text = f"step {report.step}, {report.primitives:,} primitives, {report.seconds:.0f} s of training"
            case Evaluated() if math.isfinite(event.psnr):
                self.curves["held-out views"].append((self.step, event.psnr))
            case Preparing() | Finishing() as work:
                self.text = work.text


class TrainingControls:
    """Controls of a running training in one page: progress, buttons and PSNR curves."""

    def __init__(self, session: Session, training: LiveTraining) -> None:
        self.session, self.training = session, training
        gui, progress = session.client.gui, training.progress
        self._text = gui.add_text("training", progress.text, disabled=True)
        self._bar = gui.add_progress_bar(100 * progress.fraction)
        self._shown_paused = training.paused
        self._pause = gui.add_checkbox("pause", training.paused)
        self._pause.on_update(lambda _: training.pause(bool(self._pause.value)))
        hint = "stop ends it as Ctrl-C does: it can be resumed"
        buttons = gui.add_button_group("", ["one step", "checkpoint", "stop"], hint=hint)
        calls = {"one step": training.step_once, "checkpoint": training.checkpoint, "stop": self._stop}
        buttons.on_click(lambda _: calls[buttons.value]())
        self._plots: dict[str, Any] = {}
        self._sent = dict.fromkeys(progress.curves, 1)
        self._folder = gui.add_folder("PSNR, dB")

    def refresh_progress(self) -> None:
        """Show the current progress and PSNR curves."""
        progress = self.training.progress
        self._text.value, self._bar.value = progress.text, 100 * progress.fraction
        if self._shown_paused != self.training.paused:  # comparing its value could undo a click
            self._shown_paused = self._pause.value = self.training.paused
        for name, curve in progress.curves.items():
            if len(curve) > self._sent[name]:
                self._sent[name] = len(curve)
                self._plot_curve(name, np.array(curve[:: -(-len(curve) // _PLOT_POINTS)], np.float64))

    def _plot_curve(self, name: str, points: np.ndarray) -> None:
        data = (points[:, 0].copy(), points[:, 1].copy())
        if name in self._plots:
            self._plots[name].data = data
            return
        from viser import uplot

        lines = (uplot.Series(label="step"), uplot.Series(label=name, stroke="#ff8a3d", width=2))
        axes = (uplot.Axis(stroke="#aaaaaa"), uplot.Axis(stroke="#aaaaaa"))
        scales = {"x": uplot.Scale(time=False)}
        gui = self.session.client.gui
        with self._folder:
            self._plots[name] = gui.add_uplot(data, lines, scales=scales, axes=axes, height=_PLOT_HEIGHT)

    def _stop(self) -> None:
        self.training.stop()
        self.session.set_status("the training ends after this step")


class LiveTraining:
    """Viewer of a running training: a context manager around the run, and a callable that receives the run's events.

    The training calls :meth:`between` between two training steps.

    Raises:
        ConfigError, BackendUnavailable: see :class:`~neuprim.viewer.server.ViewerServer`.
    """

    def __init__(
        self, settings: ViewerSettings, config: RunConfig, on_open: Callable[[str], None], events: Events
    ) -> None:
        """Start the server; call ``on_open`` with the address of the page. ``events`` also gets every event."""
        self.config, self.events = config, events
        self.queue, self.progress, self.paused = RenderQueue(), TrainingProgress(), False
        self._steps, self._save, self._stop = 0, False, False
        self._controls: list[TrainingControls] = []
        self._sessions: SessionManager | None = None
        self._updated = 0.0
        self._server = ViewerServer(settings, config.output_dir.name)
        self.address = self._server.address
        on_open(self.address)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self._server.close()

    def __call__(self, event: Event) -> None:
        self.progress(event)
        self.events(event)
        if isinstance(event, Finishing):
            self._notify_all(
                f"the training has ended, {event.text}; afterwards `neuprim view {self.config.output_dir}` shows it"
            )

    # Called by pages, from any thread.

    def pause(self, paused: bool) -> None:
        """Pause or continue the training."""
        if paused != self.paused:
            self.events(Note("paused by its viewer" if paused else "goes on"))
        self.paused = paused

    def step_once(self) -> None:
        """Pause the training, then let it run one step."""
        self.pause(True)
        self._steps += 1

    def checkpoint(self) -> None:
        """Write checkpoint and model before the next step."""
        self._save = True

    def stop(self) -> None:
        """End the training like Ctrl-C: the run is evaluated, gets a report, and can be resumed."""
        self._stop = True

    # Called by the training.

    def between(self, fitted: Fitted, stop: threading.Event) -> None:
        """Render images for the pages and carry out their requests, e.g. pause; called between two training steps.

        Setting ``stop`` ends the training. See :data:`~neuprim.runs.training.BetweenSteps`.
        """
        if self._sessions is None:
            scene = self._make_scene(fitted)
            self._sessions = SessionManager(
                self._server, scene, self.queue, lambda session: self._controls.append(TrainingControls(session, self))
            )
        if not (self.queue.pending or self.paused or self._save or self._stop):
            return
        self.queue.work(0.0)
        self._update_pages()
        while self._carry_out_orders(fitted, stop):
            self.queue.work(_PAUSE_SECONDS)
            self._update_pages()

    def _carry_out_orders(self, fitted: Fitted, stop: threading.Event) -> bool:
        """Carry out what pages requested (stop, save, one step); return whether the training is still paused."""
        if self._stop:
            stop.set()
        if self._save:
            self._save = False
            save_run_training(fitted)
            self._notify_all(f"step {fitted.trainer.step} is saved in {self.config.output_dir}")
        if stop.is_set() or not self.paused:
            return False
        if self._steps:
            self._steps -= 1
            return False
        return True

    def _notify_all(self, text: str) -> None:
        for controls in self._controls:
            controls.session.notify(text)

    def _update_pages(self) -> None:
        now = time.monotonic()
        if now < self._updated + _UPDATE_SECONDS:
            return
        self._updated = now
        self._controls = [controls for controls in self._controls if not controls.session.closed]
        for controls in self._controls:
            controls.refresh_progress()

    def _make_scene(self, fitted: Fitted) -> ViewerScene:
        dataset = fitted.dataset
        conditions = tuple(spec.within(replace(dataset.world, up=dataset.up)) for spec in fitted.task.conditions)
        return ViewerScene(
            name=self.config.output_dir.name,
            task=replace(fitted.task, conditions=conditions),
            model=lambda: fitted.trainer.model,
            channels=fitted.channels,
            settings=fitted.trainer.renderer,
            background=dataset.background,
            up=tuple(dataset.up.tolist()),
            center=np.asarray(dataset.center.numpy()),
            world=dataset.world,
            dataset=dataset,
        )
