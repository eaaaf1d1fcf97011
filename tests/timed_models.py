"""Random models whose densities and colours change in time."""

from __future__ import annotations

import torch

from neuprim.core.model.primitives import Primitives
from neuprim.tasks.dynamic.colour import TimeHarmonics
from neuprim.tasks.dynamic.time_density import TimeDensity
from tests import scenes

COUNT = 30


def model(time: str, neurons: int = 4, count: int = COUNT, dtype: torch.dtype = torch.float64) -> Primitives:
    """Random primitives whose every time parameter is at work."""
    generator = torch.Generator().manual_seed(7)
    t = scenes.tensors(count, neurons, seed=3, dtype=dtype)
    density, colour = TimeDensity(neurons, time), TimeHarmonics(1)
    params = {k: v for k, v in t.items() if k != "colors"}
    for spec in (*density.parameters(), *colour.parameters()):
        if spec.name not in params:
            params[spec.name] = 0.1 * torch.randn((count, *spec.shape), generator=generator, dtype=dtype)
    if "window" in time:
        params["window_center"] = torch.rand((count, 1), generator=generator, dtype=dtype)
        params["log_window"] = (0.1 + 0.4 * torch.rand((count, 1), generator=generator, dtype=dtype)).log()
    return Primitives(density, colour, {k: v.requires_grad_() for k, v in params.items()})
