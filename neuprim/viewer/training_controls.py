"""What a page shows of a training, and the orders that it gives."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np

from neuprim.viewer.progress import Series, TrainingProgress
from neuprim.viewer.session import Session

__all__ = ["Orders", "TrainingControls"]

_HEIGHT = 150  # pixels of a curve


class Orders(Protocol):
    """Whoever trains; every method may be called from any thread."""

    progress: TrainingProgress
    paused: bool

    def pause(self, paused: bool) -> None: ...
    def one_step(self) -> None: ...
    def checkpoint(self) -> None: ...
    def stop(self) -> None: ...


class TrainingControls:
    """Progress, buttons and curves of one page."""

    def __init__(self, session: Session, orders: Orders) -> None:
        self.session, self.orders = session, orders
        gui = session.client.gui
        self._text = gui.add_text("training", orders.progress.text, disabled=True)
        self._bar = gui.add_progress_bar(100 * orders.progress.fraction)
        self._pause = gui.add_checkbox("pause", orders.paused)
        self._pause.on_update(lambda _: orders.pause(bool(self._pause.value)))
        buttons = gui.add_button_group(
            "", ["one step", "checkpoint", "stop"], hint="stop ends it as Ctrl-C does: it can be resumed"
        )
        calls = {"one step": self._one, "checkpoint": orders.checkpoint, "stop": self._stop}
        buttons.on_click(lambda _: calls[buttons.value]())
        self._curves = {"training views": orders.progress.seen, "held-out views": orders.progress.held_out}
        self._plots: dict[str, Any] = {}
        self._sent: dict[str, int] = dict.fromkeys(self._curves, -1)
        self._folder = gui.add_folder("PSNR, dB")

    def show(self) -> None:
        """The numbers of now."""
        progress = self.orders.progress
        self._text.value, self._bar.value = progress.text, 100 * progress.fraction
        if self._pause.value != self.orders.paused:
            self._pause.value = self.orders.paused
        for name, series in self._curves.items():
            if len(series.x) > 1 and len(series.x) != self._sent[name]:
                self._sent[name] = len(series.x)
                self._draw(name, series)

    def _draw(self, name: str, series: Series) -> None:
        data: tuple[np.ndarray, ...] = series.arrays()
        if name in self._plots:
            self._plots[name].data = data
            return
        from viser import uplot

        lines = (uplot.Series(label="step"), uplot.Series(label=name, stroke="#ff8a3d", width=2))
        axes = (uplot.Axis(stroke="#aaaaaa"), uplot.Axis(stroke="#aaaaaa"))
        scales = {"x": uplot.Scale(time=False)}
        with self._folder:
            self._plots[name] = self.session.client.gui.add_uplot(data, lines, scales=scales, axes=axes, height=_HEIGHT)

    def _one(self) -> None:
        self.orders.one_step()

    def _stop(self) -> None:
        self.orders.stop()
        self.session.say("the training ends after this step")
