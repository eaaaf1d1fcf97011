"""The one table of population strategies. A new one is a file of this package and a row here; the settings are checked
against it."""

from __future__ import annotations

from neuprim.core.errors import ConfigError
from neuprim.core.train.population.fixed import Fixed
from neuprim.core.train.population.gradient import Gradient
from neuprim.core.train.population.interface import Population
from neuprim.core.train.population.relocate import Relocate
from neuprim.core.train.settings import PopulationSettings

__all__ = ["TABLE", "check_name", "make_population", "names"]

TABLE: dict[str, type[Population]] = {"fixed": Fixed, "relocate": Relocate, "gradient": Gradient}
"""Value of ``train.population.strategy`` -> what it makes."""


def names() -> tuple[str, ...]:
    """Those of the whole table, in its order."""
    return tuple(TABLE)


def check_name(name: object) -> None:
    """Raise :class:`ConfigError` unless the setting ``train.population.strategy`` may have this value."""
    if name not in TABLE:
        *others, last = names()
        raise ConfigError(f"train.population.strategy={name!r}: expected {', '.join(others)} or {last}")


def make_population(settings: PopulationSettings) -> Population:
    """The strategy named in the settings.

    Raises:
        ConfigError: there is none of this name.
    """
    check_name(settings.strategy)
    return TABLE[settings.strategy](settings)
