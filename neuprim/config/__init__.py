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
    "Job", "RunConfig", "RunSettings", "check_config_groups", "check_scene_config", "compose", "compose_all",
    "current_config_provenance", "expand_sweep_overrides", "find_config_plugins", "find_config_scene",
    "list_task_presets", "load_config_task", "preset_settings", "read_stored_config", "read_task_config",
]  # fmt: skip
