"""A run's configuration: Hydra's key=value words and the tasks' YAML files in, one validated :class:`RunConfig` out."""

from neuprim.config.compose import compose, compose_all, preset_settings
from neuprim.config.job import Job, current_provenance, find_run_plugins, find_run_scene, load_run_task
from neuprim.config.overrides import expand_sweep
from neuprim.config.run_config import RunConfig, RunSettings
from neuprim.config.stored_run import read_stored_config
from neuprim.config.task_files import check_groups, check_scene, presets, task_choices

__all__ = [
    "Job",
    "RunConfig",
    "RunSettings",
    "check_groups",
    "check_scene",
    "compose",
    "compose_all",
    "expand_sweep",
    "current_provenance",
    "preset_settings",
    "presets",
    "read_stored_config",
    "find_run_scene",
    "find_run_plugins",
    "task_choices",
    "load_run_task",
]
