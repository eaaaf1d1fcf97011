"""Run directories: choose where a run writes, and read the settings of an earlier run safely.

``neuprim run --config FILE`` and ``resume=true`` start from the settings of an earlier run.

A stored configuration is untrusted. neuprim reads the files that the configuration names. neuprim only contacts a
network address, or writes outside the run directory, if the user typed the setting or passed ``--trust``.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from neuprim.config.run_config import RunConfig, flatten
from neuprim.config.setting_checks import CHOICES
from neuprim.config.task_files import read_task_config
from neuprim.core.errors import ConfigError, cut_error_text, warn_once
from neuprim.core.io.trust import ENVIRONMENT, FLAG, trusted
from neuprim.core.validation import format_setting_value
from neuprim.plugins.provenance import PluginVersion
from neuprim.plugins.registry import BUILT_IN, TASKS, split_plugin_name

ROOT = Path("outputs")
DEFAULT_TASK = "static"
Choices = Mapping[str, str | None]
"""Mapping from each of the keys task, scene, preset and effort to the value that the user typed, None if not typed."""

_FREE = ("memory", "chunks")
"""Scene settings that a resumed run may change: memory for decoding, and chunks, which ``chunks.json`` records."""

_SEARCH, _SWEEP = "target.json", "sweep.json"
"""Names of the record files of a search for a target and of a sweep, which resume with their own overrides."""


def read_stored_config(path: Path) -> RunConfig:
    """Read the configuration of an earlier run from ``path``, its ``config.yaml`` or its directory."""
    if not path.exists():
        raise ConfigError(f"--config {path}: no such file; expected RUN_DIR/config.yaml of an earlier run")
    return RunConfig.from_yaml(path)


def stored_choices(stored: RunConfig, typed: Choices, resumed: bool = False) -> dict[str, str | None]:
    """Return task, scene, preset and level of effort: what the user typed, or else what the stored run has.

    With ``--config`` the user may type another scene. With ``resume=true`` (``resumed`` is True) the user may type a
    level of effort.

    Raises:
        ConfigError: a typed choice contradicts the stored run.
    """
    own = _stored_choices_of(stored)
    for key in ("task", "scene", "preset") if resumed else ("task", "preset", "effort"):
        if typed[key] is None or split_plugin_name(str(typed[key]))[1] == split_plugin_name(own[key] or "")[1]:
            continue
        if key == "task" and resumed:
            TASKS.find(str(typed[key]))  # a misspelt name is reported as such
        if resumed:
            raise _resumed_config_error(stored, key, typed[key], own[key])
        has = f"that {key}= sets" if own[key] is None else f"of {key} {own[key]}"
        raise ConfigError(
            f"{key}={typed[key]}: the file of --config already includes the settings {has}; leave {key}= out"
        )
    return {key: typed[key] or own[key] for key in CHOICES}


def stored_settings(stored: RunConfig, same_scene: bool) -> dict[str, Any]:
    """Return key -> value of a stored run's settings, to be merged with OmegaConf.

    A value replaces the whole value of its key; dictionaries are not merged. A stored file may not use references
    ``${...}``; only overrides and packages may. A character 0 is inserted after every ``$``, so that OmegaConf
    resolves no reference. :func:`restore_config_references` removes these characters. With ``same_scene``, the settings
    of the scene are included.
    """
    tree = stored.to_dict()
    found = {key: tree[key] for key in ("model", "train", "renderer", "metrics", "seed")}
    found["task.options"] = stored.options
    if same_scene:
        found |= {f"scene.{key}": value for key, value in stored.scene.items()}
    return {key: _replace_config_text(value, "$", "$\0") for key, value in found.items()}


def restore_config_references(value: Any) -> Any:
    """Return ``value`` without the character 0 that :func:`stored_settings` inserts after every ``$`` of its texts.

    YAML text cannot contain the character 0, so no other text is changed.
    """
    return _replace_config_text(value, "$\0", "$")


def _replace_config_text(value: Any, old: str, new: str) -> Any:
    if isinstance(value, Mapping):
        return {
            _replace_config_text(key, old, new): _replace_config_text(item, old, new) for key, item in value.items()
        }
    if isinstance(value, list | tuple):
        return [_replace_config_text(item, old, new) for item in value]
    return value.replace(old, new) if isinstance(value, str) else value


def _stored_choices_of(stored: RunConfig) -> dict[str, str | None]:
    made = stored.made_by

    def name_of(name: str, maker: PluginVersion | None) -> str:
        return name if maker is None or maker.package in ("", BUILT_IN) else maker.qualified_name

    return {
        "task": name_of(stored.task, made.task),
        "scene": name_of(stored.scene_name, made.scene),
        "preset": stored.preset,
        "effort": None,
    }


# ---------------------------------------------------------------- resume=true


def find_resumed_config(typed: Mapping[str, Any], choices: Choices, has_file: bool) -> RunConfig | None:
    """Return the configuration of the run that ``resume=true`` continues; None without ``resume=true`` or such a run.

    Args:
        typed: key -> value of the overrides.
        has_file: whether the user passed ``--config``.

    Raises:
        ConfigError: no settings were typed and the directory holds no run, or a folder in the directory is a link to
            a place outside.
        CheckpointError, ConfigError: the run's ``config.yaml`` is damaged. If settings were typed, an invalid setting
            in the file is only a warning.
        UnknownPlugin: the directory's default name needs a task that is not installed.
    """
    if typed.get("resume") is not True:
        return None
    if typed.get("output_dir") is not None:
        directory = Path(str(typed["output_dir"])).expanduser()
    else:
        task = choices["task"] or DEFAULT_TASK
        scene = choices["scene"] or read_task_config(TASKS.load_with_info(task)[1]).scene
        directory = config_output_directory(None, config_output_name(task, scene), True)
    bare = not has_file and typed.keys() <= {"resume", "output_dir"}
    if (directory / "config.yaml").is_file() and (bare or not (directory / _SEARCH).exists()):
        refuse_untrusted_run_links(directory)
        try:
            return RunConfig.from_yaml(directory)
        except ConfigError as error:  # as of a version with other settings
            if bare:
                raise
            warn_once(f"{error}; the stored settings are ignored, only those of the command line are used")
            return None
    if bare:
        hint = ", or -m to continue the sweep there" if (directory / _SWEEP).is_file() else ""
        raise ConfigError(
            f"--out {directory} resume=true: no run to continue (no config.yaml); expected a run directory{hint}"
        )
    return None


def refuse_contradictions(begun: RunConfig, now: RunConfig, paths: Iterable[str]) -> None:
    """Raise ConfigError if a resumed run changes its model, scene, task options, seed or loss.

    Budgets, learning rates, renderer and memory settings may change, and so may the scene settings with paths.

    Args:
        begun: stored configuration of the run.
        now: configuration with which the run resumes.
        paths: names of the scene settings that hold paths of data files.
    """
    free = {f"scene.{name}" for name in (*paths, *_FREE)}
    before, after = _fixed_config_settings(begun), _fixed_config_settings(now)
    for key, value in before.items():
        if key not in free and key in after and after[key] != value:
            raise _resumed_config_error(begun, key, after[key], value)


def _resumed_config_error(begun: RunConfig, key: str, typed: Any, was: Any) -> ConfigError:
    return ConfigError(
        f"{key}={format_setting_value(typed)}: the run to resume was started with "
        f"{key}={format_setting_value(was)} ({begun.source}); "
        f"expected the same value, no {key}, or another --out DIR"
    )


def _fixed_config_settings(config: RunConfig) -> dict[str, Any]:
    tree = config.to_dict()
    options = {"options": tree["task"]["options"]}
    found = flatten({"model": tree["model"], "scene": config.scene, "task": options, "seed": config.seed})
    found["train.loss"] = config.train.loss
    return {key: list(value) if isinstance(value, tuple) else value for key, value in found.items()}


# ---------------------------------------------------------------- what a file may reach


def refuse_untrusted_settings(config: RunConfig, typed: Mapping[str, Any] | None = None) -> None:
    """Raise ConfigError if an untrusted configuration names an address, or a folder outside its run to write to.

    Args:
        config: the configuration; it is trusted if it was not read from a file (no ``source``).
        typed: dotted keys of the settings that the user typed and so allows; None if the command takes no settings.
    """
    if config.source is None or trusted():
        return
    tree = {
        "scene": config.scene,
        "task.options": config.options,
        "model.init": config.model.init,
        "metrics.lpips": config.metrics.lpips,
    }
    run_dir = config.source.parent.resolve()
    for key, value in _list_config_texts("", tree):
        if typed is not None and any(key == name or key.startswith(f"{name}.") for name in typed):
            continue
        share = value.startswith("\\\\" if os.name != "nt" else ("\\\\", "//"))
        if share or "://" in value or "::" in value:  # a URL, a chain of them, or a Windows share
            what = "a network address that neuprim would contact"
        elif key == "scene.cache" and not Path(value).expanduser().resolve().is_relative_to(run_dir):
            what = "a folder outside of the run that neuprim would write to"
        else:
            continue
        allow = f"add {key}=... to the command" if typed is not None else f"add {FLAG}"
        raise ConfigError(
            f"{config.source}: {key} is {cut_error_text(value)!r}, {what}; to allow it, {allow} or, for all runs, set "
            f"{ENVIRONMENT}=1"
        )


def refuse_untrusted_run_links(run_dir: Path) -> None:
    """Raise ConfigError if a folder in a run directory is a link to a place outside, unless the user trusts the run."""
    if trusted() or not run_dir.is_dir():
        return
    whole = run_dir.resolve()
    for entry in os.scandir(run_dir):
        if entry.is_symlink() and entry.is_dir() and whole not in (there := Path(entry.path).resolve()).parents:
            raise ConfigError(
                f"{entry.path}: is a link to {there}, outside of the run; expected a folder, or {FLAG} to follow it"
            )


def _list_config_texts(key: str, value: Any) -> Iterator[tuple[str, str]]:
    if isinstance(value, Mapping):
        for name, item in value.items():
            yield from _list_config_texts(f"{key}.{name}" if key else str(name), item)
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _list_config_texts(key, item)
    elif isinstance(value, str | Path):
        yield key, str(value)


# ---------------------------------------------------------------- where a run writes


def config_output_name(task: str, scene: str) -> str:
    """Return the default name of a run's directory, ``<task>-<scene>``; ``PACKAGE:NAME`` becomes ``PACKAGE-NAME``."""
    return "-".join(part for word in (task, scene) for part in split_plugin_name(word) if part)


def config_output_directory(asked: str | None, name: str, resume: bool, check: bool = True) -> Path:
    """Return the directory of a run or sweep; nothing is created.

    Args:
        asked: the user's ``output_dir``, or None for ``outputs/NAME``, ``outputs/NAME-2``, ...
        name: ``<task>-<scene>``.
        resume: whether the run continues; without ``asked``, the existing directory with the highest number is used.
        check: whether to refuse an ``asked`` directory that holds files (unless ``resume``).
    """
    if asked is None:
        number = max(_config_output_numbers(name), default=0) + (not resume)
        return ROOT / (name if number <= 1 else f"{name}-{number}")
    if not asked.strip():
        raise ConfigError("--out '': expected a directory")
    path = Path(asked).expanduser()
    if not check:
        return path
    try:
        if not resume and path.is_dir() and any(path.iterdir()):
            raise ConfigError(
                f"--out {path}: exists and is not empty; use another directory, or continue the run with resume=true"
            )
        there = next(p for p in (path.absolute(), *path.absolute().parents) if p.exists())
        if not there.is_dir():
            raise ConfigError(f"--out {path}: {there} is a file; expected a directory")
        if not os.access(there, os.W_OK | os.X_OK):
            raise ConfigError(f"--out {path}: {there} cannot be written to")
    except (OSError, ValueError) as error:
        raise ConfigError(f"--out {path}: {error}") from error
    return path


def _config_output_numbers(name: str) -> list[int]:
    """Return the numbers of existing directories in the output root: 1 for ``NAME``, n for ``NAME-n``."""
    if not ROOT.is_dir():
        return []
    pattern = re.compile(re.escape(name) + r"(?:-(\d+))?")
    matches = (pattern.fullmatch(entry.name) for entry in ROOT.iterdir())
    return [int(m.group(1) or 1) for m in matches if m]
