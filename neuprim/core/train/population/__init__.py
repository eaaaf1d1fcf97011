"""Birth, movement and death of primitives. Each strategy is one small object; all of them split exactly."""

from __future__ import annotations

from neuprim.core.train.population.fixed import Fixed
from neuprim.core.train.population.gradient import Gradient
from neuprim.core.train.population.interface import Change, Plan, Population
from neuprim.core.train.population.relocate import Relocate
from neuprim.core.train.population.splitting import (
    SPLIT_GAUSSIAN,
    SPLIT_LONG,
    SPLIT_OTHERS,
    SPLIT_SHIFT,
    children_of,
    split,
)
from neuprim.core.train.population.table import TABLE, check_name, make_population, names

__all__ = [
    "SPLIT_GAUSSIAN",
    "SPLIT_LONG",
    "SPLIT_OTHERS",
    "SPLIT_SHIFT",
    "TABLE",
    "Change",
    "Fixed",
    "Gradient",
    "Plan",
    "Population",
    "Relocate",
    "check_name",
    "children_of",
    "make_population",
    "names",
    "split",
]
