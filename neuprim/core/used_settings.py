"""Which settings a task or loss reads: its own options, and the shared settings that only some of them use.

The settings in :data:`OPTIONAL` are read by a task's ``build`` or by a loss, if at all. Whoever reads one says so in
``uses``; setting one that nobody reads is refused, and a function gets only those that it declared.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from neuprim.core.errors import ConfigError
from neuprim.core.train.settings import ModelSettings, TrainSettings

if TYPE_CHECKING:
    from neuprim.core.extensions import LossExtension
    from neuprim.core.task import TaskSpec

OPTIONAL = ("model.neurons", "model.sh_degree", "model.sh_every", "train.ssim_weight")
"""Shared settings that a task or loss uses only if it says so."""


class TrackedMapping(dict[str, Any]):
    """A group of settings as a plugin's function gets it; a setting that it forgot to declare is an error that says so.

    Args:
        owner: e.g. ``"task 'glow'"``.
        group: dotted name of the group, e.g. ``"model"``.
        member: of the plugin's description, where it declares what it reads.
    """

    def __init__(self, values: Mapping[str, Any], owner: str, group: str, member: str) -> None:
        super().__init__(values)
        self.owner, self.group, self.member = owner, group, member

    def __missing__(self, key: str) -> Any:
        if self.member == "uses" and f"{self.group}.{key}" not in OPTIONAL:
            raise KeyError(key)
        raise ConfigError(f"{self.owner} reads {self.group}.{key}, which its {self.member!r} does not declare")


def build_settings(task: TaskSpec, model: ModelSettings, options: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return what a task's ``build`` and ``check`` get: the model settings that it uses, and its options as "options".

    Args:
        options: values by name; what is missing takes its default, others are left out.
    """
    return _track_used_settings("model", vars(model), task, options, f"task {task.name!r}")


def loss_settings(
    owner: TaskSpec | LossExtension, train: TrainSettings, options: Mapping[str, Any]
) -> Mapping[str, Any]:
    """As :func:`build_settings`: return what makes a loss of the task or of the ``train.loss`` that owns it."""
    who = f"the loss of task {owner.name!r}" if hasattr(owner, "build") else f"loss {owner.name!r}"
    return _track_used_settings("train", vars(train), owner, options, who)


def _track_used_settings(
    group: str, values: Mapping[str, Any], spec: TaskSpec | LossExtension, options: Mapping[str, Any], owner: str
) -> TrackedMapping:
    used = {k: v for k, v in values.items() if f"{group}.{k}" not in OPTIONAL or f"{group}.{k}" in spec.uses}
    declared = {key: options.get(key, option[0]) for key, option in spec.options.items()}
    own = TrackedMapping(declared, owner, "task.options", "options")
    return TrackedMapping({**used, "options": own}, owner, group, "uses")
