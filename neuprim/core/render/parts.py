"""Parts of a set of primitives, each drawn as if it were alone: what a light sees of each of its slabs."""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.errors import NonFiniteError
from neuprim.core.model.fields import Constant, LoweredDensity
from neuprim.core.model.geometry import Geometry
from neuprim.core.model.primitives import Lowered
from neuprim.core.render import render_lowered
from neuprim.core.render.backends import choose
from neuprim.core.render.refusals import refuse_non_finite
from neuprim.core.settings import RenderSettings

__all__ = ["render_parts"]


def render_parts(
    geometry: Geometry, density: LoweredDensity, parts: Tensor, count: int, camera: Camera, settings: RenderSettings
) -> tuple[Tensor, Tensor]:
    """(P, H, W) opacities and mean depths of the parts, in their order; those without any primitive may be left out. No
    gradients.

    In one frame where the backend can, else in one for each part: the images are the same, bit for bit.

    Args:
        parts: (N,) of each primitive, 0 to ``count`` - 1, on the primitives' device.
        settings: with ``depth``.

    Raises:
        NonFiniteError: naming the primitive by its number among all of them.
    """
    with torch.no_grad():
        black = Constant(torch.zeros(geometry.count, 1, device=geometry.means.device))
        whole = Lowered(geometry, density, black)
        whole.check(camera.viewmat, None)
        backend = choose(whole, settings, camera)
        plain = settings.sort == "center" and settings.samples == 1 and backend.place(settings) == whole.kind
        together = backend.parts() if plain else None
        if together is not None:
            return together(whole, parts, count, camera, settings)
        order = torch.argsort(parts, stable=True)
        geometry, density, images = geometry[order], density.rows(order), []
        ends = torch.bincount(parts, minlength=count).cumsum(0).tolist()
        for first, end in zip([0, *ends], ends, strict=False):
            if first == end:
                continue
            own = slice(first, end)
            try:
                output = render_lowered(
                    Lowered(geometry[own], density.rows(own), Constant(black.rgb[own])), camera, settings
                )
            except NonFiniteError:
                refuse_non_finite(whole)
                raise
            assert output.depth is not None
            images.append((output.alpha, output.depth))
        opacities, depths = (torch.stack(found) for found in zip(*images, strict=True))
        return opacities, depths
