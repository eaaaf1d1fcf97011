"""Overrides, the ``key=value`` arguments of a command in Hydra's grammar: parse, expand to a sweep, and quote them."""

from __future__ import annotations

import itertools
import re
import shlex
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from neuprim.core.errors import ConfigError
from neuprim.core.validation import validate_settings

T = TypeVar("T")

NOT_SWEPT = ("output_dir", "resume")
MAX_RUNS = 10_000


@dataclass(frozen=True)
class Assignment:
    """One parsed override ``key=value``.

    Attributes:
        key: dotted key, e.g. ``train.iterations``.
        text: the override as typed.
    """

    key: str
    value: Any
    text: str


@dataclass(frozen=True)
class CommandLine:
    """The arguments of ``neuprim run``: overrides, and the file given with ``--config``."""

    overrides: Sequence[str]
    file: Path | None = None

    def resume_command(self, directory: Path) -> str:
        """Return the command line that continues the run in ``directory``, or the sweep that the run belongs to."""
        sweep = bool(swept_override_keys(self.overrides))
        overrides = drop_output_overrides(self.overrides)
        if not overrides and self.file is None and not (directory / "config.yaml").is_file():
            overrides = ["task=static"]  # the default, which a bare resume=true does not begin
        flags = [*(["-m"] if sweep else []), *([] if self.file is None else ["--config", str(self.file)])]
        last = ["--out", str(directory.parent if sweep else directory), "resume=true"]
        return shlex.join(["neuprim", "run", *flags, *overrides, *last])


def parse_overrides(overrides: Sequence[str]) -> list[Assignment]:
    """Parse overrides ``key=value``; raise ConfigError if an override is invalid or has several values.

    A leading ``+`` or ``++`` has no effect, because keys are checked by name.
    """
    found = []
    for override, text in zip(_parse_with_hydra(overrides), overrides, strict=True):
        if override.is_sweep_override():
            raise ConfigError(
                f"{text}: several values; add -m to run each of them, or quote the value: "
                f"{_quote_override_for_shell(text)}"
            )
        if override.package is not None:
            raise ConfigError(f"{text}: Hydra packages (@) are not supported; expected KEY=VALUE")
        found.append(Assignment(override.key_or_group, override.value(), text))
    return found


def take_settings(overrides: Sequence[str], group: str, cls: type[T]) -> tuple[Any, T, list[str]]:
    """Split overrides into the settings of one group and the other overrides.

    Returns:
        The value of ``group=VALUE``, None if absent; the settings, made from ``group.name=VALUE`` and
        ``group.name.key=VALUE``; and the other overrides.
    """
    own = [text for text in overrides if key_of(text).partition(".")[0] == group]
    for key in swept_override_keys(own):
        raise ConfigError(f"{key}: several values; expected one")
    values: dict[str, Any] = {}
    for assignment in parse_overrides(own):
        name, _, entry = assignment.key.partition(".")[2].partition(".")
        if entry:
            values.setdefault(name, {})[entry] = assignment.value
        else:
            values[name] = assignment.value
    whole = values.pop("", None)
    return whole, validate_settings(cls, values, group), [text for text in overrides if text not in own]


def expand_sweep_overrides(overrides: Sequence[str]) -> list[list[str]]:
    """Return one list of overrides for every run of a sweep. The runs are all combinations of the swept values.

    Several values are written with commas, ``range(...)`` or ``choice(...)``.

    The last key varies fastest: ``["a=1,2", "b=3"]`` gives ``[["a=1", "b=3"], ["a=2", "b=3"]]``.
    """
    choices: list[list[str]] = []
    count = 1
    for override, text in zip(_parse_with_hydra(overrides), overrides, strict=True):
        if not override.is_sweep_override():
            choices.append([text])
            continue
        key = override.get_key_element()
        if key.lstrip("+") in NOT_SWEPT:
            raise ConfigError(
                f"{text}: {key} cannot be swept; quote a value that contains commas: {_quote_override_for_shell(text)}"
            )
        try:
            values = [f"{key}={v}" for v in itertools.islice(override.sweep_string_iterator(), MAX_RUNS + 1)]
        except Exception as error:  # interval() and glob() have no list of values; range() may divide by a zero step
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ConfigError(f"{text}: cannot be swept ({reason}); list the values: {key}=A,B,C") from error
        if not values:
            raise ConfigError(f"{text}: no values to sweep; expected {key}=A,B,C")
        choices.append(values)
        count *= len(values)
        if count > MAX_RUNS:
            raise ConfigError(f"{text}: the sweep has more than {MAX_RUNS} runs; expected fewer values")
    return [list(combination) for combination in itertools.product(*choices)]


def sweep_override_names(overrides: Sequence[str], combinations: Sequence[Sequence[str]]) -> list[str]:
    """Return a unique directory name for each run of a sweep, from swept keys and values, e.g. ``seed-1``.

    ``combinations`` is the result of :func:`expand_sweep_overrides`.
    """
    swept = [i for i, override in enumerate(_parse_with_hydra(overrides)) if override.is_sweep_override()]
    names: list[str] = []
    for combination in combinations:
        text = "_".join(combination[i].lstrip("+").replace("=", "-", 1) for i in swept)
        name = (re.sub(r"[^A-Za-z0-9._+-]+", "_", text).strip("._") or "run")[:100]
        numbered = (f"{name}-{number}" for number in itertools.count(2))
        names.append(next(candidate for candidate in itertools.chain([name], numbered) if candidate not in names))
    return names


def quote_override(key: str, value: Any) -> str:
    """Return the override ``key=value``, quoted if necessary, from which :func:`parse_overrides` restores ``value``."""
    if value is None:
        return f"{key}=null"
    if not isinstance(value, str):
        return f"{key}={str(value).lower() if isinstance(value, bool) else repr(value)}"
    plain = f"{key}={value}"
    try:
        if value and parse_overrides([plain])[0].value == value:
            return plain
    except ConfigError:
        pass
    return f"{key}='" + re.sub(r"(\\*)('|$)", lambda m: 2 * m[1] + ("\\'" if m[2] else ""), value) + "'"


def key_of(override: str) -> str:
    """Return the key of ``KEY=VALUE`` or ``+KEY=VALUE``."""
    return override.partition("=")[0].strip().lstrip("+")


def drop_output_overrides(overrides: Iterable[str]) -> list[str]:
    """Return the overrides except ``output_dir`` and ``resume``."""
    return [text for text in overrides if key_of(text) not in NOT_SWEPT]


def swept_override_keys(overrides: Iterable[str]) -> list[str]:
    """Return the keys for which overrides give several values."""
    return [override.key_or_group for override in _parse_with_hydra(list(overrides)) if override.is_sweep_override()]


def _parse_with_hydra(overrides: Sequence[str]) -> list[Any]:
    """Parse overrides with Hydra; return its ``Override`` objects."""
    from hydra.core.override_parser.overrides_parser import OverridesParser
    from hydra.errors import HydraException

    parser = OverridesParser.create()
    found = []
    for text in overrides:
        key, equals, value = text.partition("=")
        if "#" in value and not re.search(r"[,='\"\[\]{}()]", value):  # fire.####.vdb means nothing in the grammar
            text = f"{key}='{value}'"
        if not equals or not re.fullmatch(r"\+{0,2}[\w@/-]+(\.[\w@/-]+)*", key.strip()) or "\n" in text:
            if text.startswith("~"):
                raise ConfigError(f"{text}: settings cannot be deleted; KEY=null unsets one")
            raise ConfigError(f"{' '.join(text.split())!r}: expected KEY=VALUE")
        try:
            found.append(parser.parse_override(text))
        except HydraException as error:
            hint = f"quote values that contain , = or brackets: {_quote_override_for_shell(text)}"
            raise ConfigError(f"{text}: cannot be read; {hint}") from error
    return found


def _quote_override_for_shell(text: str) -> str:
    """Return an override quoted so that both the shell and Hydra's grammar take its value literally."""
    key, _, value = text.partition("=")
    value = value.strip("'\"")
    return f"\"{key}='{value}'\""
