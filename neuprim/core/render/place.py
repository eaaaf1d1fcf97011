"""Where a model is kept while it is trained or drawn many times."""

from __future__ import annotations

import torch

from neuprim.core.cameras.projections import AnyCamera
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.backends import run_device
from neuprim.core.settings import RenderSettings

__all__ = ["device_of"]

_FEW = 64  # primitives that stand for a model, as only its forms count


def device_of(model: Primitives, settings: RenderSettings, camera: AnyCamera, conditions: Conditions) -> torch.device:
    """The device that frames like this one are best drawn on, see :attr:`~neuprim.core.settings.RenderSettings.device`.

    Raises:
        BackendUnavailable: the settings name a card, and there is none.
        ConfigError: there is no backend of the name asked for.
    """
    few = Primitives(model.density, model.colour, model.rows(torch.arange(min(model.count, _FEW), device=model.device)))
    return run_device(settings, lambda: few.lower_unchecked(camera, conditions), camera)
