"""``neuprim run --config FILE``: the settings of an earlier run, under what is typed beside them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from neuprim.config.overrides import Assignment
from neuprim.config.record import RunConfig, RunSettings
from neuprim.core.errors import ConfigError
from neuprim.plugins.names import BUILT_IN, qualified, split

__all__ = ["as_data", "choices_of", "chosen_beside", "settings_below", "stored_config"]

_NOT_TAKEN = ("output_dir", "resume")


def stored_config(path: Path) -> RunConfig:
    """The configuration of a run, from its ``config.yaml`` or its directory.

    Raises:
        ConfigError: there is no such file, or a setting in it does not exist or has an impossible value.
        CheckpointError: it is no run's configuration.
    """
    if not path.exists():
        raise ConfigError(f"--config {path}: no such file; expected RUN_DIR/config.yaml of an earlier run")
    return RunConfig.from_yaml(path)


def choices_of(stored: RunConfig) -> dict[str, str]:
    """Task, scene and preset of a stored run, as words."""
    made = stored.made_by
    return {
        "task": _word(stored.task, made and made.task),
        "scene": _word(stored.scene_name, made and made.scene),
        "preset": stored.preset,
    }


def chosen_beside(stored: RunConfig, chosen: Mapping[str, str | None]) -> dict[str, str | None]:
    """Task, scene and preset: what was typed, else what the stored run had.

    Raises:
        ConfigError: another task, preset or level of effort was typed: every setting of theirs is in the file already.
    """
    own = choices_of(stored)
    for key in ("task", "preset", "effort"):
        typed = chosen.get(key)
        if typed is not None and split(typed)[1] != split(own.get(key, ""))[1]:
            raise ConfigError(
                f"{key}={typed}: the file of --config says every setting of {key if key != 'effort' else 'the level'} {own.get(key) or ''}".rstrip()
                + f"; expected no {key}= beside it"
            )
    return {**chosen, **{key: chosen.get(key) or word for key, word in own.items()}}


def settings_below(stored: RunConfig, scene: str | None, values: Sequence[Assignment]) -> Iterator[Assignment]:
    """Every setting of a stored run as an assignment that stands under the user's ``values``.

    Left out are those that the user's make void: of another scene, of another form of density, and the other kind of
    budget.
    """
    typed = {a.key for a in values}
    if split(scene or "")[1] == stored.scene_name:
        yield from (_assigned(f"scene.{key}", value) for key, value in stored.scene.items())
    yield _assigned("task.options", stored.options)
    for name, value in _leaves(stored):
        if name in stored.unused or (name == "model.density" and _other_form(value, values)):
            continue
        other = {"train.max_seconds": "train.iterations", "train.iterations": "train.max_seconds"}.get(name)
        yield _assigned(name, None if other in typed else value)


def as_data(value: Any, back: bool = False) -> Any:
    """A stored value with every ``${`` hidden from OmegaConf, which would look up what follows; or shown again.

    Rule: what a file says is data, and only what is typed or comes with a package may refer to something. No YAML text
    has the character 0.
    """
    if isinstance(value, Mapping):
        return {as_data(key, back): as_data(item, back) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [as_data(item, back) for item in value]
    if not isinstance(value, str):
        return value
    return value.replace("$\0", "$") if back else value.replace("$", "$\0")


def _leaves(stored: RunConfig) -> Iterator[tuple[str, Any]]:
    """(dotted name, value) of the settings that every task has; a group of free settings is one."""

    def below(name: str, value: Any) -> Iterator[tuple[str, Any]]:
        if dataclasses.is_dataclass(value) and not isinstance(value, type):
            for f in dataclasses.fields(value):
                yield from below(f"{name}.{f.name}", getattr(value, f.name))
        else:
            yield name, value

    for f in dataclasses.fields(RunSettings):
        if f.name not in _NOT_TAKEN:
            yield from below(f.name, getattr(stored, f.name))


def _assigned(key: str, value: Any) -> Assignment:
    return Assignment(key, value, f"{key} of --config", whole=True)


def _other_form(density: Any, values: Sequence[Assignment]) -> bool:
    said = [
        a.value if a.key == "model.density.form" else (a.value or {}).get("form")
        for a in values
        if a.key in ("model.density.form", "model.density")
    ]
    return any(form not in (None, (density or {}).get("form")) for form in said)


def _word(name: str, maker: Any) -> str:
    """``NAME``, or ``PACKAGE:NAME`` of another package's."""
    return name if maker is None or maker.package in ("", BUILT_IN) else qualified(maker.package, name)
