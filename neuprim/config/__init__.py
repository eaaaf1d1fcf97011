"""A run's configuration: Hydra's key=value words and the tasks' YAML files in, one validated :class:`RunConfig` out."""

from neuprim.config.composing import compose, compose_all, preset_settings
from neuprim.config.from_file import stored_config
from neuprim.config.groups import check_groups, check_scene, presets, task_choices
from neuprim.config.overrides import expand_sweep
from neuprim.config.record import RunConfig, RunSettings
from neuprim.config.stored import made_now, scene_of, suspects_of, task_of

__all__ = [
    "RunConfig",
    "RunSettings",
    "check_groups",
    "check_scene",
    "compose",
    "compose_all",
    "expand_sweep",
    "made_now",
    "preset_settings",
    "presets",
    "scene_of",
    "stored_config",
    "suspects_of",
    "task_choices",
    "task_of",
]
