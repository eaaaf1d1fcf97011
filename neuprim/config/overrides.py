"""The words after ``neuprim run``: Hydra's key=value grammar, its sweeps, and messages for what it cannot read."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from neuprim.core.errors import ConfigError

__all__ = [
    "Assignment",
    "CommandLine",
    "drop_place",
    "expand_sweep",
    "key_of",
    "parse",
    "sweep_names",
    "swept_keys",
    "quote_override",
    "take_group",
]

NOT_SWEPT = ("output_dir", "resume")
MAX_RUNS = 10_000


@dataclass(frozen=True)
class Assignment:
    """One ``key=value``; ``key`` is dotted, ``text`` is what was typed. ``whole``: a mapping takes the place of what
    was there, instead of entries of it."""

    key: str
    value: Any
    text: str
    whole: bool = False


def parse(overrides: Sequence[str]) -> list[Assignment]:
    """Assignments in the order given.

    A leading ``+`` or ``++`` is accepted and means nothing here: whether a key exists is checked by name, not by
    prefix.

    Raises:
        ConfigError: for anything that is not one assignment of one value.
    """
    return [_assignment(o, text) for o, text in zip(_read(overrides), overrides, strict=True)]


def expand_sweep(overrides: Sequence[str]) -> list[list[str]]:
    """Every combination of the values separated by commas, or given by ``range(...)`` or ``choice(...)``, one list per
    run.

    The last key varies fastest. ``["a=1,2", "b=3"]`` gives ``[["a=1", "b=3"], ["a=2", "b=3"]]``.
    """
    choices: list[list[str]] = []
    count = 1
    for override, text in zip(_read(overrides), overrides, strict=True):
        if not override.is_sweep_override():
            choices.append([text])
            continue
        key = override.get_key_element()
        if key.lstrip("+") in NOT_SWEPT:
            raise ConfigError(f"{text}: {key} cannot be swept; quote a value that contains commas: {_quoted(text)}")
        try:
            values = [f"{key}={v}" for v in itertools.islice(override.sweep_string_iterator(), MAX_RUNS + 1)]
        except Exception as error:  # interval() and glob() have no list of values; range() may divide by a zero step
            raise ConfigError(f"{text}: cannot be swept ({_line(error)}); list the values: {key}=A,B,C") from error
        if not values:
            raise ConfigError(f"{text}: no values to sweep")
        choices.append(values)
        count *= len(values)
        if count > MAX_RUNS:
            raise ConfigError(f"{text}: more than {MAX_RUNS} runs in one sweep")
    return [list(combination) for combination in itertools.product(*choices)]


def sweep_names(overrides: Sequence[str], combinations: Sequence[Sequence[str]]) -> list[str]:
    """A file-name-safe directory name for each combination, made of the swept keys and their values; all different."""
    swept = [i for i, o in enumerate(_read(overrides)) if o.is_sweep_override()]
    names: list[str] = []
    for combination in combinations:
        parts = [combination[i].lstrip("+") for i in swept]
        name = _safe("_".join(part.replace("=", "-", 1) for part in parts)) or "run"
        name, number = name[:100], 1
        while (name if number == 1 else f"{name}-{number}") in names:
            number += 1
        names.append(name if number == 1 else f"{name}-{number}")
    return names


def quote_override(key: str, value: Any) -> str:
    """Return ``key=value`` as :func:`parse` reads it back; text that would be read as something else is quoted."""
    if value is None:
        return f"{key}=null"
    if not isinstance(value, str):
        return f"{key}={str(value).lower() if isinstance(value, bool) else repr(value)}"
    plain = f"{key}={value}"
    try:
        if value and parse([plain])[0].value == value:
            return plain
    except ConfigError:
        pass
    return f"{key}='" + re.sub(r"(\\*)('|$)", lambda m: 2 * m[1] + ("\\'" if m[2] else ""), value) + "'"


@dataclass(frozen=True)
class CommandLine:
    """What was typed after ``neuprim run``: overrides, and the file of ``--config``."""

    overrides: Sequence[str]
    file: Path | None = None

    def resume_arguments(self, directory: Path) -> list[str]:
        """Return the arguments that continue what these began: a run in ``directory``, or the sweep it is a part of."""
        sweep = bool(swept_keys(self.overrides))
        words = drop_place(self.overrides)
        if not words and self.file is None and not (directory / "config.yaml").is_file():
            words = ["task=static"]  # the default, which a bare resume=true does not begin
        flags = [*(["-m"] if sweep else []), *([] if self.file is None else ["--config", str(self.file)])]
        place = str(directory.parent if sweep else directory)
        return [*flags, *words, quote_override("output_dir", place), "resume=true"]


def take_group(overrides: Sequence[str], group: str) -> tuple[dict[str, Any], list[str]]:
    """Take the settings of one group out of overrides.

    Returns:
        Name -> value, the value of ``group=VALUE`` under "", and entries ``group.name.key=VALUE`` as a mapping; and the
        other overrides.

    Raises:
        ConfigError: several values for one setting.
    """
    own = [word for word in overrides if key_of(word).partition(".")[0] == group]
    for key in swept_keys(own):
        raise ConfigError(f"{key}: several values; expected one")
    values: dict[str, Any] = {}
    for assignment in parse(own):
        name, _, entry = assignment.key.partition(".")[2].partition(".")
        if entry:
            values.setdefault(name, {})[entry] = assignment.value
        else:
            values[name] = assignment.value
    return values, [word for word in overrides if word not in own]


def key_of(word: str) -> str:
    """The key of ``KEY=VALUE`` or ``+KEY=VALUE``, as it is typed."""
    return word.partition("=")[0].strip().lstrip("+")


def drop_place(overrides: Iterable[str]) -> list[str]:
    """The words that say what is made, and not where or whether it goes on."""
    return [word for word in overrides if key_of(word) not in NOT_SWEPT]


def swept_keys(overrides: Iterable[str]) -> list[str]:
    """Keys that have several values."""
    return [o.key_or_group for o in _read(list(overrides)) if o.is_sweep_override()]


def _read(overrides: Sequence[str]) -> list[Any]:
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create()
    result = []
    for text in overrides:
        key, equals, _ = text.partition("=")
        if not equals or not re.fullmatch(r"\+{0,2}[\w@/-]+(\.[\w@/-]+)*", key.strip()) or "\n" in text:
            if text.startswith("~"):
                raise ConfigError(f"{text}: settings cannot be deleted; KEY=null unsets one")
            raise ConfigError(f"{' '.join(text.split())!r}: expected KEY=VALUE")
        try:
            result.append(parser.parse_override(text))
        except HydraException as error:
            raise ConfigError(
                f"{text}: cannot be read; quote values that contain , = or brackets: {_quoted(text)}"
            ) from error
    return result


def _assignment(override: Any, text: str) -> Assignment:
    if override.is_sweep_override():
        raise ConfigError(f"{text}: several values; add -m to run each of them, or quote the value: {_quoted(text)}")
    if override.package is not None:
        raise ConfigError(f"{text}: packages (@) are not used here; expected KEY=VALUE")
    return Assignment(override.key_or_group, override.value(), text)


def _quoted(text: str) -> str:
    """How to type an assignment so that both the shell and the grammar take its value literally."""
    key, _, value = text.partition("=")
    value = value.strip("'\"")
    return f"\"{key}='{value}'\""


def _safe(text: str) -> str:
    return re.sub(r"[^A-Za-z0-9._+-]+", "_", text).strip("._")


def _line(error: BaseException) -> str:
    return " ".join(str(error).split()) or type(error).__name__
