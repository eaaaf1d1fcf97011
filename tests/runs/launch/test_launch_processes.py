"""Processes of this machine: what comes back, who has how many threads, and what a killed worker costs."""

from __future__ import annotations

import os
import signal
import threading
import time
from pathlib import Path

import pytest
import torch

from neuprim.config import compose
from neuprim.config.command_settings import LauncherSettings
from neuprim.core import checkpoint
from neuprim.core.compute.threads import core_count, limit_process_threads
from neuprim.core.errors import ConfigError
from neuprim.runs.launch.executors import divide_cores_among_jobs
from neuprim.runs.launch.jobs import JobResult, JobStatus
from neuprim.runs.launch.launcher import launch_jobs, use_launcher_threads_for_runs
from tests.core import tiny
from tests.runs import launching
from tests.runs.launching import PHASES, job, processes
from tests.short_runs import fit, words
from tests.systems import posix


@pytest.fixture(autouse=True)
def two_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever machine this is."""
    monkeypatch.setattr("neuprim.runs.launch.executors.machine_cores", lambda: 2)


def states(results: list[JobResult | None]) -> list[str | None]:
    return [None if result is None else result.state for result in results]


@posix
def test_what_comes_back_and_what_stays(tmp_path: Path) -> None:
    """All that may become of a job: done, slow, refused, a bug, killed once, killed too often. None of it holds up the
    others."""
    heard: list[tuple[int, JobStatus]] = []
    ended: list[int] = []
    jobs = [
        job("double", launching.double, 21),
        job("share", launching.share),
        job("refused", launching.refuse, "no\nimages"),
        job("bug", launching.bug),
        job("once", launching.die, 1),
        job("often", launching.die, 9),
    ]
    jobs.insert(0, job("slow", launching.doze, 2.0))
    folder = tmp_path / "launch"
    results = launch_jobs(
        jobs, processes(2, retries=1), folder, lambda n, s: heard.append((n, s)), lambda n, r: ended.append(n)
    )
    _, double, share, refused, bug, once, often = results
    assert states(results) == ["done", "done", "done", "failed", "failed", "done", "failed"] and sorted(ended) == list(
        range(7)
    )
    assert ended.index(0) > ended.index(2), "the slow one holds up nobody"
    assert double is not None and double.value == 42
    assert share is not None and share.value == (1, "1", 1), "cores are shared out: two workers of two cores"
    assert refused is not None and (refused.line, refused.trace) == ("no images", "")
    assert bug is not None and bug.line == "ZeroDivisionError: a bug" and "in bug" in bug.trace
    assert once is not None and (once.value, once.attempts) == (1, 2)
    assert (
        often is not None
        and often.attempts == 2
        and "its worker died, 2 times: its process crashed or was killed" in often.line
    )
    log = Path(often.line.rpartition("its output is in ")[2])
    assert log.parent == folder and "about to die" in log.read_text()
    assert {p.suffix for p in folder.iterdir()} == {".log"}, "nothing else is left"
    last = dict(heard)
    assert [last[n].state for n in range(7)] == states(results) and last[5].attempt == 1


@posix
def test_ctrl_c_ends_what_works_and_does_not_begin_the_rest(tmp_path: Path) -> None:
    begun = threading.Event()

    def hear(number: int, status: JobStatus) -> None:
        if status.text == "dozing" and not begun.is_set():
            begun.set()
            threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()

    start = time.monotonic()
    results = launch_jobs([job(str(n), launching.doze, 60.0) for n in range(2)], processes(), tmp_path / "launch", hear)
    assert states(results) == ["interrupted", None] and time.monotonic() - start < 40
    assert not (tmp_path / "launch").exists()
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


@posix
def test_killed_in_every_phase_a_run_ends_as_if_nothing_had_been(tmp_path: Path) -> None:
    scene = tiny.write_blender(tmp_path / "two")
    more = ("train.checkpoint_every_seconds=0.01",)
    whole = fit(words(scene, tmp_path / "whole", 60, *more))
    jobs = []
    for phase in PHASES:
        config = compose(words(scene, tmp_path / phase, 60, *more))
        jobs.append(job(phase, launching.fit_and_die, {"phase": phase, "config": config.to_dict()}))
    results = launch_jobs(jobs, processes(2), tmp_path / "launch")
    assert [(r.state, r.attempts) for r in results if r is not None] == [("done", 2)] * len(PHASES), [
        r and r.line for r in results
    ]
    for phase in PHASES:
        for kind in ("model", "checkpoint"):
            first, second = (
                checkpoint.read_tensors(d / f"{kind}.safetensors", kind)[1] for d in (whole, tmp_path / phase)
            )
            assert first.keys() == second.keys() and all(torch.equal(first[name], second[name]) for name in first), (
                phase,
                kind,
            )
        assert (tmp_path / phase / "report.html").exists() and not (tmp_path / phase / ".lock").exists()


@pytest.mark.parametrize(
    ("asked", "jobs", "expected"),
    [
        ({}, 5, (2, 1)),
        ({}, 1, (1, 2)),
        ({"workers": 1}, 5, (1, 2)),
        ({"threads": 2}, 5, (1, 2)),
        ({"workers": 2, "threads": 1}, 1, (2, 1)),
        (
            {"workers": 3},
            5,
            "launcher.workers=3: needs more than the 2 cores of this machine; expected at most 2 threads in total",
        ),
        ({"workers": 2, "threads": 2}, 5, "launcher.workers=2 with launcher.threads=2: needs more than"),
    ],
)
def test_cores_are_shared_out_and_never_promised_twice(asked: dict[str, int], jobs: int, expected: object) -> None:
    settings = launching.LauncherSettings("processes", **asked)
    if isinstance(expected, tuple):
        assert divide_cores_among_jobs(settings, jobs) == expected
    else:
        with pytest.raises(ConfigError) as error:
            divide_cores_among_jobs(settings, jobs)
        assert str(error.value).startswith(str(expected))


def test_jobs_in_a_worker_keep_its_share_of_the_cores() -> None:
    """As the chunks of a run that is itself one of a sweep."""
    with limit_process_threads(1), use_launcher_threads_for_runs(LauncherSettings()):
        assert core_count() == 1
    with use_launcher_threads_for_runs(LauncherSettings(threads=1)):
        assert core_count() == 1
