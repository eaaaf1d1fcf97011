"""Settings that a run's task and loss do not have or do not use: refused before any data is loaded."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from neuprim.config.overrides import Assignment
from neuprim.config.record import RunSettings
from neuprim.config.schema import setting_names
from neuprim.core.errors import ConfigError, nearest
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.core.used_settings import OPTIONAL
from neuprim.core.validation import Option, coerce, format_value, option_type, refuse_unknown

if TYPE_CHECKING:
    from neuprim.core.extensions import LossExtension
    from neuprim.core.task import TaskSpec

__all__ = ["check_names", "check_preset", "check_typed", "complete_options", "options_of", "unused"]

Options = Mapping[str, Option]


# ---------------------------------------------------------------- task.options


def options_of(spec: TaskSpec, loss: LossExtension | None) -> Options:
    """Name -> option of all that may stand under ``task.options``: the task's own and those of the loss chosen.

    Raises:
        ConfigError: both have one of the same name, so that it could not be said which is meant.
    """
    if loss is None:
        return spec.options
    both = sorted(spec.options.keys() & loss.options.keys())
    if both:
        raise ConfigError(
            f"train.loss={loss.name}: the loss and task {spec.name!r} both have an option {both[0]!r}; they cannot be combined"
        )
    return {**spec.options, **loss.options}


def complete_options(declared: Options, given: Any, owner: str, where: str = "task.options") -> dict[str, Any]:
    """Every declared option: as given, converted to its type, else the default.

    Args:
        owner: whose options they are, for messages.
        where: dotted name of the group, for messages.

    Raises:
        ConfigError: no such option, or a value that it does not take.
    """
    if not isinstance(given, Mapping):
        raise ConfigError(f"{where}={format_value(given)}: expected entries, each as {where}.KEY=VALUE")
    for key in given:
        if key not in declared:
            raise ConfigError(f"{where}.{key}: {owner} has no such option{_hint(str(key), declared)}")
    return {
        key: coerce(given.get(key, option[0]), option_type(option), f"{where}.{key}")
        for key, option in declared.items()
    }


def _hint(key: str, declared: Options) -> str:
    shared = [name for name in setting_names(RunSettings) if name.rpartition(".")[2] == key]
    if shared:
        return f"; did you mean {' or '.join(map(repr, shared))}?"
    return nearest(key, declared) or "; it has none"


# ---------------------------------------------------------------- shared settings


def unused(spec: TaskSpec, loss: LossExtension | None) -> tuple[str, ...]:
    """The optional shared settings that neither the task nor the loss of a run reads."""
    train = spec.uses if loss is None else loss.uses
    return tuple(name for name in OPTIONAL if name not in (spec.uses if name.startswith("model.") else train))


def check_typed(spec: TaskSpec, loss: LossExtension | None, values: Sequence[Assignment]) -> None:
    """Refuse what the user typed for a shared setting that nothing would read.

    Raises:
        ConfigError: naming it, and those that are used.
    """
    missing = unused(spec, loss)
    for assignment in values:
        for name in _dotted(assignment.key, assignment.value):
            if name in missing:
                _refuse(name, spec, loss)


def check_preset(spec: TaskSpec, loss: LossExtension | None, preset: Mapping[str, Any]) -> None:
    """As :func:`check_typed`, for what a preset sets; it may also set what the task's own loss reads while another one
    is chosen."""
    missing = set(unused(spec, loss)) & set(unused(spec, None))
    for name in _dotted("", preset):
        if name in missing:
            _refuse(name, spec, None)


def _refuse(name: str, spec: TaskSpec, loss: LossExtension | None) -> None:
    owner, uses = f"task {spec.name!r}", spec.uses
    if loss is not None and name.startswith("train."):
        owner, uses = f"loss {loss.name!r}", loss.uses
    used = f"; it uses {', '.join(uses)}" if uses else ""
    raise ConfigError(f"{name}: {owner} does not use this setting{used}")


def _dotted(where: str, value: Any) -> Iterator[str]:
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _dotted(f"{where}.{key}" if where else str(key), inner)
    else:
        yield where


# ---------------------------------------------------------------- names of parameters and of what initialisers read


def check_names(spec: TaskSpec, settings: RunSettings) -> None:
    """Refuse names under ``model.init``, ``train.rates`` and ``train.rate_units`` that no field of the task has, as far
    as the task lists its fields.

    The model itself may have fewer; what it lacks is refused when it is made.
    """
    classes = list((spec.fields or {}).values())
    if not classes:
        return
    init = {"scale", "points", "surroundings", *(name for cls in classes for name in cls.init_settings)}
    refuse_unknown(settings.model.init, init, "model.init")
    try:
        parameters = {s.name for s in (*GEOMETRY_SPECS, *(s for cls in classes for s in cls.every_parameter()))}
    except TypeError:  # a field that cannot be made without settings
        return
    for group, given in (("rates", settings.train.rates), ("rate_units", settings.train.rate_units)):
        for key in given:
            if key not in parameters:
                raise ConfigError(f"train.{group}.{key}: no such parameter{nearest(key, parameters)}")
