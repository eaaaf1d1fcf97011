"""A run's configuration: Hydra's key=value words and the tasks' YAML files in, one validated :class:`RunConfig` out."""

from neuprim.config.composing import compose, compose_all, preset_settings
from neuprim.config.groups import check_groups, check_scene, presets, task_choices
from neuprim.config.overrides import expand_sweep
from neuprim.config.record import RunConfig, RunSettings

__all__ = [
    "RunConfig",
    "RunSettings",
    "check_groups",
    "check_scene",
    "compose",
    "compose_all",
    "expand_sweep",
    "preset_settings",
    "presets",
    "task_choices",
]
