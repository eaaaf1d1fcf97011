"""Jobs for the tests of launched ground truth: making frames where something goes wrong meanwhile."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from neuprim.core.io.vdb import VdbFrame
from neuprim.runs import ground_truth
from neuprim.runs.fit import Events
from neuprim.runs.launch.jobs import LaunchJob
from neuprim.tasks.dynamic.volume import capture

SLOW, FATAL = 1, 4
"""Numbers of the frames whose maker is slow, and is killed the first time."""


def make_frames(data: Mapping[str, Any], attempt: int, events: Events) -> int:
    """The function of the job; every frame that is begun is a line of a file beside the images."""
    genuine = capture.Capture.render
    log = Path(data["config"]["scene"]["cache"]) / "begun.txt"

    def render(self: capture.Capture, frame: VdbFrame, folder: Path) -> None:
        with open(log, "a", encoding="utf-8") as file:
            file.write(f"{frame.number} {os.getpid()}\n")
        if frame.number == SLOW:
            late = time.monotonic() + 60
            while (
                len({line.split()[0] for line in log.read_text(encoding="utf-8").splitlines()}) < data["wait"]
                and time.monotonic() < late
            ):
                time.sleep(0.05)  # until somebody has begun all of the others
        if frame.number == FATAL and attempt == 0:
            (folder / "cam_00.exr").write_bytes(b"half of it")
            os.kill(os.getpid(), signal.SIGKILL)
        genuine(self, frame, folder)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture.Capture, "render", render)
        return ground_truth.render_frames_job(data, attempt, events)


def troubled(wait: int) -> Any:
    """In place of the class of jobs: theirs with this module's function."""

    def job(name: str, call: str, data: Any) -> LaunchJob:
        return LaunchJob(name, f"{__name__}:{make_frames.__name__}", {**data, "wait": wait})

    return job
