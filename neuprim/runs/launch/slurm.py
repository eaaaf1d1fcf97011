"""``launcher=slurm``: jobs of a Slurm cluster, by submitit; its local executor does the same in processes of this
machine.

Every machine of the cluster has neuprim and sees the output directory under the same path. A job that Slurm preempts,
or whose time is up, is queued again by submitit and goes on from its run's checkpoint.
"""

from __future__ import annotations

import shutil
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import submitit
from submitit.core.utils import FailedJobError, UncompletedJobError
from submitit.helpers import DelayedSubmission

from neuprim.config.launcher import LauncherSettings
from neuprim.core.errors import BackendUnavailable, ConfigError
from neuprim.runs.launch.engine import WorkerDied
from neuprim.runs.launch.jobs import Result
from neuprim.runs.launch.share import shared_out
from neuprim.runs.launch.worker import Task

__all__ = ["Slurm"]

_EXECUTORS = ("slurm", "local")
_MINUTES = 24 * 60
"""That a job may take, unless ``launcher.options.timeout_min`` says otherwise; submitit's own default is five."""


@dataclass(frozen=True)
class _Requeued:
    """A task that submitit may stop and queue again."""

    task: Task

    def __call__(self) -> Result:
        return self.task()

    def checkpoint(self) -> Any:
        """What takes its place; called when Slurm is about to take the machine away."""
        return DelayedSubmission(_Requeued(self.task.again()))


class Slurm:
    """An engine; see :class:`~neuprim.runs.launch.engine.Engine`.

    Args:
        folder: where submitit keeps its files, which workers see.

    Raises:
        BackendUnavailable: there is no Slurm here.
        ConfigError: parameters that submitit does not know.
    """

    def __init__(self, settings: LauncherSettings, jobs: int, folder: Path) -> None:
        address = settings.address or "slurm"
        if address not in _EXECUTORS:
            raise ConfigError(f"launcher.address={address}: expected {' or '.join(_EXECUTORS)}")
        local = address == "local"
        self.workers, self.threads = (
            shared_out(settings, jobs) if local else (settings.workers or jobs, settings.threads or 1)
        )
        folder.mkdir(parents=True, exist_ok=True)
        # Results are pickles, which run code when they are read: they come from a folder that only this launch and its
        # user write.
        self._folder, self._died = Path(tempfile.mkdtemp(prefix="submitit-", dir=folder.absolute())), False
        self._jobs: list[Any] = []
        try:
            self._executor = submitit.AutoExecutor(self._folder, cluster=address)
        except RuntimeError as error:
            self.close(False)
            with suppress(OSError):  # it has files of others
                folder.rmdir()
            raise BackendUnavailable(
                f"launcher=slurm: {_line(error)}; launcher.address=local does without a cluster"
            ) from None
        try:
            self._executor.update_parameters(
                **{"name": "neuprim", "cpus_per_task": self.threads, "timeout_min": _MINUTES, **settings.options}
            )
        except (NameError, TypeError, ValueError, AssertionError) as error:
            self.close(False)
            raise ConfigError(f"launcher.options: submitit refuses them: {_line(error)}") from None

    def submit(self, task: Task) -> Any:
        job = self._executor.submit(_Requeued(task))
        self._jobs.append(job)
        return job

    def done(self, handle: Any) -> bool:
        return bool(handle.done())

    def result(self, handle: Any) -> Result:
        self._jobs.remove(handle)
        try:
            result: Result = handle.result()
            return result
        except FailedJobError as error:  # the worker lacks something: a job's own errors are in its result
            last = str(error).strip().splitlines()[-1]
            return Result("failed", line=f"the worker cannot do it: {last}", trace=str(error))
        except UncompletedJobError:
            self._died = True
            raise WorkerDied(
                f"job {handle.job_id} ended without a result ({handle.state}); it printed {handle.paths.stderr}"
            ) from None

    def cancel(self, handle: Any) -> None:
        handle.cancel()

    def close(self, now: bool) -> None:
        for job in self._jobs if now else []:
            job.cancel()
        if not self._died and not now:
            shutil.rmtree(self._folder, ignore_errors=True)


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
