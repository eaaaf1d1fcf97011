"""Ground truth that a scene renders frame by frame, made by a launcher's workers before runs need it."""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from neuprim.config import RunConfig, find_run_plugins, scene_of, task_of
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.data.dataset import GroundTruth
from neuprim.core.errors import DataError, NeuprimError
from neuprim.core.io.store import WAIT_MESSAGE
from neuprim.plugins.attribution import attribute_errors
from neuprim.runs.events import Events, Note, Preparing, ignore_event
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.runs.launch.jobs import Job, JobStatus, Result
from neuprim.runs.launch.launcher import OnStatus, launch
from neuprim.runs.open import make_scene_context

_MOST = 16
"""Frames that a worker takes at a time."""

_kept: dict[str, GroundTruth] = {}
"""Of this process's last job: all jobs of a launch have one scene."""


def load_ground_truth(
    config: RunConfig,
    progress: Callable[[str, float], None] = lambda text, fraction: None,
    known: Mapping[str, Any] | None = None,
) -> GroundTruth | None:
    """The ground truth of a configuration's scene; None of a scene whose images are not rendered frame by frame.

    Raises:
        NeuprimError: files or settings that the scene refuses, or that its loader crashed.
    """
    make = scene_of(config, task_of(config)).spec.truth
    if make is None:
        return None
    with attribute_errors(find_run_plugins(config).scene, "truth"):
        return make(config.scene, make_scene_context(config, progress), known)


def render_ground_truth(
    config: RunConfig, settings: LauncherSettings, events: Events = ignore_event
) -> GroundTruth | None:
    """Have what is missing of the ground truth made where the launcher says; None of a scene that renders none.

    Frames that are there are not made again, and each is kept as it is done. The launcher's files lie beside the run's
    directory while it works.

    The first frame that cannot be made ends the rest, as no run can do without it; what was made is kept.

    Args:
        events: told how far it is, and what became of workers.

    Raises:
        KeyboardInterrupt: Ctrl-C came; what was made is kept.
        NeuprimError: what the launcher or the scene refuses, or a frame that cannot be made.
        RuntimeError: a bug in a worker, with its traceback.
    """
    truth = load_ground_truth(config, lambda text, fraction: events(Preparing(text, fraction)))
    if truth is None:
        return None
    missing = truth.missing()
    if missing:
        truth.begin()
        _launched(config, truth, missing, settings, events)
    truth.complete()
    return truth


def render_ground_truth_of_runs(configs: Sequence[RunConfig], settings: LauncherSettings, hear: OnStatus) -> None:
    """The ground truth of runs that are to be launched, once for all that share it; ``launcher=inline`` leaves that to
    the runs.

    What cannot be made is left to the run that needs it, which says why, and holds up no other.

    Args:
        hear: told (place of each run that waits, how far it is).
    """
    if settings.name == "inline":
        return
    scenes: dict[str, list[int]] = {}
    for number, config in enumerate(configs):
        scenes.setdefault(_scene(config), []).append(number)
    for numbers in scenes.values():

        def tell(event: object, numbers: Sequence[int] = numbers) -> None:
            if isinstance(event, Preparing | Note):
                done = event.fraction if isinstance(event, Preparing) else 0.0
                text = f"{event.text}, {done:.0%}" if done > 0 else event.text
                for number in numbers:
                    hear(number, JobStatus("waiting", text, progress=done))

        with suppress(NeuprimError):
            render_ground_truth(configs[numbers[0]], settings, tell)


def render_ground_truth_for_training(
    config: RunConfig, settings: LauncherSettings, progress: Callable[[str, float], None]
) -> None:
    """The ground truth of the trainings of one scene, as :func:`before_runs`; raises as :func:`make_truth`."""

    def tell(event: object) -> None:
        if isinstance(event, Preparing):
            progress(event.text, event.fraction)

    if settings.name != "inline":
        render_ground_truth(config, settings, tell)


def split_frames(missing: Sequence[int], workers: int) -> Iterator[list[int]]:
    """Frames for one job after the other: several at first, and one by one in the end, so that nobody waits long for a
    slow worker (guided self-scheduling; Polychronopoulos and Kuck, 1987)."""
    left = list(missing)
    while left:
        count = min(max(len(left) // (4 * workers), 1), _MOST)
        yield left[:count]
        left = left[count:]


def render_frames_job(data: Mapping[str, Any], attempt: int, events: Events) -> int:
    """The function of a job; the number of its frames that are there then. Those that are, as of a worker that died,
    are not made again."""
    config = RunConfig.from_dict(data["config"])
    truth = _truth(config, data["known"])
    if truth.key != data["key"]:
        raise DataError(
            f"{truth.place}: a worker sees another scene; expected the launcher's files there, of the same names, "
            f"sizes and times, and its neuprim"
        )
    for done, frame in enumerate(data["frames"]):
        if Path(data["stop"]).exists():  # another one cannot be made
            return done
        events(Preparing(truth.frames[frame], done / len(data["frames"])))
        truth.make(frame, lambda text: events(Preparing(text)))
    return len(data["frames"])


def _launched(
    config: RunConfig, truth: GroundTruth, missing: Sequence[int], settings: LauncherSettings, events: Events
) -> None:
    workers, _ = count_parallel_jobs(settings, len(missing))
    parts = list(split_frames(missing, workers))
    outputs = config.output_dir.parent.absolute()  # which every machine sees
    new, folder = not outputs.exists(), outputs / f"truth-{uuid.uuid4().hex[:8]}"
    stop = folder / "failed"
    common = {"config": config.to_dict(), "known": dict(truth.known), "key": truth.key, "stop": str(stop)}
    jobs = [
        Job(truth.frames[part[0]], f"{__name__}:{render_frames_job.__name__}", {**common, "frames": part})
        for part in parts
    ]
    told = _Told(truth, parts, len(missing), events, stop)
    _kept.clear()
    _kept[_scene(config)] = truth
    try:
        results = launch(jobs, settings, folder, told.hear, told.ended)
    finally:
        _kept.clear()
        stop.unlink(missing_ok=True)
        with suppress(OSError):  # gone already, or with logs of workers that printed something
            folder.rmdir()
        with suppress(OSError):
            if new:
                outputs.rmdir()
    over = [result for result in results if result is not None and result.state != "interrupted"]
    failed = [result for result in over if result.state == "failed"]
    for result in failed:
        if result.trace:
            raise RuntimeError(f"in a worker of launcher={settings.name}:\n{result.trace}")
    if len(over) < len(jobs):
        raise KeyboardInterrupt
    if failed:
        raise DataError(f"{failed[0].line} ({len(truth.missing()):,} of {len(truth.frames):,} frames are missing)")


class _Told:
    """How far a launch is, as events."""

    def __init__(
        self, truth: GroundTruth, parts: Sequence[Sequence[int]], count: int, events: Events, stop: Path
    ) -> None:
        self._truth, self._parts, self._events, self._done = truth, parts, events, len(truth.frames) - count
        self._stop = stop
        self._said: set[str] = set()
        self._text = f"rendering the ground truth: {len(truth.frames):,} frames"
        self._progress()

    def hear(self, number: int, status: JobStatus) -> None:
        name = self._truth.frames[self._parts[number][0]]
        if status.state == "waiting":
            self._note(f"{name}: its worker died; what it had not finished is made again")
        elif status.text.startswith(WAIT_MESSAGE):
            self._note(status.text)

    def ended(self, number: int, result: Result) -> None:
        if result.state == "failed":
            with suppress(OSError):  # then the others find out by themselves
                self._stop.parent.mkdir(parents=True, exist_ok=True)
                self._stop.touch()
        elif result.state == "done":
            self._done += result.value
            self._progress()

    def _progress(self) -> None:
        self._events(Preparing(self._text, self._done / len(self._truth.frames)))

    def _note(self, text: str) -> None:
        if text not in self._said:
            self._said.add(text)
            self._events(Note(text))


def _truth(config: RunConfig, known: Mapping[str, Any]) -> GroundTruth:
    key = _scene(config)
    if key not in _kept:
        made = load_ground_truth(config, known=known)
        assert made is not None, "only scenes with a ground truth are launched"
        _kept.clear()
        _kept[key] = made
    return _kept[key]


def _scene(config: RunConfig) -> str:
    return json.dumps([config.task, config.scene_name, config.scene, config.seed], sort_keys=True, default=str)
