"""What is shown, at how many pixels, and the settings that trade accuracy for speed."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, get_args

from neuprim.core.errors import NeuprimError
from neuprim.core.settings import SortOrder
from neuprim.viewer.frame import quantities
from neuprim.viewer.session import LONGEST, Session

__all__ = ["RenderControls"]

_NUMBERS = ("samples", "alpha_max", "alpha_min", "transmittance_min", "near")
"""Settings that are numbers and that a picture depends on."""

_AS_SET = "settings below"


class RenderControls:
    """A list of quantities, a slider of pixels, and the renderer's settings; with ``words`` also those of operating
    points."""

    def __init__(self, session: Session, words: bool) -> None:
        self.session = session
        self._values: dict[str, Any] = {}
        gui = session.client.gui
        shows = gui.add_dropdown("show", quantities(session.subject.channels), initial_value=session.shows)
        shows.on_update(lambda _: self._show(shows.value))
        longest = gui.add_slider("pixels", 128, 2048, 32, LONGEST, hint="on the longer side of the full picture")
        longest.on_update(lambda _: self._pixels(int(longest.value)))
        with gui.add_folder("accuracy", expand_by_default=False):
            settings = session.settings
            self._inputs: dict[str, Any] = {
                "sort": gui.add_dropdown("sort", list(get_args(SortOrder)), initial_value=settings.sort)
            }
            for name in _NUMBERS:
                value = getattr(settings, name)
                self._inputs[name] = gui.add_number(
                    name, value, step=1 if isinstance(value, int) else min(1e-6, 1e-3 * value or 1e-6)
                )
            self._words = (
                gui.add_text(
                    "operating point", "", hint="as `neuprim render` takes it: resolution=0.5 density.neurons=1"
                )
                if words
                else None
            )
            front = session.subject.front.points if words else ()
            if front:
                names = [_AS_SET, *(" ".join(point) for point, _ in front)]
                chosen = gui.add_dropdown(
                    "measured", names, initial_value=_AS_SET, hint="the front that `neuprim tradeoff` found"
                )
                chosen.on_update(lambda _: self._choose("" if chosen.value == _AS_SET else chosen.value))
            for name, control in self._inputs.items():
                control.on_update(lambda event, name=name: self._set(name, event.target.value))
            if self._words is not None:
                self._words.on_update(lambda _: self._changed())

    def _show(self, quantity: str) -> None:
        self.session.shows = quantity
        self.session.changed()

    def _pixels(self, longest: int) -> None:
        self.session.longest = longest
        self.session.changed()

    def _choose(self, words: str) -> None:
        assert self._words is not None
        self._words.value = words

    def _set(self, name: str, value: Any) -> None:
        """A setting; the others keep numbers that a page would have rounded."""
        self._values[name] = type(getattr(self.session.subject.settings, name))(value)
        self._changed()

    def _changed(self) -> None:
        try:
            words = tuple((self._words.value if self._words is not None else "").split())
            self.session.set_settings(replace(self.session.subject.settings, **self._values), words)
        except NeuprimError as error:
            self.session.say(str(error))  # words may not be typed to their end yet
