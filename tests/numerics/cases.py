"""Models, cameras and settings that several tests draw: one case for each thing a kernel may do wrong, and arrangements
of spheres."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.render import RenderSettings
from tests import scenes

DEFAULT = RenderSettings(depth=True)

CASES: dict[str, tuple[dict[str, Any], dict[str, Any], dict[str, Any]]] = {
    "K=0 C=1": ({"neurons": 0, "channels": 1}, {}, {}),
    "K=1 C=3": ({"neurons": 1}, {}, {}),
    "K=3 C=5": ({"neurons": 3, "channels": 5}, {}, {}),
    "K=8 C=3": ({"neurons": 8}, {}, {}),
    "K=16 C=1": ({"neurons": 16, "channels": 1}, {}, {}),
    "off-centre": ({}, {"shift": (19.3, -11.7)}, {}),
    "principal point outside": ({}, {"shift": (-40.0, 5.0)}, {}),
    "inside": ({"count": 90}, {"distance": 0.15, "fov": 70.0}, {}),
    "near plane": ({}, {}, {"near": 2.9}),
    "wide": ({}, {"distance": 1.2, "fov": 120.0}, {}),
    "high frequencies": ({"frequency": 3.0}, {}, {}),
    "odd size": ({}, {"width": 41, "height": 23}, {}),
    "one row": ({}, {"width": 50, "height": 1}, {}),
    "one pixel": ({"count": 30}, {"width": 1, "height": 1, "fov": 5.0}, {}),
    "one primitive": ({"count": 1}, {}, {}),
    "many small": ({"count": 700, "radius": 0.04, "neurons": 2}, {}, {}),
    "opaque": ({"count": 250, "radius": 0.35, "neurons": 2}, {}, {}),
    "no depth": ({}, {}, {"depth": False}),
    "low ceiling": ({}, {}, {"alpha_max": 0.2}),
    "cuts off": ({}, {}, {"alpha_min": 0.0, "transmittance_min": 0.0}),
}


def case(name: str) -> tuple[dict[str, Tensor], Camera, RenderSettings]:
    model, view, knobs = CASES[name]
    t = scenes.tensors(**{"seed": 7, **model})
    if name == "one primitive":
        t["means"] *= 0.1
    if name == "opaque":
        t["b2"] += 0.2
    if name == "K=16 C=1":
        t["w2"] *= (
            # optical depths like the other cases': denser ones graze with D ~ 1e-6, where float32 has few digits left
            0.5
        )
    return t, scenes.camera(**{"width": 48, "height": 35, **view}), replace(DEFAULT, **knobs)


# ---------------------------------------------------------------- spheres


def spheres(means: list[list[float]], radii: list[float], density: list[float]) -> dict[str, Tensor]:
    """Homogeneous spheres of the colours red, green, blue; ``density`` times the diameter is a central chord's optical
    depth."""
    count = len(radii)
    t = scenes.tensors(count, 0, dtype=torch.float64)
    t["means"] = torch.tensor(means, dtype=torch.float64)
    radius = torch.tensor(radii, dtype=torch.float64)
    t["log_scales"] = radius.log()[:, None].repeat(1, 3)
    t["quats"][:] = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    t["b2"] = (torch.tensor(density, dtype=torch.float64) * radius)[:, None]
    t["colors"] = torch.eye(3, dtype=torch.float64)[:count]
    return t


def along_z(size: int = 21, fov: float = 40.0, turn: float = 0.0, distance: float = 3.0) -> Camera:
    """A camera ``distance`` from the origin on the negative z axis, turned about the y axis by ``turn`` radians."""
    eye = distance * torch.tensor([math.sin(turn), 0.0, -math.cos(turn)], dtype=torch.float64)
    f = 0.5 * size / math.tan(math.radians(fov) / 2)
    return Camera(look_at(eye, torch.zeros(3), torch.tensor([0.0, 1.0, 0.0])), f, f, size / 2, size / 2, size, size)


def needle_and_sphere() -> dict[str, Tensor]:
    """A long red needle that reaches far towards the camera passes in front of a green sphere whose centre is nearer
    than its own."""
    t = spheres([[0.0, 0.0, 0.0], [-0.3, 0.0, -0.05]], [1.0, 0.15], [8.0, 40.0])
    angle = math.radians(20)  # the needle lies in the x-z plane, its near end at x = -sin(angle), z = -cos(angle)
    t["log_scales"][0] = torch.tensor([0.1, 0.1, 1.0]).log()
    t["quats"][:] = torch.tensor([math.cos(angle / 2), 0.0, math.sin(angle / 2), 0.0])
    return t
