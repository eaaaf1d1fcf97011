"""Which primitives the light reaches: a depth image out of the light, by the renderer that draws everything else.

V_i = mean over 3 x 3 pixels around the projected centre of sigmoid((depth - z_i + bias)/softness): 1 where nothing lies between
the light and the primitive, 0 deep in a shadow. It carries no gradient: a shadow moves only as what casts it moves.
"""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.fields import Constant, LoweredDensity
from neuprim.core.geometry import Geometry
from neuprim.core.primitives import Lowered
from neuprim.core.render import RenderSettings, render_lowered

__all__ = ["light_visibility"]

BIAS, SOFTNESS = 0.06, 0.02
"""In units of a quarter of the scene's diameter as the light sees it: how far behind the depth image a lit surface may lie, and over
what distance light fades. The study's numbers, for a scene about four units across."""


def light_visibility(
    geometry: Geometry, density: LoweredDensity, light: Tensor, size: int = 96, bias: float = BIAS, softness: float = SOFTNESS
) -> Tensor:
    """(N,) float32 visibility 0..1 of a point light (3,) from each primitive's centre.

    The light's camera looks at the middle of all centres and sees all of them; a light among them looks the way most of them lie,
    and those behind it count as lit.
    """
    with torch.no_grad():
        means = geometry.means.detach().double()
        light = light.detach().double()
        low, high = means.amin(0), means.amax(0)
        center = (low + high) / 2
        radius = float((means - center).norm(dim=-1).max()) + float(geometry.scales.detach().max())
        distance = float((light - center).norm())
        unit = 0.5 * radius
        if distance < 1e-9 * max(radius, 1e-30):
            return torch.ones(geometry.count)
        half = math.asin(min(radius / distance, 0.94))
        focal = 0.5 * size / math.tan(half)
        up = torch.tensor([0.0, 0.0, 1.0] if abs(float(light[2] - center[2])) < 0.9 * distance else [0.0, 1.0, 0.0], dtype=torch.float64)
        camera = Camera(look_at(light, center, up), focal, focal, size / 2, size / 2, size, size)
        near = max(1e-4 * radius, distance - 1.5 * radius, 1e-6)
        flat = Lowered(
            Geometry(geometry.means.detach(), geometry.log_scales.detach(), geometry.quats.detach()),
            density,
            Constant(torch.zeros(geometry.count, 1)),
        )
        output = render_lowered(flat, camera, RenderSettings(depth=True, near=near))
        assert output.depth is not None
        depth = torch.where(output.alpha > 0.5, output.depth.double(), torch.inf)
        x, y, z = (means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).unbind(-1)
        front = z > near
        u, v = (focal * w / z.clamp_min(1e-12) + size / 2 for w in (x, y))
        column, row = (w.clamp(-1, size).floor().long() + 1 for w in (u, v))
        padded = F.pad(depth, (2, 2, 2, 2), value=math.inf)
        total = torch.zeros_like(z)
        for dy in range(3):
            for dx in range(3):
                seen = padded[row + dy, column + dx]
                total += torch.sigmoid((seen - z + bias * unit) / (softness * unit))
        return torch.where(front, total / 9, 1.0).float()
