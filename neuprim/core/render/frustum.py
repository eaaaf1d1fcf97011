"""Which ellipsoids a camera can see, before anything is drawn: a bound that leaves none out that a pixel's ray
meets."""

from __future__ import annotations

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.projections import AnyCamera
from neuprim.core.model.geometry import Geometry

__all__ = ["in_sight"]

_AT_ONCE = 65_536
"""Ellipsoids that are looked at together, which bounds the memory that it takes."""

_ROUNDING = 1e-9


def in_sight(geometry: Geometry, camera: AnyCamera, near: float) -> Tensor | None:
    """(M,) int64 ascending rows of the ellipsoids that reach into a camera's view; None for all of them.

    A pinhole's view is bounded by the four planes through the edges of its image and by the near plane. An ellipsoid is
    left out where it lies wholly behind one of them: its farthest point along a plane's normal n is n . mu + |S R^T n|.
    Those with numbers that are not finite stay in, for the renderer to name. Other cameras may look anywhere.

    Args:
        near: depth below which nothing is drawn, scene units.
    """
    if not isinstance(camera, Camera):
        return None
    normals = torch.tensor(
        [
            [camera.fx, 0.0, camera.cx],
            [-camera.fx, 0.0, camera.width - camera.cx],
            [0.0, camera.fy, camera.cy],
            [0.0, -camera.fy, camera.height - camera.cy],
            [0.0, 0.0, 1.0],
        ],
        dtype=torch.float64,
    )
    view = camera.viewmat.detach().double().cpu()
    offsets = normals @ view[:3, 3]
    offsets[4] -= near
    where = geometry.means.device
    directions, offsets = (normals @ view[:3, :3]).T.contiguous().to(where), offsets.to(where)
    lengths = directions.norm(dim=0)
    found = []
    for start in range(0, geometry.count, _AT_ONCE):
        part = geometry[start : start + _AT_ONCE]
        middle = part.means.detach().double() @ directions + offsets
        ball = part.log_scales.detach().amax(dim=1).double().exp()[:, None] * lengths
        # most are decided by a ball around them; of the others the ellipsoid itself is looked at
        inside, outside = (middle >= 0).all(dim=1), _beyond(middle, ball) & part.quats.detach().sum(dim=1).isfinite()
        open_ = (~inside & ~outside).nonzero()[:, 0]
        rest = Geometry(*(x[open_].detach().double() for x in (part.means, part.log_scales, part.quats)))
        reach = ((rest.rotations.transpose(1, 2) @ directions) * rest.scales[:, :, None]).norm(dim=1)
        outside[open_] = _beyond(middle[open_], reach)
        found.append((~outside).nonzero()[:, 0] + start)
    return torch.cat(found) if found else torch.zeros(0, dtype=torch.int64, device=where)


def _beyond(middle: Tensor, reach: Tensor) -> Tensor:
    """(N,) whether (N, planes) distances of centres and reaches along normals leave something wholly behind one of the
    planes; never where one is NaN."""
    return (middle + reach < -_ROUNDING * (middle.abs() + reach)).any(dim=1)
