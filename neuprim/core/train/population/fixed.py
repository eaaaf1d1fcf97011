"""The strategy ``fixed``: the primitives of the start are those of the end."""

from __future__ import annotations

from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions
from neuprim.core.train.population.interface import Change, Population

__all__ = ["Fixed"]


class Fixed(Population):
    """Nothing is born and nothing dies."""

    plans = True

    def observe(self, model: Primitives, tally: Contributions) -> None:
        pass

    def intervene(self, model: Primitives, extent: float) -> Change | None:
        return None
