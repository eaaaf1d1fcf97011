"""``neuprim view``: a finished run in the browser."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from neuprim.config import suspects_of
from neuprim.config.viewer import ViewerSettings
from neuprim.core.cameras.world import World
from neuprim.core.channels import stored_channels
from neuprim.core.data import Dataset
from neuprim.core.errors import NeuprimError
from neuprim.core.io.json_reader import JsonReader
from neuprim.core.model.primitives import Primitives
from neuprim.runs.open import LOGS, load_dataset, load_run
from neuprim.runs.render_config import RenderConfig
from neuprim.viewer.desk import Desk
from neuprim.viewer.frame import Look
from neuprim.viewer.levels import read_front
from neuprim.viewer.page import Page
from neuprim.viewer.server import PageServer, require_viser
from neuprim.viewer.subject import Subject

__all__ = ["open_subject", "view_run"]

_PATIENCE = 0.25
"""Seconds after which the thread that draws looks whether it is to end."""


def open_subject(
    run_dir: Path,
    tell: Callable[[str], None] = lambda text: None,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
) -> Subject:
    """A finished run, to be looked at. Without its data there are no held-out views, which is told.

    Raises:
        CheckpointError, ConfigError: naming the file that is missing or damaged.
    """
    config, task, model, header = load_run(run_dir)
    channels = stored_channels(run_dir, header, task, model.colour.channels)
    dataset: Dataset | None = None
    try:
        with suspects_of(config).watch(run_dir / LOGS):
            dataset = load_dataset(config, task, progress, run_dir)
    except NeuprimError as error:
        tell(f"no held-out views: {error}")
    background = torch.tensor([float(x) for x in header.get("background", [0.0] * model.colour.channels)])

    def now() -> Primitives:
        return model

    middle = torch.from_numpy(Subject.middle_of(model))
    up, center = _fact(header, "up", torch.tensor([0.0, 0.0, 1.0])), _fact(header, "center", middle)
    if dataset is not None:
        up, center = dataset.up, dataset.center
    x, y, z = (float(value) for value in up)
    own = (task, now, channels, config.renderer, background, (x, y, z), np.asarray(center.double().numpy()))
    return Subject(
        run_dir.resolve().name, *own, World.of(header, str(run_dir)), dataset=dataset, front=read_front(run_dir, tell)
    )


def _fact(header: Mapping[str, Any], name: str, otherwise: torch.Tensor) -> torch.Tensor:
    """(3,) what the model's header says of its scene, where it does.

    Raises:
        DataError: it is something else than three numbers.
    """
    facts = header.get("data")
    if not isinstance(facts, dict) or name not in facts:
        return otherwise
    return JsonReader(facts, "the model's header: data").array(name, (3,), "3 numbers")


def view_run(
    run_dir: Path,
    settings: ViewerSettings,
    opened: Callable[[str], None],
    tell: Callable[[str], None] = lambda text: None,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
    end: threading.Event | None = None,
) -> None:
    """Show a finished run in the browser until ``end`` is set, or Ctrl-C.

    Args:
        opened: told the address, with the token that it takes.
        tell: told what the user should know.

    Raises:
        CheckpointError, ConfigError: naming the file that is missing or damaged, or what the settings ask for.
        BackendUnavailable: viser is missing.
    """
    require_viser()  # before the data are read
    end = end or threading.Event()
    desk, subject = Desk(), open_subject(run_dir, tell, progress)
    progress("preparing the renderer", 0.0)  # the first picture compiles kernels, once per installation
    start = subject.start()
    subject.draw(Look(start.camera.resized(32, 32), start.conditions), RenderConfig(subject.settings))
    server = PageServer(settings, subject.name)
    try:
        Page(server, subject, desk, run_dir)
        opened(server.address)
        while not end.is_set():
            desk.work(_PATIENCE)
    finally:
        server.close()
