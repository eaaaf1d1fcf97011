"""Random static models of cosine densities with constant colours."""

from __future__ import annotations

from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.tasks.static import SphericalHarmonics
from tests import scenes


def model(neurons: int = 5, edge: int = 0, seed: int = 2, count: int = 40) -> Primitives:
    t = scenes.tensors(count, neurons, seed=seed)
    t["sh_dc"] = t.pop("colors")
    return Primitives(CosineDensity(neurons, edge=edge), SphericalHarmonics(0), t)
