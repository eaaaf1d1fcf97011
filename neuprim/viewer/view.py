"""Viewer of a finished run, ``neuprim view``, and the sessions of its open pages."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuprim.config.command_settings import ViewerSettings
from neuprim.core.cameras.world import World
from neuprim.core.channels import read_stored_channels
from neuprim.core.data import Dataset, View
from neuprim.core.errors import NeuprimError
from neuprim.core.io.json_reader import JsonReader
from neuprim.runs.open import load_dataset, load_run
from neuprim.runs.render_config import RenderConfig
from neuprim.viewer.controls import ConditionControls, PrimitiveControls, RenderControls, ViewControls
from neuprim.viewer.quality import read_viewer_front
from neuprim.viewer.render_queue import RenderQueue
from neuprim.viewer.server import ViewerServer, require_viser
from neuprim.viewer.session import Session
from neuprim.viewer.viewer_scene import ViewerScene, Viewpoint

_POLL_SECONDS = 0.25  # between checks whether the viewer is to end


class SessionManager:
    """Create a session for each opened page, and drop it when the page closes; ``sessions`` has those of open pages."""

    def __init__(
        self,
        server: ViewerServer,
        scene: ViewerScene,
        queue: RenderQueue,
        add_training: Callable[[Session], None] | None = None,
    ) -> None:
        """Start accepting pages; ``add_training`` fills the tab of a training."""
        self.server, self.scene, self.queue, self._add_training = server, scene, queue, add_training
        self.sessions: dict[int, Session] = {}
        self._lock = threading.Lock()
        self._start: View | None = None
        server.viser.scene.set_up_direction(scene.up)
        server.on_client(self._connect, self._disconnect, self._report_refusal)

    def _connect(self, client: Any) -> None:
        def report(error: Exception) -> None:
            client.add_notification("neuprim", str(error), color="red")
            if not isinstance(error, NeuprimError):
                raise error

        self.queue.submit((client.client_id, "open"), lambda: self._open_session(client), report)

    def _disconnect(self, client: Any) -> None:
        with self._lock:
            session = self.sessions.pop(client.client_id, None)
        if session is not None:
            session.close()
        self.queue.drop_client(client.client_id)

    def _report_refusal(self, client: int, reason: str) -> None:
        if (session := self.sessions.get(client)) is not None:
            session.set_status(f"refused: {reason}")

    def _open_session(self, client: Any) -> None:
        if client.client_id not in self.server.viser.get_clients():
            return  # closed before its turn
        if self._start is None:
            self._start = self.scene.start_view()
        training = self._add_training is not None
        session = Session(client, self.scene, self.queue, self._start, training)
        with self._lock:
            self.sessions[client.client_id] = session
        session.open(self._start)
        tabs = client.gui.add_tab_group()
        if self._add_training is not None:
            with tabs.add_tab("Training"):
                self._add_training(session)
        with tabs.add_tab("View"):
            conditions = ConditionControls(session)
            RenderControls(session, overrides=not training)
            ViewControls(session, conditions.refresh_conditions)
        with tabs.add_tab("Primitives"):
            PrimitiveControls(session)


def open_viewer_scene(
    run_dir: Path,
    warn: Callable[[str], None] = lambda text: None,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
) -> ViewerScene:
    """Open a finished run. If its data cannot be read there are no held-out views, with a warning.

    Raises:
        CheckpointError, ConfigError: naming the file that is missing or damaged.
    """
    run = load_run(run_dir)
    config, task, model, header = run.config, run.task, run.model, run.header
    dataset: Dataset | None = None
    try:
        with run.plugins.attribute_errors():
            dataset = load_dataset(run, progress)
    except NeuprimError as error:
        warn(f"no held-out views: {error}")
    means = model.params["means"].detach().double().cpu()
    up = _read_viewer_vector(header, "up", torch.tensor([0.0, 0.0, 1.0]))
    center = _read_viewer_vector(header, "center", means.median(0).values if len(means) else torch.zeros(3))
    if dataset is not None:
        up, center = dataset.up, dataset.center
    return ViewerScene(
        name=run_dir.resolve().name,
        task=task,
        model=lambda: model,
        channels=read_stored_channels(run_dir, header, task, model.colour.channels),
        settings=config.renderer,
        background=torch.tensor([float(x) for x in header.get("background", [0.0] * model.colour.channels)]),
        up=tuple(up.tolist()),
        center=np.asarray(center.double().numpy()),
        world=World.of(header, str(run_dir)),
        dataset=dataset,
        front=read_viewer_front(run_dir, warn),
    )


def _read_viewer_vector(header: Mapping[str, Any], name: str, default: torch.Tensor) -> torch.Tensor:
    """Read (3,) numbers about the scene from a model's header.

    Raises:
        DataError: it holds something else.
    """
    facts = header.get("data")
    if not isinstance(facts, dict) or name not in facts:
        return default
    return JsonReader(facts, "the model's header: data").array(name, (3,), "3 numbers")


def view_run(
    run_dir: Path,
    settings: ViewerSettings,
    on_open: Callable[[str], None],
    warn: Callable[[str], None] = lambda text: None,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
    end: threading.Event | None = None,
) -> None:
    """Show a finished run in the browser until ``end`` is set, or Ctrl-C.

    Args:
        on_open: called with the address of the page, with its token.

    Raises:
        CheckpointError, ConfigError: naming the file that is missing or damaged, or the wrong setting.
        BackendUnavailable: viser is missing.
    """
    require_viser()  # before the data are read
    end = end or threading.Event()
    queue, scene = RenderQueue(), open_viewer_scene(run_dir, warn, progress)
    progress("preparing the renderer", 0.0)  # the first image compiles kernels, once per installation
    start = scene.start_view()
    scene.draw(Viewpoint(start.camera.resized(32, 32), start.conditions), RenderConfig(scene.settings))
    server = ViewerServer(settings, scene.name)
    try:
        SessionManager(server, scene, queue)
        on_open(server.address)
        while not end.is_set():
            queue.work(_POLL_SECONDS)
    finally:
        server.close()
