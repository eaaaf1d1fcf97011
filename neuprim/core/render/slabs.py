"""Slabs of primitives, each drawn as if it were alone: what a light sees of the scene."""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.fields import Constant, LoweredDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import render_lowered
from neuprim.core.render.backends import choose_backend
from neuprim.core.render.non_finite import refuse_non_finite
from neuprim.core.settings import RenderSettings


def render_slabs(
    geometry: Geometry, density: LoweredDensity, slabs: Tensor, count: int, camera: Camera, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """Return (S, H, W) opacities and mean depths of the slabs that have primitives, in their order; no gradients.

    They are drawn in one frame where the backend can, else one by one: the same bits.

    Args:
        slabs: (N,) slab of each primitive, 0 to ``count`` - 1, on the primitives' device.
        settings: with ``depth``.
    """
    with torch.no_grad():
        black = Constant(torch.zeros(geometry.count, 1, device=geometry.means.device))
        lowered = Lowered(geometry, density, black)
        lowered.check(camera.viewmat, None)
        backend = choose_backend(lowered, settings, camera)
        plain = settings.sort == "center" and settings.samples == 1 and backend.drawing_device(settings) == lowered.kind
        draw_together = backend.slabs() if plain else None
        if draw_together is not None:
            return draw_together(lowered, slabs, count, camera, settings)
        order = torch.argsort(slabs, stable=True)
        geometry, density, images = geometry[order], density.rows(order), []
        ends = torch.bincount(slabs, minlength=count).cumsum(0).tolist()
        for first, end in zip([0, *ends], ends, strict=False):
            if first == end:
                continue
            slab = slice(first, end)
            alone = Lowered(geometry[slab], density.rows(slab), Constant(black.rgb[slab]))
            try:
                output = render_lowered(alone, camera, settings)
            except NonFiniteError:
                refuse_non_finite(lowered)
                raise
            assert output.depth is not None
            images.append((output.alpha, output.depth))
        opacities, depths = (torch.stack(found) for found in zip(*images, strict=True))
        return opacities, depths
