"""How far a point light reaches: a depth image out of the light, by the renderer that draws everything else (a shadow map).

At a point x,  V(x) = sigmoid((depth(x) - z(x) + bias)/softness):  1 where nothing lies between light and point, 0 deep in a shadow. The
depth image is read as inverse depth, bilinearly: that is exact on planes, so that a lit floor does not shadow itself at grazing light.
V carries no gradient: a shadow moves only as what casts it moves.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.fields import Constant, LoweredDensity, Shade
from neuprim.core.geometry import Geometry
from neuprim.core.primitives import Lowered
from neuprim.core.render import RenderSettings, render_lowered

__all__ = ["BIAS", "SIZE", "SOFTNESS", "light_visibility"]

SIZE = 192
"""Pixels of the depth image, square."""

BIAS, SOFTNESS = 1 / 20, 1 / 50
"""In scene diameters, as the light sees the scene: how far behind the depth image light has fallen to a half, and over what distance it
fades. A compromise: surfaces made of ellipsoids are bumpy, and with a smaller bias the bumps shadow each other; with a larger one shadows
begin further from what casts them. A point on the depth image itself keeps 1/(1 + exp(-BIAS/SOFTNESS)) = 92 % of its light."""

_FAR = 1e3  # scene radii


def light_visibility(geometry: Geometry, density: LoweredDensity, light: Tensor, bias: float = BIAS, softness: float = SOFTNESS) -> Shade:
    """The function (M, 3) scene points -> (M,) visibility 0..1, float32, of a point light (3,).

    ``bias`` and ``softness`` are in scene diameters, see :data:`BIAS`. The light's camera looks at the middle of all centres and sees all of them; a light among them looks the way most of them lie,
    and points behind it count as lit.
    """
    with torch.no_grad():
        means = geometry.means.detach().double()
        light = light.detach().double()
        center = (means.amin(0) + means.amax(0)) / 2
        radius = float((means - center).norm(dim=-1).max()) + float(geometry.scales.detach().max())
        distance = float((light - center).norm())
        if distance < 1e-9 * max(radius, 1e-30):
            return lambda points: torch.ones(len(points))
        if distance > _FAR * radius:  # from there all rays are parallel, and a float32 depth image keeps no digits
            light, distance = center + (light - center) * (_FAR * radius / distance), _FAR * radius
        half = math.asin(min(radius / distance, 0.94))
        focal = 0.5 * SIZE / math.tan(half)
        up = torch.tensor([0.0, 0.0, 1.0] if abs(float(light[2] - center[2])) < 0.9 * distance else [0.0, 1.0, 0.0], dtype=torch.float64)
        camera = Camera(look_at(light, center, up), focal, focal, SIZE / 2, SIZE / 2, SIZE, SIZE)
        near = max(1e-4 * radius, distance - 1.5 * radius, 1e-6)
        flat = Lowered(
            Geometry(geometry.means.detach(), geometry.log_scales.detach(), geometry.quats.detach()),
            density,
            Constant(torch.zeros(geometry.count, 1)),
        )
        output = render_lowered(flat, camera, RenderSettings(depth=True, near=near))
        assert output.depth is not None
        nearness = torch.where(output.alpha > 0.5, 1.0 / output.depth.double().clamp_min(near), 0.0)
        diameter = 2.0 * radius

    def visibility(points: Tensor) -> Tensor:
        with torch.no_grad():
            x, y, z = (points.detach().double() @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).unbind(-1)
            front = z > near
            spread = focal / (0.5 * SIZE) / z.clamp_min(near)
            where = torch.stack([x * spread, y * spread], -1).clamp(-2.0, 2.0)
            found = F.grid_sample(nearness[None, None], where[None, None], align_corners=False)[0, 0, 0]
            behind = z - 1.0 / found.clamp_min(1e-12)
            return torch.where(front, torch.sigmoid((bias * diameter - behind) / (softness * diameter)), 1.0).float()

    return visibility
