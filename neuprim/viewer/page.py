"""Sessions for everybody who opens the page: made when they come, dropped when they go."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

from neuprim.core.data import View
from neuprim.core.errors import NeuprimError
from neuprim.viewer.condition_controls import ConditionControls
from neuprim.viewer.desk import Desk
from neuprim.viewer.held_out_controls import HeldOutControls
from neuprim.viewer.path_controls import PathControls
from neuprim.viewer.primitive_controls import PrimitiveControls
from neuprim.viewer.render_controls import RenderControls
from neuprim.viewer.server import PageServer
from neuprim.viewer.session import Session
from neuprim.viewer.subject import Subject

__all__ = ["Page"]


class Page:
    """What every visitor gets.

    Attributes:
        sessions: client number -> session, of those who look now.
    """

    def __init__(
        self,
        server: PageServer,
        subject: Subject,
        desk: Desk,
        run_dir: Path | None,
        more: Callable[[Session], None] | None = None,
    ) -> None:
        """Opens the doors.

        Args:
            run_dir: of a finished run, whose pages edit camera paths; None while one is trained.
            more: adds a tab's controls for a model that grows.
        """
        self.server, self.subject, self.desk, self.run_dir, self.more = server, subject, desk, run_dir, more
        self.sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self._start: View | None = None
        server.viser.scene.set_up_direction(subject.up)
        server.on_visit(self._come, self._gone, self._refused)

    def _come(self, client: Any) -> None:
        """A page was opened: what it needs of the model is asked of the desk."""
        self.desk.ask(
            (client.client_id, "come"), lambda: self._receive(client), lambda error: self._failed(client, error)
        )

    def _gone(self, client: Any) -> None:
        with self._lock:
            session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.end()
        self.desk.forget(client.client_id)

    def _refused(self, client: int, reason: str) -> None:
        if (session := self.sessions.get(client)) is not None:
            session.say(f"refused: {reason}")

    def _failed(self, client: Any, error: Exception) -> None:
        client.add_notification("neuprim", str(error), color="red")
        if not isinstance(error, NeuprimError):
            raise error

    def _receive(self, client: Any) -> None:
        if client.client_id not in self.server.viser.get_clients():
            return  # gone before anybody had time
        if self._start is None:
            self._start = self.subject.start()
        session = Session(client, self.subject, self.desk, self._start, grows=self.more is not None)
        with self._lock:
            self.sessions[client.client_id] = session
        gui = client.gui
        session.begin(self._start)
        tabs = gui.add_tab_group()
        if self.more is not None:
            with tabs.add_tab("Training"):
                self.more(session)
        with tabs.add_tab("View"):
            conditions = ConditionControls(session)
            RenderControls(session, words=self.more is None)
            HeldOutControls(session, conditions.show)
        with tabs.add_tab("Primitives"):
            PrimitiveControls(session)
        if self.run_dir is not None:
            with tabs.add_tab("Camera path"):
                PathControls(session, self.run_dir)
