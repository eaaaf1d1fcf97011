"""Render the ground truth of scenes frame by frame in a launcher's workers, before runs need it."""

from __future__ import annotations

import json
import uuid
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from typing import Any

from neuprim.config import Job, RunConfig
from neuprim.config.command_settings import LauncherSettings
from neuprim.core.data.dataset import DatasetImages
from neuprim.core.errors import DataError, NeuprimError
from neuprim.core.io.store import WAIT_MESSAGE
from neuprim.plugins.attribution import attribute_errors
from neuprim.runs.fit import Event, Events, Note, Preparing, ignore_run_event
from neuprim.runs.launch.executors import count_parallel_jobs
from neuprim.runs.launch.jobs import JobResult, JobStatus, LaunchJob
from neuprim.runs.launch.launcher import OnStatus, launch_jobs
from neuprim.runs.open import Progress, ignore_progress, make_run_scene_context

_MOST_FRAMES = 16
"""Largest number of frames in one job."""

_loaded: dict[str, DatasetImages] = {}
"""Cache of one entry: scene key -> ground truth of this process's last job. All jobs of a launch have one scene."""


def load_run_ground_truth(
    config: RunConfig, progress: Progress = ignore_progress, known: Mapping[str, Any] | None = None
) -> DatasetImages | None:
    """Return the ground-truth images of a configuration's scene; None if the scene does not render them frame by frame.

    ``known`` are values that another process has already computed (:class:`~neuprim.core.data.dataset.DatasetImages`).

    Raises:
        NeuprimError: the scene refuses its files or settings, or its loader crashed.
    """
    job = Job.of(config)
    make = job.scene.spec.truth
    if make is None:
        return None
    with attribute_errors(job.plugins.scene, "truth"):
        return make(config.scene, make_run_scene_context(config, progress), known)


def launch_ground_truth_jobs(
    config: RunConfig, settings: LauncherSettings, events: Events = ignore_run_event
) -> DatasetImages | None:
    """Render the missing frames of a scene's ground truth with a launcher. Return the ground-truth images; None if the
    scene does not render them frame by frame.

    Each new frame is stored at once. The first frame that fails ends the work, because a run needs all frames. The
    launcher's temporary files are in the run directory's parent.

    Raises:
        KeyboardInterrupt: Ctrl-C came.
        NeuprimError: the launcher or the scene refuses its settings, or a frame cannot be rendered.
        RuntimeError: a bug in a worker, with its traceback.
    """
    truth = load_run_ground_truth(config, lambda text, fraction: events(Preparing(text, fraction)))
    if truth is None:
        return None
    missing = truth.missing()
    if missing:
        truth.begin()
        _launch_ground_truth_frames(config, truth, missing, settings, events)
    truth.complete()
    return truth


def render_ground_truth_of_runs(configs: Sequence[RunConfig], settings: LauncherSettings, on_status: OnStatus) -> None:
    """Render the ground truth of runs before they are launched, once per scene. With ``launcher=inline`` do nothing,
    because each run then renders its ground truth.

    Errors are ignored here. The run that needs the ground truth reports them; other runs continue.

    Args:
        on_status: called with (index of a waiting run, its status).
    """
    if settings.name == "inline":
        return
    scenes: dict[str, list[int]] = {}
    for number, config in enumerate(configs):
        scenes.setdefault(_run_scene_key(config), []).append(number)
    for numbers in scenes.values():

        def tell(event: Event, numbers: Sequence[int] = numbers) -> None:
            if isinstance(event, Preparing | Note):
                done = event.fraction if isinstance(event, Preparing) else 0.0
                text = f"{event.text}, {done:.0%}" if done > 0 else event.text
                for number in numbers:
                    on_status(number, JobStatus("waiting", text, progress=done))

        with suppress(NeuprimError):
            launch_ground_truth_jobs(configs[numbers[0]], settings, tell)


def render_ground_truth_before_run(config: RunConfig, settings: LauncherSettings, progress: Progress) -> None:
    """Render a run's ground truth with a launcher before this process trains it. With ``launcher=inline`` do nothing.
    Raises the errors of :func:`launch_ground_truth_jobs`."""

    def tell(event: Event) -> None:
        if isinstance(event, Preparing):
            progress(event.text, event.fraction)

    if settings.name != "inline":
        launch_ground_truth_jobs(config, settings, tell)


def split_frames_into_jobs(missing: Sequence[int], workers: int) -> Iterator[list[int]]:
    """Yield a list of ``missing`` frames for each job, to be rendered by ``workers`` parallel workers.

    The first jobs have several frames and the last jobs have one, so that a slow worker delays the end little (guided
    self-scheduling; Polychronopoulos and Kuck, 1987).
    """
    left = list(missing)
    while left:
        count = min(max(len(left) // (4 * workers), 1), _MOST_FRAMES)
        yield left[:count]
        left = left[count:]


def render_frames_job(data: Mapping[str, Any], attempt: int, events: Events) -> int:
    """Render the ground-truth images of some frames in a worker process; return the number of frames.

    ``data`` has the run's configuration, the indices of the frames, and values that the launcher has computed.
    """
    config = RunConfig.from_dict(data["config"])
    key = _run_scene_key(config)
    if key not in _loaded:
        loaded = load_run_ground_truth(config, known=data["known"])
        assert loaded is not None, "only scenes with a ground truth are launched"
        _loaded.clear()
        _loaded[key] = loaded
    truth = _loaded[key]
    if truth.key != data["key"]:
        raise DataError(
            f"{truth.place}: a worker has other scene files than the launcher; expected files of the same names, "
            f"sizes and times, and the same neuprim"
        )
    for done, frame in enumerate(data["frames"]):
        events(Preparing(truth.frames[frame], done / len(data["frames"])))
        truth.make(frame, lambda text: events(Preparing(text)))
    return len(data["frames"])


def _launch_ground_truth_frames(
    config: RunConfig, truth: DatasetImages, missing: Sequence[int], settings: LauncherSettings, events: Events
) -> None:
    parts = list(split_frames_into_jobs(missing, count_parallel_jobs(settings, len(missing))[0]))
    outputs = config.output_dir.parent.absolute()  # a folder that every machine can access
    new, folder = not outputs.exists(), outputs / f"truth-{uuid.uuid4().hex[:8]}"
    common = {"config": config.to_dict(), "known": dict(truth.known), "key": truth.key}
    call, names = f"{__name__}:{render_frames_job.__name__}", [truth.frames[part[0]] for part in parts]
    jobs = [LaunchJob(name, call, {**common, "frames": part}) for name, part in zip(names, parts, strict=True)]
    total, done, noted = len(truth.frames), len(truth.frames) - len(missing), set[str]()
    text = f"rendering the ground truth: {total:,} frames"

    def on_status(number: int, status: JobStatus) -> None:
        died, waits = status.state == "waiting", status.text.startswith(WAIT_MESSAGE)
        note = f"{names[number]}: its worker died" if died else status.text
        if (died or waits) and note not in noted:
            noted.add(note)
            events(Note(note))

    def on_result(number: int, result: JobResult) -> None:
        nonlocal done
        if result.state == "done":
            done += result.value
            events(Preparing(text, done / total))

    events(Preparing(text, done / total))
    _loaded.clear()
    _loaded[_run_scene_key(config)] = truth
    try:
        results = launch_jobs(jobs, settings, folder, on_status, on_result, stop_at_failure=True)
    finally:
        _loaded.clear()
        with suppress(OSError):
            if new:
                outputs.rmdir()
    failed = [result for result in results if result is not None and result.state == "failed"]
    for result in failed:
        if result.trace:
            raise RuntimeError(f"in a worker of launcher={settings.name}:\n{result.trace}")
    if failed:
        raise DataError(f"{failed[0].line} ({len(truth.missing()):,} of {total:,} frames are missing)")
    if any(result is None or result.state == "interrupted" for result in results):
        raise KeyboardInterrupt


def _run_scene_key(config: RunConfig) -> str:
    return json.dumps([config.task, config.scene_name, config.scene, config.seed], sort_keys=True, default=str)
