"""Random models whose colours depend on a light."""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.model.cosine import CosineDensity
from neuprim.core.model.primitives import Primitives
from neuprim.tasks.relight.colour import LightHarmonics, LightNetwork
from tests import scenes

COUNT = 12


def light(x: float = 2.0, y: float = -1.0, z: float = 3.0, strength: float = 1.0) -> dict[str, Tensor]:
    return {"light": torch.tensor([x, y, z]), "light_intensity": torch.full((3,), strength)}


def model(colour: LightNetwork | LightHarmonics, dtype: torch.dtype = torch.float64, neurons: int = 3) -> Primitives:
    generator = torch.Generator().manual_seed(5)
    t = scenes.tensors(COUNT, neurons, seed=3, dtype=dtype)
    params = {k: v for k, v in t.items() if k != "colors"}
    for spec in colour.parameters():
        params[spec.name] = 0.5 * torch.randn((COUNT, *spec.shape), generator=generator, dtype=dtype)
    params["c_dc"] = params["c_dc"].abs()
    return Primitives(CosineDensity(neurons), colour, {k: v.requires_grad_() for k, v in params.items()})
