"""Cameras of held-out views to jump to, with their truth beside what the model shows there."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from neuprim.viewer.poses import Pose
from neuprim.viewer.session import Session

__all__ = ["HeldOutControls"]

_NONE = "none"
_WIDE = 320
"""Pixels that half a panel has at least, on screens of twice the usual number."""


class HeldOutControls:
    """A list of views; the truth and the model, each at the view's own size, and the PSNR between them."""

    def __init__(self, session: Session, jumped: Callable[[], None]) -> None:
        self.session, self._jumped = session, jumped
        self._names = session.subject.view_names()
        self._image: Any = None
        gui = session.client.gui
        if not self._names:
            return
        self._choice = gui.add_dropdown("held-out view", [_NONE, *self._names], initial_value=_NONE)
        self._choice.on_update(lambda _: self._chosen(self._choice.value))
        self._folder = gui.add_folder("held-out view", visible=False)
        session.watchers.append(self._again)

    def _chosen(self, name: str) -> None:
        if name == _NONE:
            self._folder.visible = False
            return
        self.session.ask("jump", lambda: self._jump(name))

    def _jump(self, name: str) -> None:
        view = self.session.subject.view(name)
        self.session.stand(Pose.of(view.camera))
        self.session.set_conditions({key: value.float() for key, value in view.conditions.items()})
        self._jumped()
        self._compare(name)

    def _again(self) -> None:
        """The model may have grown."""
        if self.session.grows and self._folder.visible and self._choice.value != _NONE:
            self._compare(self._choice.value)

    def _compare(self, name: str) -> None:
        found = self.session.subject.compare(name)
        image = np.concatenate([_large(found.truth), _large(found.drawn)], axis=1)
        if self._image is None:
            gui = self.session.client.gui
            with self._folder:
                self._image = gui.add_image(image, label="ground truth, and the model", format="jpeg", jpeg_quality=95)
                self._psnr = gui.add_text("PSNR", "", disabled=True)
        self._image.image, self._psnr.value = image, f"{found.psnr:.2f} dB"
        self._folder.visible = True


def _large(image: np.ndarray) -> np.ndarray:
    """A small image with every pixel repeated, so that half of the panel shows it as wide as it can."""
    times = max(_WIDE // image.shape[1], 1)
    return image.repeat(times, 0).repeat(times, 1)
