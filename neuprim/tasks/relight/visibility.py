"""Visibility of a point light: depth images from the light by the model's own renderer (layered shadow maps).

The primitives are sorted into slabs across the light's direction, and each slab is drawn on its own, as opacity A_k and
mean depth d_k. The light's transmittance at a point x of depth z is

    V(x) = prod_k (1 - A_k s((z - d_k - bias)/softness)),      s a smooth step from 0 at -1 to 1 at 1,

exactly 1 where nothing lies in front, and 1 - A behind something of opacity A. One slab is a common shadow map, which
knows only one mean depth per pixel: half way between a translucent thing and the floor below it. Depths are read as
inverse depth, weighted by opacity, bilinearly: that is exact on planes, so that a lit floor does not shadow itself at
grazing light. V carries no gradient.
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
from neuprim.core.compute.kernels import exact_kernel
from neuprim.core.compute.threads import parallel_for
from neuprim.core.model.fields import LoweredDensity, Shade
from neuprim.core.model.geometry import Geometry
from neuprim.core.render import RenderSettings, render_slabs

SIZE = 192  # pixels of the depth images, square
LAYERS = 4  # of equal depth; more of them separate depths better and take longer

BIAS, SOFTNESS = 1 / 20, 1 / 20
"""In scene diameters, as the light sees the scene: how far behind a depth image light has fallen to a half, and within
what distance before and after that it fades. Surfaces made of ellipsoids are bumpy: a smaller bias lets the bumps
shadow each other, a larger one detaches shadows from their casters. With both equal a point on a depth image itself
keeps all of its light."""

_FAR = 1e3  # scene radii; from there all rays are parallel, and a float32 depth image keeps no digits
_CHUNK = 1024  # points per unit of work


def light_visibility(geometry: Geometry, density: LoweredDensity, light: Tensor, settings: RenderSettings) -> Shade:
    """The function (M, 3) scene points -> (M,) visibility 0..1, float32, of a point light (3,).

    The light's camera looks at the middle of all centres and sees all of them; a light among them looks the way most of
    them lie, and points behind it count as lit. ``settings`` are the frame's own: its backend and threads draw the
    depth images too.
    """
    with torch.no_grad():
        means = geometry.means.detach().double()
        light = light.detach().double()
        middle = (means.amin(0) + means.amax(0)) / 2
        far, largest = (means - middle).norm(dim=-1).max(), geometry.scales.detach().max()
        *place, far_away, size = torch.cat([middle, far[None], largest.double()[None]]).tolist()  # one synchronisation
        center, light = torch.tensor(place, dtype=torch.float64), light.cpu()
        radius = far_away + size
        distance = float((light - center).norm())
        if distance < 1e-9 * max(radius, 1e-30):
            return lambda points: torch.ones(len(points), device=points.device)
        if distance > _FAR * radius:
            light, distance = center + (light - center) * (_FAR * radius / distance), _FAR * radius
        focal = 0.5 * SIZE / math.tan(math.asin(min(radius / distance, 0.94)))
        overhead = abs(float(light[2] - center[2])) >= 0.9 * distance
        up = torch.tensor([0.0, 1.0, 0.0] if overhead else [0.0, 0.0, 1.0], dtype=torch.float64)
        camera = Camera(look_at(light, center, up), focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE)
        near = max(1e-4 * radius, distance - 1.5 * radius)
        depths = means @ device.to_device_like(camera.viewmat[2, :3], means) + camera.viewmat[2, 3]
        low, high = torch.stack([depths.min(), depths.max()]).tolist()
        edges = torch.linspace(low, high, LAYERS + 1, dtype=torch.float64)
        slabs = torch.bucketize(depths, device.to_device_like(edges[1:-1], means))
        own = replace(settings, depth=True, near=near, samples=1)
        opacities, distances = render_slabs(geometry, density, slabs, LAYERS, camera, own)
    view, limits = camera.viewmat[:3].contiguous(), (BIAS * 2.0 * radius, SOFTNESS * 2.0 * radius)

    def visibility(points: Tensor) -> Tensor:
        points = points.detach().double().contiguous()
        if not device.on_numba(points, opacities):
            return sample_visibility(
                points, device.to_device_like(view, points), near, focal, opacities, distances, *limits
            )
        found = np.empty(len(points), np.float32)
        places, images = (points.numpy(), view.numpy(), near, focal), (opacities.numpy(), distances.numpy())
        parallel_for(_visibility_kernel, len(found), _CHUNK, settings.threads, *places, *images, *limits, found)
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
    """(M,) float32 visibility of ``points`` (M, 3) float64 in torch code, for a GPU: the twin of the kernel below."""
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


@exact_kernel
def _visibility_kernel(start, stop, points, view, near, focal, alphas, depths, bias, softness, found):  # type: ignore[no-untyped-def]
    """Visibility of the points start:stop, as :func:`sample_visibility`, into ``found``."""
    size = alphas.shape[1]
    for p in range(start, stop):
        x = view[0, 0] * points[p, 0] + view[0, 1] * points[p, 1] + view[0, 2] * points[p, 2] + view[0, 3]
        y = view[1, 0] * points[p, 0] + view[1, 1] * points[p, 1] + view[1, 2] * points[p, 2] + view[1, 3]
        z = view[2, 0] * points[p, 0] + view[2, 1] * points[p, 1] + view[2, 2] * points[p, 2] + view[2, 3]
        found[p] = 1.0
        if not z > near:  # behind the light's camera
            continue
        # in pixels, 0 the middle of the first
        u, v = focal * x / z + 0.5 * size - 0.5, focal * y / z + 0.5 * size - 0.5
        if not (-1.0 < u < size and -1.0 < v < size):
            continue
        i, j = int(np.floor(v)), int(np.floor(u))
        down, right = v - i, u - j
        arrives = 1.0
        for k in range(alphas.shape[0]):
            alpha, nearness = 0.0, 0.0
            for di in range(2):
                for dj in range(2):
                    if 0 <= i + di < size and 0 <= j + dj < size and alphas[k, i + di, j + dj] > 0.0:
                        own = np.float64(alphas[k, i + di, j + dj])
                        weight = (down if di else 1.0 - down) * (right if dj else 1.0 - right) * own
                        alpha += weight
                        nearness += weight / max(np.float64(depths[k, i + di, j + dj]), near)
            behind = z - alpha / max(nearness, 1e-30)
            s = min(max(0.5 + 0.5 * (behind - bias) / softness, 0.0), 1.0)
            arrives *= 1.0 - alpha * s * s * (3.0 - 2.0 * s)
        found[p] = arrives
