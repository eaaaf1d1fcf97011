"""Configuration of runs: combine ``key=value`` overrides and YAML files of tasks into one validated
:class:`RunConfig`."""

from neuprim.config.compose import compose, compose_all, preset_settings
from neuprim.config.overrides import expand_sweep_overrides
from neuprim.config.run_config import (
    Job,
    RunConfig,
    RunSettings,
    current_config_provenance,
    find_config_plugins,
    find_config_scene,
    load_config_task,
)
from neuprim.config.stored_run import read_stored_config
from neuprim.config.task_files import check_config_groups, check_scene_config, list_task_presets, read_task_config

__all__ = [
    "Job",
    "RunConfig",
    "RunSettings",
    "check_config_groups",
    "check_scene_config",
    "compose",
    "compose_all",
    "expand_sweep_overrides",
    "current_config_provenance",
    "preset_settings",
    "list_task_presets",
    "read_stored_config",
    "find_config_scene",
    "find_config_plugins",
    "read_task_config",
    "load_config_task",
]
