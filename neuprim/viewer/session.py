"""One open page: where it looks, what it shows, and the pictures that it is sent."""

from __future__ import annotations

import threading
import traceback
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from torch import Tensor

from neuprim.core.data import View
from neuprim.core.errors import NeuprimError
from neuprim.core.render import RenderSettings
from neuprim.viewer.desk import Desk
from neuprim.viewer.frame import COLOUR, Look
from neuprim.viewer.levels import SMOOTH, Level, Levels
from neuprim.viewer.poses import Pose, fitted
from neuprim.viewer.subject import Subject

__all__ = ["Session"]

_STILL = 0.2
"""Seconds without a change after which the full picture is drawn."""

_AGAIN, _SHARE = 1.0, 9.0
"""A model that grows is drawn again after so many seconds, or so many times what drawing took: a tenth of the time at
most."""

_SHARP, _FAST = 95, 75
"""Quality of JPEG."""

LONGEST = 960
"""Pixels on the longer side of a picture, unless the page asks for another number."""


class Session:
    """State of one page; its methods may be called from any thread, and what touches the model is asked of the desk.

    Attributes:
        client: the ``viser.ClientHandle``.
        shows: one of :func:`~neuprim.viewer.frame.quantities`.
        conditions: every condition of the task.
        settings: how the full picture is drawn; words: of an operating point over them.
        longest: pixels on the longer side of the full picture.
        grows: whether the model changes by itself.
        gone: whether the page was closed.
        watchers: called after every full picture, on the thread that has the model.
    """

    def __init__(self, client: Any, subject: Subject, desk: Desk, start: View, grows: bool = False) -> None:
        self.client, self.subject, self.desk = client, subject, desk
        self.gone = False
        self.shows, self.longest = COLOUR, LONGEST
        self.conditions: dict[str, Tensor] = dict(start.conditions)
        self.settings: RenderSettings = subject.settings
        self.watchers: list[Callable[[], None]] = []
        self._levels: Levels | None = None
        self._lock = threading.Lock()
        self.grows = grows
        self._status: Any = None

    # ------------------------------------------------------------ what is seen

    def begin(self, start: View) -> None:
        """Stand where the start view does, and draw from now on whenever the camera moves."""
        self._status = self.client.gui.add_text("status", "", disabled=True)
        self.stand(Pose.of(start.camera))
        self.client.camera.on_update(lambda _: self.changed())
        self.changed()

    def end(self) -> None:
        """The page was closed."""
        self.gone = True
        self.desk.forget(self.client.client_id)

    def say(self, text: str) -> None:
        """One line for the person at the page; text, whatever it says."""
        if self._status is not None and not self.gone:
            self._status.value = text

    def tell(self, text: str, colour: str = "blue") -> None:
        """Something that stays until it is closed: what went wrong, where a file is."""
        if not self.gone:
            self.client.add_notification("neuprim", " ".join(text.split()), color=colour, with_close_button=True)

    def stand(self, pose: Pose) -> None:
        """Move the page's camera; a drag turns it around what of the scene's middle lies straight ahead."""
        forward = pose.rotation.as_matrix()[:, 2]
        away = self.subject.center - pose.position
        ahead = max(float(forward @ away), 1e-2 * float(np.linalg.norm(away))) or 1.0
        camera = self.client.camera
        with self.client.atomic():
            camera.position = pose.position
            camera.wxyz = pose.wxyz
            camera.look_at = pose.position + ahead * forward
            camera.fov = pose.fov

    @property
    def pose(self) -> Pose:
        """Where the page's camera is."""
        camera = self.client.camera
        return Pose(camera.wxyz.copy(), camera.position.copy(), float(camera.fov))

    def look(self, pose: Pose | None = None) -> Look:
        """What the page sees now, or would see from a pose."""
        camera = self.client.camera
        width, height = fitted((camera.image_width or 1, camera.image_height or 1), self.longest)
        with self._lock:
            return Look((pose or self.pose).camera(width, height), dict(self.conditions), self.shows)

    def set_conditions(self, values: Mapping[str, Tensor]) -> None:
        """Look under other conditions."""
        with self._lock:
            self.conditions |= values
        self.changed()

    def set_settings(self, settings: RenderSettings, words: tuple[str, ...] = ()) -> None:
        """Draw otherwise.

        Args:
            words: of an operating point over the settings.

        Raises:
            ConfigError: the words do not fit the model.
        """
        levels = Levels.of(self.subject.model(), settings, self.subject.front, self.tell, words)
        with self._lock:
            self.settings, self._levels = settings, levels
        self.changed()

    # ------------------------------------------------------------ drawing

    def ask(self, what: str, do: Callable[[], None], after: float = 0.0, soft: bool = False) -> None:
        """Have something done by the thread that has the model; what fails is said in the page."""
        self.desk.ask((self.client.client_id, what), do, self.failed, after, soft)

    def changed(self) -> None:
        """Something that the picture depends on is another: draw what there is time for, and all of it once nothing
        changes any more."""
        self.ask("picture", self._coarse)

    def failed(self, error: Exception) -> None:
        """Say in the page what went wrong; a fault of neuprim's own leaves its traceback on the console, too."""
        if isinstance(error, NeuprimError | OSError):
            self.tell(str(error), "red")
        else:
            traceback.print_exception(error)
            self.tell(f"{type(error).__name__}: {error}", "red")

    def draw(self, level: Level | None = None, pose: Pose | None = None) -> None:
        """Draw and send a picture at a level, by default the best one that is smooth; on the thread that has the
        model."""
        levels, look = self.levels(), self.look(pose)
        pixels = look.camera.width * look.camera.height
        level = level or levels.within(SMOOTH, pixels)
        picture = self.subject.draw(look, level.point)
        levels.took(level, picture.seconds, pixels)
        if self.gone:
            return  # closed while it was drawn
        full = level is levels.full
        self.client.scene.set_background_image(picture.image, format="jpeg", jpeg_quality=_SHARP if full else _FAST)
        height, width = picture.image.shape[:2]
        self.say(
            f"{width} x {height} in {1e3 * picture.seconds:.0f} ms{'; ' if picture.caption else ''}{picture.caption}"
        )

    def levels(self) -> Levels:
        """Ways of drawing with the settings of now."""
        if self._levels is None:
            self._levels = Levels.of(self.subject.model(), self.settings, self.subject.front, self.tell)
        return self._levels

    def _coarse(self) -> None:
        levels, look = self.levels(), self.look()
        level = levels.within(SMOOTH, look.camera.width * look.camera.height)
        self.draw(level)
        self.ask("picture", self._after if level is levels.full else self._full, _STILL, soft=True)

    def _full(self) -> None:
        self.draw(self.levels().full)
        self._after()

    def _after(self) -> None:
        """What follows a full picture."""
        for watcher in self.watchers:
            watcher()
        if self.grows:
            camera = self.look().camera
            took = self.levels().full.pace or 0.0
            self.ask("picture", self._full, max(_AGAIN, _SHARE * took * camera.width * camera.height), soft=True)
