"""One run of a sweep, where its worker is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from neuprim.config import RunConfig
from neuprim.runs.events import Events
from neuprim.runs.launch.jobs import Job

__all__ = ["fit_one", "job_of"]


def job_of(config: RunConfig) -> Job:
    """The run as a job."""
    return Job(config.output_dir.name, f"{__name__}:{fit_one.__name__}", config.to_dict())


def fit_one(data: Mapping[str, Any], attempt: int, events: Events) -> str:
    """Fit, measure and report; the run's directory. After its worker died it goes on from its checkpoint, if it had
    one."""
    from neuprim.runs.run import run

    config = RunConfig.from_dict(data)
    directory: Path = run(replace(config, resume=config.resume or attempt > 0), events)
    return str(directory)
