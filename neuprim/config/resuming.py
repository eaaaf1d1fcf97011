"""What a run that goes on has from its directory: its own configuration, and who made it, where that is not
installed."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuprim.config.comparing import flat
from neuprim.config.from_file import choices_of
from neuprim.config.groups import task_choices
from neuprim.config.outputs import DEFAULT_TASK, ROOT, output_directory, run_name
from neuprim.config.overrides import NOT_SWEPT, Assignment, key_of, without_place
from neuprim.config.record import RunConfig
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.notices import warn_once
from neuprim.core.train.distributed.place import place_of
from neuprim.core.validation import format_value
from neuprim.plugins.mechanism import Group, UnknownPlugin
from neuprim.plugins.names import qualified, split
from neuprim.plugins.provenance import Maker, missing
from neuprim.plugins.registry import LOSSES, SCENES, TASKS

__all__ = [
    "begun_as",
    "begun_run",
    "chosen_again",
    "new_words",
    "not_installed",
    "of_launch",
    "refuse_contradictions",
    "words_of_both",
]


def not_installed(assignments: Sequence[Assignment], task: str | None, scene: str | None) -> ConfigError | None:
    """The error that names what made the run to resume, where that is missing; None where nothing is resumed or the
    fault is another.

    Args:
        assignments: all that was typed.
        task, scene: words that chose them; None: nothing was typed, and the run has its own.
    """
    given: dict[str, Any] = {a.key: a.value for a in assignments}
    if given.get("resume") is not True:
        return None
    directory = (
        _latest(task or DEFAULT_TASK)
        if given.get("output_dir") is None
        else Path(str(given["output_dir"])).expanduser()
    )
    try:
        made_by = None if directory is None else RunConfig.from_yaml(directory).made_by
    except NeuprimError:  # a damaged run says nothing
        return None
    if directory is None or made_by is None:
        return None
    kinds: tuple[tuple[Group[Any], Maker | None, Any], ...] = (
        (TASKS, made_by.task, task),
        (SCENES, made_by.scene, scene),
        (LOSSES, made_by.loss, given.get("train.loss")),
    )
    for group, maker, word in kinds:
        if maker is None or (word is not None and split(str(word))[1] != maker.name):
            continue  # the run had none, or another one is wanted now
        entry = f"{made_by.task.name}.{maker.name}" if group is SCENES else maker.name
        try:
            group.find(qualified(maker.package, entry))
        except UnknownPlugin:
            return ConfigError(f"{directory / 'config.yaml'}: {missing(group, maker, entry)}")
    return None


def begun_run(assignments: Sequence[Assignment], chosen: Mapping[str, str | None], file: bool) -> RunConfig | None:
    """The configuration of the run that ``resume=true`` goes on with; None where nothing is resumed, or nothing was
    begun there yet.

    Args:
        assignments: what was typed.
        chosen: the words of task and scene among it.
        file: whether the settings of a file (``--config``) stand below.

    Raises:
        ConfigError: only the place is said, and no run is there.
        CheckpointError, ConfigError: its ``config.yaml`` is damaged; of settings that do not exist it warns where
        others were typed.
        UnknownPlugin: the place follows from a task, which is not installed.
    """
    given: dict[str, Any] = {a.key: a.value for a in assignments}
    if given.get("resume") is not True:
        return None
    directory, bare = _directory(given.get("output_dir"), chosen), not file and given.keys() <= {"resume", "output_dir"}
    if (directory / "config.yaml").is_file() and (bare or not (directory / _SEARCH).exists()):
        try:
            return RunConfig.from_yaml(directory)
        except ConfigError as error:  # as of a version with other settings
            if bare:
                raise
            warn_once(f"{error}; the run goes on with what was typed alone")
            return None
    if bare:
        hint = ", or -m for the sweep there" if (directory / _SWEEP).is_file() else ""
        raise ConfigError(
            f"output_dir={directory} resume=true: no run was begun there (no config.yaml); expected a run's directory{hint}"
        )
    return None


def begun_as(directory: Path, words: Sequence[str]) -> bool | None:
    """Whether the run of a sweep was begun with these words; None where it was not begun."""
    if not (directory / "config.yaml").is_file():
        return None
    return without_place(RunConfig.from_yaml(directory).overrides) == without_place(words)


def chosen_again(begun: RunConfig, chosen: Mapping[str, str | None]) -> dict[str, str | None]:
    """Task, scene and preset of a run that goes on.

    Raises:
        ConfigError: another one was typed.
    """
    own = choices_of(begun)
    for key, word in own.items():
        typed = chosen.get(key)
        if typed is not None and split(typed)[1] != split(word)[1]:
            if key == "task":
                TASKS.find(typed)  # a typing error is none
            raise _contradiction(begun, key, typed, word)
    return {**chosen, **{key: chosen.get(key) or word for key, word in own.items()}}


def new_words(begun: RunConfig, overrides: Sequence[str]) -> list[str]:
    """The words that say something else than those that the run was begun with, and those of its place."""
    before, now = (
        {key_of(word): word for word in words} for words in (begun.overrides, overrides)
    )  # of each key the last
    return [
        word
        for word in overrides
        if key_of(word) in (*NOT_SWEPT, _SHARD, _VIEWS) or before.get(key_of(word)) != now[key_of(word)]
    ]


def of_launch(overrides: Sequence[str]) -> set[str]:
    """The settings that a run does not take over from how it was launched before: one process has all primitives, and
    where the words that describe the run are given to several, each has the views that these say."""
    if place_of() is None:
        return {_SHARD}
    return {_VIEWS} if {key_of(word) for word in overrides} & {"task", "scene"} else set()


def words_of_both(begun: RunConfig, overrides: Sequence[str]) -> list[str]:
    """What was typed for a run by now: of words with the same key, the later."""
    again = {key_of(word) for word in overrides}
    return [*(word for word in without_place(begun.overrides) if key_of(word) not in again), *overrides]


def refuse_contradictions(begun: RunConfig, now: RunConfig, paths: Iterable[str]) -> None:
    """Refuse settings that a run cannot change on its way. Rule: what a model is, and what it is trained on and for,
    stays; budgets, rates, renderers, where data lie and how much memory they take may change.

    Args:
        paths: the scene's settings that are paths.

    Raises:
        ConfigError: names the setting, and what the run was begun with.
    """
    free = {*(f"scene.{name}" for name in (*paths, *_FREE))}
    before, after = _fixed(begun), _fixed(now)
    for key, value in before.items():
        if key not in free and key in after and after[key] != value:
            raise _contradiction(begun, key, after[key], value)


_SHARD, _VIEWS = "train.shard", "train.views_per_step"
"""Settings of each process, which follow from how many are launched."""

_FREE = ("memory", "chunks")
"""Settings of scenes that may change: what is decoded at once, and the chunks, of which the record of what is done has
its own word."""

_SEARCH, _SWEEP = "target.json", "sweep.json"
"""Records of the directories that hold more than a run, and go on with the words of a search or of a sweep."""


def _contradiction(begun: RunConfig, key: str, typed: Any, was: Any) -> ConfigError:
    return ConfigError(
        f"{key}={format_value(typed)}: the run to resume was begun with {key}={format_value(was)} ({begun.source}); expected that, no {key}, or another output_dir"
    )


def _fixed(config: RunConfig) -> dict[str, Any]:
    tree = {"model": dataclasses.asdict(config.model), "scene": config.scene, "task": {"options": config.options}}
    found = flat({**tree, "seed": config.seed, "train": {"loss": config.train.loss}})
    return {key: list(value) if isinstance(value, tuple) else value for key, value in found.items()}


def _directory(asked: Any, chosen: Mapping[str, str | None]) -> Path:
    """Where the run to resume is, as :func:`~neuprim.config.outputs.output_directory` finds it."""
    if asked is not None:
        from omegaconf import OmegaConf
        from omegaconf.errors import OmegaConfBaseException

        try:
            return Path(str(OmegaConf.to_container(OmegaConf.create({"at": asked}), resolve=True)["at"])).expanduser()  # type: ignore[index, call-overload]
        except OmegaConfBaseException as error:
            raise ConfigError(
                f"output_dir={format_value(asked)}: {' '.join(str(error).split())}; expected a directory, to resume its run"
            ) from error
    task = chosen["task"] or DEFAULT_TASK
    scene = chosen["scene"] or task_choices(TASKS.loaded(task)[1]).scene
    return output_directory(None, run_name(task, scene), True)


def _latest(task: str) -> Path | None:
    """The newest directory that a run of that task made without being told where."""
    package, name = split(task)
    starts = (f"{name}-", f"{package}-{name}-")
    found = [entry for entry in ROOT.iterdir() if entry.name.startswith(starts)] if ROOT.is_dir() and name else []
    files = [entry / "config.yaml" for entry in found if (entry / "config.yaml").is_file()]
    return max(files, key=lambda file: file.stat().st_mtime).parent if files else None
