"""Primitives that never show: found, so that they can be counted (population control moves them to where they are
needed)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from neuprim.core.model.edge import NORMS, profile
from neuprim.core.model.fields import Cosine
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Primitives

__all__ = ["invisible_fraction"]

_FAINT = 1.0 / 255.0


def invisible_fraction(model: Primitives, times: Sequence[Tensor]) -> float:
    """Share of primitives whose opacity along none of their axes reaches 1/255 at any of these times.

    The chord along axis j through the centre has half length s_j, so that I = (N_p s_j/m) (b2 + sum_k w2_k cos(omega0
    b1_k)
    B_p(omega0 W1_k . r_j s_j/m)) with r_j the axis' direction (:mod:`neuprim.core.model.edge`).
    """
    brightest = torch.zeros(model.count, dtype=torch.float64)
    density, own = model.density, {k: v.detach() for k, v in model.of(model.density).items()}
    geometry = Geometry(*(model.params[n].detach() for n in ("means", "log_scales", "quats")))
    reach = geometry.scales.double() / geometry.length_scale.double()[:, None]
    axes = geometry.rotations.double() * reach[:, None, :]  # (N, 3, 3), columns r_j s_j/m
    for time in times:
        form = density.lower(own, geometry, {"time": time})
        assert isinstance(form, Cosine)
        rate = form.omega0 * (form.W1.double() @ axes)  # (N, K, 3)
        waves = (form.w2.double() * torch.cos(form.omega0 * form.b1.double()))[:, :, None] * profile(rate, form.edge)
        depth = NORMS[form.edge] * reach * (form.b2.double().reshape(-1, 1) + waves.sum(1))
        brightest = torch.maximum(brightest, 1.0 - torch.exp(-depth.clamp_min(0.0).amax(1)))
    return float((brightest < _FAINT).double().mean())
