"""How much of a point light arrives: depth images out of the light, by the renderer that draws everything else (layered
shadow maps).

The primitives are sorted into slabs across the light's direction, and each slab is drawn on its own, as opacity A_k and
mean depth d_k.
What absorbs on the way to a point x at depth z is what lies in front of it, so the light's transmittance is

    V(x) = prod_k (1 - A_k s((z - d_k - bias)/softness)),      s a smooth step from 0 at -1 to 1 at 1,

exactly 1 for what nothing lies in front of, and 1 - A behind something of opacity A, however translucent. One slab is a
common shadow map with opacity, which knows only one mean depth per pixel: half way between a translucent thing and the
floor below it. Depths are read as inverse depth, weighted by opacity, bilinearly: that is exact on planes, so that a
lit floor does not shadow itself at grazing light.
V carries no gradient: a shadow moves only as what casts it moves.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.compute import device
from neuprim.core.compute.threads import parallel_for
from neuprim.core.model.fields import LoweredDensity, Shade
from neuprim.core.model.geometry import Geometry
from neuprim.core.render import RenderSettings
from neuprim.core.render.slabs import render_slabs

SIZE = 192
"""Pixels of the depth images, square."""

LAYERS = 4
"""Slabs of equal depth: with more of them, depths within one are less of a mean, and a frame takes longer."""

BIAS, SOFTNESS = 1 / 20, 1 / 20
"""In scene diameters, as the light sees the scene: how far behind a depth image light has fallen to a half, and within
what distance before and after that it fades. A compromise: surfaces made of ellipsoids are bumpy, and with a smaller
bias the bumps shadow each other; with a larger one shadows begin further from what casts them. With both equal a point
on a depth image itself keeps all of its light."""

_FAR = 1e3  # scene radii
_CHUNK = 1024  # points per unit of work


def light_visibility(
    geometry: Geometry,
    density: LoweredDensity,
    light: Tensor,
    settings: RenderSettings,
    bias: float = BIAS,
    softness: float = SOFTNESS,
) -> Shade:
    """The function (M, 3) scene points -> (M,) visibility 0..1, float32, of a point light (3,).

    ``bias`` and ``softness`` are in scene diameters, see :data:`BIAS`. The light's camera looks at the middle of all
    centres and sees all of them; a light among them looks the way most of them lie, and points behind it count as lit.
    ``settings`` are the frame's own: its backend and threads draw the depth images too.
    """
    with torch.no_grad():
        means = geometry.means.detach().double()
        light = light.detach().double()
        middle = (means.amin(0) + means.amax(0)) / 2
        far, largest = (means - middle).norm(dim=-1).max(), geometry.scales.detach().max()
        *place, far_away, size = torch.cat([middle, far[None], largest.double()[None]]).tolist()  # one wait for a card
        center, light = torch.tensor(place, dtype=torch.float64), light.cpu()
        radius = far_away + size
        distance = float((light - center).norm())
        if distance < 1e-9 * max(radius, 1e-30):
            return lambda points: torch.ones(len(points), device=points.device)
        if distance > _FAR * radius:  # from there all rays are parallel, and a float32 depth image keeps no digits
            light, distance = center + (light - center) * (_FAR * radius / distance), _FAR * radius
        half = math.asin(min(radius / distance, 0.94))
        focal = 0.5 * SIZE / math.tan(half)
        up = torch.tensor(
            [0.0, 0.0, 1.0] if abs(float(light[2] - center[2])) < 0.9 * distance else [0.0, 1.0, 0.0],
            dtype=torch.float64,
        )
        camera = Camera(look_at(light, center, up), focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE)
        near = max(1e-4 * radius, distance - 1.5 * radius)
        own = replace(settings, depth=True, near=near, samples=1)
        depths = means @ device.to_like(camera.viewmat[2, :3], means) + camera.viewmat[2, 3]
        low, high = torch.stack([depths.min(), depths.max()]).tolist()
        edges = torch.linspace(low, high, LAYERS + 1, dtype=torch.float64)
        slabs = torch.bucketize(depths, device.to_like(edges[1:-1], means))
        opacities, distances = render_slabs(geometry, density, slabs, LAYERS, camera, own)
        view, diameter = camera.viewmat[:3].contiguous(), 2.0 * radius

    def visibility(points: Tensor) -> Tensor:
        points, limits = points.detach().double().contiguous(), (bias * diameter, softness * diameter)
        if not device.on_numba(points, opacities):
            return sample_visibility(points, device.to_like(view, points), near, focal, opacities, distances, *limits)
        from neuprim.tasks.relight.visibility_cpu import arriving_light  # numba, loaded when first needed

        found = np.empty(len(points), np.float32)
        arrays = [x.numpy() for x in (points, view, opacities, distances)]
        parallel_for(
            arriving_light, len(found), _CHUNK, settings.threads, *arrays[:2], near, focal, *arrays[2:], *limits, found
        )
        return torch.from_numpy(found)

    return visibility


def sample_visibility(
    points: Tensor,
    view: Tensor,
    near: float,
    focal: float,
    alphas: Tensor,
    depths: Tensor,
    bias: float,
    softness: float,
) -> Tensor:
    """Return the (M,) float32 visibility of ``points`` (M, 3) float64 in torch code, for a GPU; the arguments of
    :func:`~neuprim.tasks.relight.visibility_cpu.arriving_light`, whose twin this is."""
    nearness = torch.where(alphas > 0, alphas.double() / depths.double().clamp_min(near), 0.0)
    images = torch.stack([alphas.double(), nearness], 1)  # (slabs, 2, S, S)
    x, y, z = ((view[a, :3] * points).sum(-1) + view[a, 3] for a in range(3))
    ahead = (z > near) & x.isfinite() & y.isfinite() & z.isfinite()
    scale = 2.0 * focal / alphas.shape[1] / torch.where(ahead, z, 1.0)
    where = torch.where(ahead[:, None], torch.stack([x * scale, y * scale], -1), 0.0).clamp(-3.0, 3.0)
    # outside of the images nothing absorbs
    read = F.grid_sample(images.flatten(0, 1)[None], where[None, None], align_corners=False)[0, :, 0]
    alpha, inverse_depth = read.unflatten(0, (-1, 2)).unbind(1)
    behind = z - alpha / inverse_depth.clamp_min(1e-30)
    s = (0.5 + 0.5 * (behind - bias) / softness).clamp(0.0, 1.0)
    return torch.where(ahead, (1.0 - alpha * s * s * (3.0 - 2.0 * s)).prod(0), 1.0).float()
