"""Panels of inspectors in one pyvista window: on screen with a slider, or as pictures."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from neuprim.core.extensions import Inspector
from neuprim.inspect.drawing import add_box, add_layers
from neuprim.inspect.field import FieldFrame
from neuprim.inspect.stands import stand_of

__all__ = ["Window", "panels_of"]

Panel = tuple[Inspector, str]
_PANEL = (720, 640)


def panels_of(inspectors: Sequence[Inspector], with_truth: bool) -> list[Panel]:
    """(inspector, side) of each panel: a view of the extinction is shown twice where there is a truth."""
    return [
        (i, side)
        for i in inspectors
        for side in (("model", "truth") if with_truth and i.shows == "sigma" else ("model",))
    ]


class Window:
    """A plotter with one panel per (inspector, side); panels of the scene share one camera, that of a single primitive
    has its own.

    Args:
        size: of the picture in pixels; None for 720 x 640 per panel.
    """

    def __init__(self, panels: Sequence[Panel], up: str, off_screen: bool, size: tuple[int, int] | None = None) -> None:
        import pyvista

        self.panels = list(panels)
        paired = any(
            side == "truth" for _, side in panels
        )  # then each row has a view of the model and the same of the truth
        columns = len(panels) if len(panels) <= 3 else 2 if paired else -(-len(panels) // 2)
        self.shape = (-(-len(panels) // columns), columns)
        asked = size or (columns * _PANEL[0], self.shape[0] * _PANEL[1])
        make: Any = pyvista.Plotter
        self.plotter = make(shape=self.shape, off_screen=off_screen, window_size=list(asked), border_color="#39424c")
        self._up, self._placed = up, False
        for panel in range(self.shape[0] * self.shape[1]):
            self._enter(panel)
            self.plotter.set_background("#0d1117", top="#27303a", all_renderers=False)

    def _enter(self, panel: int) -> None:
        self.plotter.subplot(*divmod(panel, self.shape[1]))

    def draw(self, frame: FieldFrame) -> None:
        """Replaces what is in the panels."""
        for title in list(self.plotter.scalar_bars.keys()):
            self.plotter.remove_scalar_bar(title, render=False)
        for panel, (inspector, side) in enumerate(self.panels):
            self._enter(panel)
            self.plotter.renderer.clear_actors()
            part = frame.of_side(side)
            add_layers(self.plotter, inspector.layers(part), panel)
            if inspector.shows != "primitive":
                add_box(self.plotter, part.box)
            self.plotter.add_text(
                _caption(inspector, part), position="upper_left", font_size=10, color="white", name="caption"
            )
            self.plotter.add_axes(color="white", line_width=2)
        if not self._placed:
            self._place(frame)

    def _place(self, frame: FieldFrame) -> None:
        linked = [i for i, (inspector, _) in enumerate(self.panels) if inspector.shows != "primitive"]
        for panel, (inspector, _) in enumerate(self.panels):
            self._enter(panel)
            stand, camera = stand_of(inspector, frame, self._up), self.plotter.camera
            camera.focal_point, camera.up = stand.focus, stand.up
            camera.position = stand.focus + stand.away * stand.radius / np.sin(np.radians(camera.view_angle) / 2)
            self.plotter.renderer.reset_camera_clipping_range()
        if len(linked) > 1:
            self.plotter.link_views(linked)
        self._placed = True

    def picture(self) -> np.ndarray:
        """(H, W, 3) uint8 of what was drawn last."""
        self.plotter.render()
        return np.asarray(self.plotter.screenshot(return_img=True))[..., :3]

    def interact(self, count: int, frame: Callable[[int], FieldFrame]) -> None:
        """Shows the window, with a slider for more than one frame, until the user closes it."""
        self.add_slider(count, frame)
        self.draw(frame(0))
        self.plotter.show()

    def add_slider(self, count: int, frame: Callable[[int], FieldFrame]) -> None:
        """A slider over ``count`` frames; each is drawn when the slider comes to it."""
        if count < 2:
            return
        shown = [0]

        def moved(value: float) -> None:
            wanted = min(max(round(value) - 1, 0), count - 1)
            if wanted != shown[0]:
                shown[0] = wanted
                self.draw(frame(wanted))

        self._enter(0)
        self.plotter.add_slider_widget(
            moved,
            (1, count),
            value=1,
            title="frame",
            fmt="%.0f",
            pointa=(0.62, 0.93),
            pointb=(0.95, 0.93),
            color="white",
            title_height=0.02,
        )

    def close(self) -> None:
        """Frees the window."""
        self.plotter.close()


def _caption(inspector: Inspector, frame: FieldFrame) -> str:
    first = frame.truth_name or "ground truth" if frame.side == "truth" else frame.title or "model"
    lines = [f"{inspector.name}: {'ground truth, ' if frame.side == 'truth' else ''}{first}"]
    if frame.numbers and frame.side == "model" and inspector.shows in ("sigma", "both"):
        lines.append(f"correlation {frame.numbers['correlation']:.3f}   relative L2 {frame.numbers['relative_l2']:.3f}")
    return "\n".join(lines)
