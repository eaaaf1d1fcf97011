"""Settings of an earlier run, for ``neuprim run --config FILE`` and for a run that ``resume=true`` continues."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuprim.config.checks import flatten
from neuprim.config.outputs import DEFAULT_TASK, ROOT, output_directory, run_name
from neuprim.config.overrides import NOT_SWEPT, Assignment, drop_place, key_of
from neuprim.config.run_config import RunConfig, RunSettings
from neuprim.config.task_files import task_choices, to_plain
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.notices import warn_once
from neuprim.core.train.distributed.torchrun import read_torchrun_rank
from neuprim.core.validation import format_value
from neuprim.plugins.mechanism import Group, UnknownPlugin
from neuprim.plugins.names import BUILT_IN, qualified, split
from neuprim.plugins.provenance import Maker, missing
from neuprim.plugins.registry import LOSSES, SCENES, TASKS

__all__ = [
    "changed_overrides",
    "explain_missing_plugin",
    "find_resumed_run",
    "hide_references",
    "launch_settings",
    "merge_overrides",
    "read_stored_config",
    "refuse_contradictions",
    "resume_choices",
    "stored_assignments",
    "stored_choices",
    "was_begun_with",
]

_NOT_TAKEN = ("output_dir", "resume")
"""Settings of a stored run that say where it is."""

_VIEWS = "train.views_per_step"
"""Settings of each process, which follow from how many are launched."""

_FREE = ("memory", "chunks")
"""Settings of scenes that a resumed run may change: what is decoded at once, and the chunks (they have a record)."""

_SEARCH, _SWEEP = "target.json", "sweep.json"
"""Records of directories that hold more than one run; they go on with the overrides of a search or a sweep."""


# ---------------------------------------------------------------- --config


def read_stored_config(path: Path) -> RunConfig:
    """Return the configuration of a run, from its ``config.yaml`` or its directory.

    Raises:
        ConfigError: there is no such file, or a setting in it does not exist or has an impossible value.
        CheckpointError: it is no run's configuration.
    """
    if not path.exists():
        raise ConfigError(f"--config {path}: no such file; expected RUN_DIR/config.yaml of an earlier run")
    return RunConfig.from_yaml(path)


def stored_choices(stored: RunConfig, chosen: Mapping[str, str | None]) -> dict[str, str | None]:
    """Return task, scene and preset: what was typed, else what the stored run had.

    Raises:
        ConfigError: another task, preset or level was typed, although the file has every setting of the run's own.
    """
    own = _choices_of(stored)
    for key in ("task", "preset", "effort"):
        typed = chosen.get(key)
        if typed is not None and split(typed)[1] != split(own.get(key, ""))[1]:
            has = f"{key} {own[key]}" if key in own else "the level"
            raise ConfigError(
                f"{key}={typed}: the file of --config says every setting of {has}; expected no {key}= beside it"
            )
    return {**chosen, **{key: chosen.get(key) or word for key, word in own.items()}}


def stored_assignments(stored: RunConfig, scene: str | None, values: Sequence[Assignment]) -> Iterator[Assignment]:
    """Yield every setting of a stored run as an assignment that stands under the user's ``values``.

    Settings that the user's values make void are left out: of another scene or form of density, the other budget.
    """
    typed = {a.key for a in values}
    if split(scene or "")[1] == stored.scene_name:
        yield from (_assign(f"scene.{key}", value) for key, value in stored.scene.items())
    yield _assign("task.options", stored.options)
    for name, value in _leaves(stored):
        if name in stored.unused or (name == "model.density" and _types_other_form(value, values)):
            continue
        other = {"train.max_seconds": "train.iterations", "train.iterations": "train.max_seconds"}.get(name)
        yield _assign(name, None if other in typed else value)


def hide_references(value: Any, back: bool = False) -> Any:
    """Hide every ``$`` of a stored value from OmegaConf, which would look up what ``${...}`` names; or show it again.

    A file is data: only what users type or packages contain may refer to something. No YAML text has the character 0.
    """
    if isinstance(value, Mapping):
        return {hide_references(key, back): hide_references(item, back) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [hide_references(item, back) for item in value]
    if not isinstance(value, str):
        return value
    return value.replace("$\0", "$") if back else value.replace("$", "$\0")


def _choices_of(stored: RunConfig) -> dict[str, str]:
    """Task, scene and preset of a stored run; ``PACKAGE:NAME`` for those of another package."""
    made = stored.made_by

    def word(name: str, maker: Maker | None) -> str:
        return name if maker is None or maker.package in ("", BUILT_IN) else qualified(maker.package, name)

    return {
        "task": word(stored.task, None if made is None else made.task),
        "scene": word(stored.scene_name, None if made is None else made.scene),
        "preset": stored.preset,
    }


def _leaves(stored: RunConfig) -> Iterator[tuple[str, Any]]:
    """Dotted names and values of the settings that every task has; a group of free settings is one."""

    def below(name: str, value: Any) -> Iterator[tuple[str, Any]]:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            for field in dataclasses.fields(value):
                yield from below(f"{name}.{field.name}", getattr(value, field.name))
        else:
            yield name, value

    for field in dataclasses.fields(RunSettings):
        if field.name not in _NOT_TAKEN:
            yield from below(field.name, getattr(stored, field.name))


def _assign(key: str, value: Any) -> Assignment:
    return Assignment(key, value, f"{key} of --config", whole=True)


def _types_other_form(density: Any, values: Sequence[Assignment]) -> bool:
    typed = [
        a.value if a.key == "model.density.form" else (a.value or {}).get("form")
        for a in values
        if a.key in ("model.density.form", "model.density")
    ]
    return any(form not in (None, (density or {}).get("form")) for form in typed)


# ---------------------------------------------------------------- resume=true


def find_resumed_run(
    assignments: Sequence[Assignment], chosen: Mapping[str, str | None], has_file: bool
) -> RunConfig | None:
    """Return the configuration of the run that ``resume=true`` continues; None where nothing was begun there yet.

    Args:
        chosen: what was typed for task and scene.
        has_file: whether ``--config`` gives settings.

    Raises:
        ConfigError: only the directory was typed, and no run is there.
        CheckpointError, ConfigError: its ``config.yaml`` is damaged. Where settings were typed, unknown ones in the
            file are a warning.
        UnknownPlugin: the place follows from a task, which is not installed.
    """
    given: dict[str, Any] = {a.key: a.value for a in assignments}
    if given.get("resume") is not True:
        return None
    directory = _resumed_directory(given.get("output_dir"), chosen)
    bare = not has_file and given.keys() <= {"resume", "output_dir"}
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
            f"output_dir={directory} resume=true: no run was begun there (no config.yaml); "
            f"expected a run's directory{hint}"
        )
    return None


def was_begun_with(directory: Path, words: Sequence[str]) -> bool | None:
    """Whether the run of a sweep was begun with these overrides; None where it was not begun."""
    if not (directory / "config.yaml").is_file():
        return None
    return drop_place(RunConfig.from_yaml(directory).overrides) == drop_place(words)


def resume_choices(begun: RunConfig, chosen: Mapping[str, str | None]) -> dict[str, str | None]:
    """Return task, scene and preset of a run that goes on.

    Raises:
        ConfigError: another one was typed.
    """
    own = _choices_of(begun)
    for key, word in own.items():
        typed = chosen.get(key)
        if typed is not None and split(typed)[1] != split(word)[1]:
            if key == "task":
                TASKS.find(typed)  # a typing error is none
            raise _contradiction(begun, key, typed, word)
    return {**chosen, **{key: chosen.get(key) or word for key, word in own.items()}}


def changed_overrides(begun: RunConfig, overrides: Sequence[str]) -> list[str]:
    """Return the overrides that differ from those that the run was begun with, and those of its place."""
    before = {key_of(word): word for word in begun.overrides}
    now = {key_of(word): word for word in overrides}
    always = (*NOT_SWEPT, _VIEWS)
    return [word for word in overrides if key_of(word) in always or before.get(key_of(word)) != now[key_of(word)]]


def launch_settings(overrides: Sequence[str]) -> set[str]:
    """Return the settings that a resumed run does not take over, as they follow from how it is launched now.

    Where several ranks get the overrides that describe the run, these say each one's views.
    """
    if read_torchrun_rank() is None:
        return set()
    return {_VIEWS} if {key_of(word) for word in overrides} & {"task", "scene"} else set()


def merge_overrides(begun: RunConfig, overrides: Sequence[str]) -> list[str]:
    """Return what was typed for a run by now: of overrides with one key, the later."""
    again = {key_of(word) for word in overrides}
    return [*(word for word in drop_place(begun.overrides) if key_of(word) not in again), *overrides]


def refuse_contradictions(begun: RunConfig, now: RunConfig, paths: Iterable[str]) -> None:
    """Refuse settings that a run cannot change on its way.

    What the model is, and what it is trained on and for, stays. Budgets, rates, renderers, where data lie and how much
    memory they take may change.

    Args:
        paths: the scene's settings that are paths.

    Raises:
        ConfigError: names the setting, and what the run was begun with.
    """
    free = {f"scene.{name}" for name in (*paths, *_FREE)}
    before, after = _fixed_settings(begun), _fixed_settings(now)
    for key, value in before.items():
        if key not in free and key in after and after[key] != value:
            raise _contradiction(begun, key, after[key], value)


def explain_missing_plugin(
    assignments: Sequence[Assignment], task: str | None, scene: str | None
) -> ConfigError | None:
    """Return the error that names the package which made the run to resume; None where that is not what is missing.

    Args:
        task, scene: what was typed for them; None: the run has its own.
    """
    given: dict[str, Any] = {a.key: a.value for a in assignments}
    if given.get("resume") is not True:
        return None
    asked = given.get("output_dir")
    directory = _latest_run(task or DEFAULT_TASK) if asked is None else Path(str(asked)).expanduser()
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


def _contradiction(begun: RunConfig, key: str, typed: Any, was: Any) -> ConfigError:
    return ConfigError(
        f"{key}={format_value(typed)}: the run to resume was begun with {key}={format_value(was)} ({begun.source}); "
        f"expected that, no {key}, or another output_dir"
    )


def _fixed_settings(config: RunConfig) -> dict[str, Any]:
    tree = {"model": dataclasses.asdict(config.model), "scene": config.scene, "task": {"options": config.options}}
    found = flatten({**tree, "seed": config.seed, "train": {"loss": config.train.loss}})
    return {key: list(value) if isinstance(value, tuple) else value for key, value in found.items()}


def _resumed_directory(asked: Any, chosen: Mapping[str, str | None]) -> Path:
    """Where the run to resume is, as :func:`~neuprim.config.outputs.output_directory` finds it."""
    if asked is not None:
        from omegaconf import OmegaConf

        try:
            return Path(str(to_plain(OmegaConf.create({"at": asked}))["at"])).expanduser()
        except ConfigError as error:
            raise ConfigError(
                f"output_dir={format_value(asked)}: {error}; expected a directory, to resume its run"
            ) from error
    task = chosen["task"] or DEFAULT_TASK
    scene = chosen["scene"] or task_choices(TASKS.loaded(task)[1]).scene
    return output_directory(None, run_name(task, scene), True)


def _latest_run(task: str) -> Path | None:
    """The newest run directory of that task among those with names that nobody chose."""
    package, name = split(task)
    starts = (f"{name}-", f"{package}-{name}-")
    found = [entry for entry in ROOT.iterdir() if entry.name.startswith(starts)] if ROOT.is_dir() and name else []
    files = [entry / "config.yaml" for entry in found if (entry / "config.yaml").is_file()]
    return max(files, key=lambda file: file.stat().st_mtime).parent if files else None
