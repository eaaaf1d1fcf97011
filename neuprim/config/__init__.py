"""A run's configuration: Hydra's key=value words and the tasks' YAML files in, one validated :class:`RunConfig` out."""

from neuprim.config.composing import compose, compose_all
from neuprim.config.groups import check_groups, presets, task_choices
from neuprim.config.overrides import expand_sweep
from neuprim.config.record import RunConfig, RunSettings

__all__ = ["RunConfig", "RunSettings", "check_groups", "compose", "compose_all", "expand_sweep", "presets", "task_choices"]
