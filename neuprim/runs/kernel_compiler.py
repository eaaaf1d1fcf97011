"""Compile the CPU kernels of a run in a second process, while the first process generates or reads the images.

Compiling takes about a minute on one core, once per installation and task. The second process trains a few primitives
on noise images for one step. The first process then reads the compiled code from the kernel cache on disk.
"""

from __future__ import annotations

import atexit
import json
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

from neuprim.config import Job, RunConfig
from neuprim.core.compute import device
from neuprim.core.compute.kernels import cache_directory, sources_hash
from neuprim.core.compute.threads import core_count
from neuprim.core.render.cpu import backend
from neuprim.plugins.registry import TASKS
from neuprim.runs.fit import Events, Preparing, compile_run_kernels, make_run_loss, make_run_trainer
from neuprim.runs.forecast import noise_dataset

_SIZE, _PRIMITIVES = 32, 64  # pixels a side of the noise, primitives and points


class KernelCompiler:
    """Second process that compiles the CPU kernels of a run while the first process loads the data.

    The process only starts for a built-in task whose kernels no run has compiled before. It does not start on a machine
    with only one core, or if torch finds a CUDA device.

    Args:
        config: configuration of the run.
    """

    def __init__(self, config: RunConfig) -> None:
        self._marker = _marker(config.task)
        self._process: subprocess.Popen[bytes] | None = None
        own = any(info.built_in and info.name == config.task for info in TASKS.list_plugins())
        if not own or self.ready or core_count() < 2 or device.cuda_unavailable() is None:
            return
        command = [sys.executable, "-m", "neuprim.runs.kernel_compiler"]
        quiet = subprocess.DEVNULL
        self._process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=quiet, stderr=quiet)
        atexit.register(self._process.terminate)
        assert self._process.stdin is not None
        with suppress(BrokenPipeError), self._process.stdin as pipe:  # it may have failed already
            pipe.write(json.dumps(config.to_dict()).encode())

    @property
    def ready(self) -> bool:
        """Whether a run has compiled the kernels of this task before."""
        return self._marker.exists()

    def wait(self, events: Events) -> None:
        """Wait until the compiling process has ended; otherwise this process would compile the same kernels again."""
        if self._process is not None and self._process.poll() is None:
            events(Preparing("compiling kernels; once per installation this takes about a minute"))
            self._process.wait()

    def finish(self) -> None:
        """Create the marker file that says that the kernels of this task are compiled."""
        self._marker.touch()


def _marker(task: str) -> Path:
    """Return the path of a marker file, which exists if the kernels of this version were compiled for ``task``.

    There is one marker for all models of a task, because they share most kernels.
    """
    return cache_directory() / f"compiled-{sources_hash(Path(backend.__file__))}-{task}"


# ---------------------------------------------------------------- the second process


def _compile(config: RunConfig) -> None:
    job = Job.of(config)
    dataset = noise_dataset(job, _SIZE, _SIZE, _PRIMITIVES)
    small = replace(config, model=replace(config.model, primitives=_PRIMITIVES))
    compile_run_kernels(make_run_trainer(Job(small, job.task), dataset, make_run_loss(job)))


if __name__ == "__main__":
    _compile(RunConfig.from_dict(json.load(sys.stdin)))
