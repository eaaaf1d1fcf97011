"""Primitives as ellipsoids over the picture, and one of them chosen by its number or by a click."""

from __future__ import annotations

from typing import Any

import numpy as np

from neuprim.inspect.shapes import unit_sphere
from neuprim.viewer.primitives import Ellipsoids, described, ellipsoid_of, ellipsoids_of, strongest
from neuprim.viewer.session import Session

__all__ = ["PrimitiveControls"]

_NONE, _WIRE, _SOLID = "none", "wire", "solid"
_MOST, _FIRST = 20_000, 1_000


class PrimitiveControls:
    """Which ellipsoids are drawn, and what is said of the chosen one."""

    def __init__(self, session: Session) -> None:
        self.session = session
        gui, scene = session.client.gui, session.client.scene
        self._balls = {False: unit_sphere(1), True: unit_sphere(2)}  # of many, and of one
        self._drawn: list[Any] = []
        self._mark: Any = None
        self._how = gui.add_dropdown("ellipsoids", [_NONE, _WIRE, _SOLID], initial_value=_NONE)
        self._most = gui.add_slider("at most", 100, _MOST, 100, _FIRST, hint="those that absorb most")
        self._click = gui.add_checkbox(
            "choose by a click", False, hint="the primitive that contributes most under the mouse"
        )
        self._row = gui.add_number("primitive", -1, min=-1, step=1, hint="its number; -1 for none")
        self._text = gui.add_text("its parameters", "", multiline=True, disabled=True)
        for control in (self._how, self._most):
            control.on_update(lambda _: self.refresh())
        self._row.on_update(lambda _: self.session.ask("primitive", self._describe))
        self._click.on_update(lambda _: self._listen(scene))

    def refresh(self) -> None:
        """Draw the ellipsoids anew, as after a change of conditions."""
        self.session.ask("ellipsoids", self._draw)
        if int(self._row.value) >= 0:
            self.session.ask("primitive", self._describe)

    def _listen(self, scene: Any) -> None:
        if not self._click.value:
            scene.remove_click_callback()
            return

        @scene.on_click()
        def _(event: Any) -> None:
            direction = np.asarray(event.ray_direction, np.float64)
            self.session.ask("click", lambda: self._choose(direction))

    def _choose(self, direction: np.ndarray) -> None:
        session = self.session
        row = strongest(session.subject.model(), session.look(), direction, session.settings)
        if row is None:
            session.say("nothing is there")
        else:
            self._row.value = row  # which calls back

    def _draw(self) -> None:
        for handle in self._drawn:
            handle.remove()
        self._drawn = []
        if self._how.value == _NONE:
            return
        session = self.session
        found = ellipsoids_of(session.subject.model(), session.look(), session.subject.channels, int(self._most.value))
        if len(found.rows):
            self._drawn.append(self._add("/ellipsoids", found, wire=self._how.value == _WIRE))

    def _describe(self) -> None:
        if self._mark is not None:
            self._mark.remove()
            self._mark = None
        row, session = int(self._row.value), self.session
        if row < 0:
            self._text.value = ""
            return
        model = session.subject.model()
        found = ellipsoid_of(model, session.look(), row)
        self._text.value = described(model, row) + ("" if found is not None else "\nit does not live in this frame")
        if found is not None:
            self._mark = self._add("/chosen", found, wire=True)

    def _add(self, name: str, found: Ellipsoids, wire: bool) -> Any:
        points, faces = self._balls[len(found.rows) == 1]
        return self.session.client.scene.add_batched_meshes_simple(
            name,
            points.astype(np.float32),
            faces.astype(np.uint32),
            batched_wxyzs=found.wxyz,
            batched_positions=found.positions,
            batched_scales=found.scales,
            batched_colors=found.colours,
            wireframe=wire,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
