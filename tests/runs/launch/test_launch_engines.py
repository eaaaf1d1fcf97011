"""Real Ray on this machine, and real submitit with its local executor: the same jobs as in processes, where the
packages are installed."""

from __future__ import annotations

import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from neuprim.config.command_settings import LauncherSettings
from neuprim.core.errors import BackendUnavailable, NeuprimError
from neuprim.runs.launch.jobs import JobStatus
from neuprim.runs.launch.launcher import check_launcher, launch_jobs
from tests.runs import launching
from tests.runs.launching import job
from tests.systems import posix

ROOT = Path(__file__).parents[3]

pytestmark = posix


@pytest.fixture(autouse=True)
def found_by_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    """The functions of the jobs; and whatever machine this is, it has two cores."""
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setattr("neuprim.runs.launch.executors.machine_cores", lambda: 2)


@pytest.fixture
def ray() -> Iterator[Any]:
    module = pytest.importorskip("ray")
    yield module
    module.shutdown()


def all_sorts(settings: LauncherSettings, folder: Path) -> None:
    """Done, refused, a bug, its threads, and one whose worker is killed once."""
    heard: list[tuple[int, JobStatus]] = []
    jobs = [
        job("double", launching.double, 21),
        job("refused", launching.refuse, "no images"),
        job("bug", launching.bug),
        job("share", launching.share),
        job("once", launching.die, 1),
    ]
    results = launch_jobs(jobs, settings, folder, lambda n, s: heard.append((n, s)))
    assert all(result is not None for result in results)
    double, refused, bug, share, once = (result for result in results if result is not None)
    assert double.value == 42 and refused.line == "no images" and not refused.trace
    assert bug.line == "ZeroDivisionError: a bug" and "in bug" in bug.trace
    assert share.value == (1, "1", 1)
    assert (once.state, once.value, once.attempts) == ("done", 1, 2), once.line
    assert dict(heard)[4].attempt == 1


def test_ray_does_all_sorts_of_jobs(ray: Any, tmp_path: Path) -> None:
    all_sorts(LauncherSettings("ray", workers=2), tmp_path / "launch")
    assert not (tmp_path / "launch").exists() and not ray.is_initialized()


def test_ctrl_c_reaches_what_ray_has_at_work(ray: Any, tmp_path: Path) -> None:
    begun = threading.Event()

    def hear(number: int, status: JobStatus) -> None:
        if status.text == "at it" and not begun.is_set():
            begun.set()
            threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()

    first, second = launch_jobs(
        [job(str(n), launching.toil, 60.0) for n in range(2)],
        LauncherSettings("ray", workers=1),
        tmp_path / "launch",
        hear,
    )
    assert first is not None and first.state == "interrupted" and second is None


def test_ray_that_does_not_answer_is_said_within_seconds(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        address = f"127.0.0.1:{taken.getsockname()[1]}"
        start = time.monotonic()
        with pytest.raises(BackendUnavailable) as error:
            launch_jobs([job("x", launching.double, 1)], LauncherSettings("ray", address=address), tmp_path / "launch")
    assert str(error.value).startswith(f"launcher.address={address}: no answer from this address")
    assert time.monotonic() - start < 20 and not (tmp_path / "launch").exists()
    for wrong in ("moon", "http://", "ray://x:y"):
        with pytest.raises(BackendUnavailable, match="expected auto, HOST:PORT or ray://HOST:PORT"):
            launch_jobs([job("x", launching.double, 1)], LauncherSettings("ray", address=wrong), tmp_path / "launch")


def test_submitit_does_jobs(tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    settings = LauncherSettings("slurm", workers=2, address="local")
    jobs = [job("double", launching.double, 21), job("refused", launching.refuse, "no images")]
    double, refused = launch_jobs(jobs, settings, tmp_path / "launch")
    assert double is not None and double.value == 42
    assert refused is not None and (refused.state, refused.line) == ("failed", "no images")
    assert not (tmp_path / "launch").exists()


@posix
def test_submitits_results_come_from_a_folder_of_this_launch_alone(tmp_path: Path) -> None:
    pytest.importorskip("submitit")
    from neuprim.runs.launch.executors import SlurmExecutor

    (tmp_path / "submitit").mkdir(mode=0o777)  # where somebody may have put pickles of theirs
    executors = [SlurmExecutor(LauncherSettings("slurm", workers=1, address="local"), 1, tmp_path) for _ in range(2)]
    folders = [Path(executor._executor.folder) for executor in executors]
    assert len({*folders, tmp_path / "submitit"}) == 3
    assert all(
        folder.parent == tmp_path and folder.stat().st_mode & 0o777 == 0o700 and not any(folder.iterdir())
        for folder in folders
    )
    for executor in executors:
        executor.close(False)


@pytest.mark.slow
def test_submitit_does_all_sorts_of_jobs(tmp_path: Path) -> None:
    """It waits fifteen seconds for the result of a process that was killed."""
    pytest.importorskip("submitit")
    all_sorts(LauncherSettings("slurm", workers=2, address="local"), tmp_path / "launch")


def test_submitit_queues_again_with_what_goes_on(tmp_path: Path) -> None:
    """What submitit asks for before a machine is taken away: a task that knows that it was begun."""
    pytest.importorskip("submitit")
    from neuprim.runs.launch.jobs import WorkerTask

    task = WorkerTask(job("once", launching.die, 1), 1, tmp_path / "0.json", tmp_path / "stop", tmp_path)
    assert task.checkpoint().function.attempt == 1


def test_without_slurm_it_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("submitit")
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(
        BackendUnavailable, match=r"launcher=slurm: .*srun.*; launcher.address=local works without a cluster"
    ):
        launch_jobs([job("x", launching.double, 1)], LauncherSettings("slurm"), tmp_path / "launch")
    assert not (tmp_path / "launch").exists()


@pytest.mark.parametrize(("name", "package"), [("ray", "ray"), ("slurm", "submitit")])
def test_a_package_that_is_missing_is_named(name: Any, package: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, package, None)
    with pytest.raises(
        NeuprimError, match=rf"launcher={name} needs the package {package} .*: pip install 'neuprim\[{name}\]'"
    ):
        check_launcher(LauncherSettings(name), 1)
