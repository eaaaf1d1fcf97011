"""Models of any two fields with every number moved, and a view of them."""

from __future__ import annotations

import torch

from neuprim.core.cameras import Camera, look_at
from neuprim.core.model.fields import Field
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.schema import InitContext

COUNT = 40
CONDITIONS = {"time": torch.tensor(0.3), "light": torch.tensor([2.0, 1.0, 3.0]), "light_intensity": torch.tensor(1.0)}


def camera() -> Camera:
    view = look_at(torch.tensor([0.0, -3.0, 0.5]), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(view, 20.0, 20.0, 8.0, 8.0, 16, 16)


def made(density: Field, colour: Field, noise: float = 0.3, seed: int = 1) -> Primitives:
    """A model of both fields with every number moved, so that nothing is at a start value that hides a mistake."""
    generator = torch.Generator().manual_seed(seed)
    means = torch.rand((COUNT, 3), generator=generator) - 0.5
    context = InitContext(means, torch.full((COUNT,), 0.3), torch.rand((COUNT, 3), generator=generator), generator)
    specs = [*GEOMETRY_SPECS, *density.parameters(), *colour.parameters()]
    moved = {s.name: s.init(context).float() for s in specs}
    return Primitives(
        density,  # type: ignore[arg-type]
        colour,  # type: ignore[arg-type]
        {name: value + noise * torch.randn(value.shape, generator=generator) for name, value in moved.items()},
    )
