"""Cases for the equivalence harness: one for each thing a kernel may do wrong, and arrangements of spheres."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.render import RenderSettings
from tests import scenes

DEFAULT = RenderSettings(depth=True)


@dataclass(frozen=True, eq=False)
class Case:
    """One frame: tensors of a model, a camera, settings (with the order), and the density's edge; equal if the same."""

    tensors: dict[str, Tensor]
    camera: Camera
    settings: RenderSettings
    edge: int = 0


Knobs = Mapping[str, Any]

CONSTANT: dict[str, tuple[Knobs, Knobs, Knobs]] = {
    "K=0 C=1": ({"neurons": 0, "channels": 1}, {}, {}),
    "K=1 C=3": ({"neurons": 1}, {}, {}),
    "K=3 C=5": ({"neurons": 3, "channels": 5}, {}, {}),
    "K=8 C=3": ({"neurons": 8}, {}, {}),
    "K=16 C=1": ({"neurons": 16, "channels": 1}, {}, {}),
    "off-centre": ({}, {"shift": (19.3, -11.7)}, {}),
    "principal point outside": ({}, {"shift": (-30.0, 4.0)}, {}),
    "inside": ({"count": 90}, {"distance": 0.15, "fov": 70.0}, {}),
    "near plane": ({}, {}, {"near": 2.9}),
    "wide": ({}, {"distance": 1.2, "fov": 120.0}, {}),
    "high frequencies": ({"frequency": 3.0}, {}, {}),
    "odd size": ({}, {"width": 41, "height": 23}, {}),
    "one row": ({}, {"width": 50, "height": 1}, {}),
    "one pixel": ({"count": 30}, {"width": 1, "height": 1, "fov": 5.0}, {}),
    "one primitive": ({"count": 1}, {}, {}),
    "many small": ({"count": 700, "radius": 0.04}, {}, {}),
    "opaque": ({"count": 250, "radius": 0.35}, {}, {}),
    "no depth": ({}, {}, {"depth": False}),
    "low ceiling": ({}, {}, {"alpha_max": 0.2}),
    "cuts off": ({}, {}, {"alpha_min": 0.0, "transmittance_min": 0.0}),
}
"""Arguments of ``scenes.tensors``, of ``scenes.camera`` and of the settings, for constant colours."""

NETWORK: dict[str, tuple[Knobs, Knobs, Knobs]] = {
    "depth": ({}, {}, {"depth": True}),
    "depth C=5": ({"channels": 5}, {}, {"depth": True}),
    "off-centre": ({}, {"shift": (19.3, -11.7)}, {}),
    "principal point outside": ({}, {"shift": (-30.0, 4.0)}, {}),
    "inside": ({"count": 90}, {"distance": 0.15, "fov": 70.0}, {"depth": True}),
    "near plane": ({}, {}, {"near": 2.9}),
    "wide": ({}, {"distance": 1.2, "fov": 120.0}, {}),
    "one pixel": ({"count": 30}, {"width": 1, "height": 1, "fov": 5.0}, {}),
    "many small": ({"count": 700, "radius": 0.04}, {}, {}),
    "opaque": ({"count": 250, "radius": 0.35}, {}, {}),
    "cuts off": ({}, {}, {"alpha_min": 0.0, "transmittance_min": 0.0}),
    "low ceiling": ({}, {}, {"alpha_max": 0.2}),
    "no units": ({"hidden": 0}, {}, {}),
    "two rays a side": ({}, {"width": 24, "height": 17}, {"samples": 2}),
    "30 rad over a chord": ({"colour_frequency": 15.0}, {}, {}),
    "100 rad over a chord": ({"colour_frequency": 50.0}, {}, {}),
    "1000 rad over a chord": ({"colour_frequency": 500.0}, {}, {}),
    "1000 rad, inside": ({"colour_frequency": 500.0, "count": 90}, {"distance": 0.15, "fov": 70.0}, {}),
    "far 1e3": ({"radius": 0.01, "spread": 0.05}, {"distance": 10.0, "fov": 0.6}, {}),
    "far 1e5": ({"radius": 0.01, "spread": 0.05}, {"distance": 1000.0, "fov": 0.006}, {}),
    "far 1e5, 100 rad": (
        {"radius": 0.01, "spread": 0.05, "colour_frequency": 50.0},
        {"distance": 1000.0, "fov": 0.006},
        {},
    ),
    "needles": ({"axes": (1.0, 0.02, 0.03), "radius": 0.5}, {}, {}),
    "discs": ({"axes": (1.0, 0.9, 0.01)}, {}, {}),
    "needles, inside": (
        {"axes": (1.0, 0.02, 0.03), "radius": 0.5},
        {"distance": 0.5, "fov": 60.0},
        {"depth_floor": 1e-3},
    ),
    "thin discs, far": (
        {"seed": 10, "axes": (1.0, 0.8, 1e-3), "radius": 0.01, "spread": 0.05, "denser": 50.0},
        {"distance": 100.0, "fov": 0.06},
        {},
    ),
}
"""The same for colour networks. ``spread``, ``axes`` and ``denser`` change the model, see :func:`make_case`."""


@cache
def make_case(name: str, edge: int = 0, sort: str = "center") -> Case:
    """Build a case by name, e.g. ``"inside"`` or ``"network: inside"``; once, so that backends share its reference."""
    kind, _, rest = name.partition(": ")
    if kind == "network":
        model, view, knobs = NETWORK[rest]
        model = {"seed": 7, "hidden": 8, **model}
        size, settings = {"width": 36, "height": 25}, RenderSettings()
    else:
        model, view, knobs = CONSTANT[name]
        model = {"seed": 7, **model}
        size, settings = {"width": 38, "height": 28}, DEFAULT
    spread, axes, denser = model.pop("spread", 1.0), model.pop("axes", None), model.pop("denser", 1.0)
    t = scenes.tensors(**model)
    t["means"] *= 0.1 if name == "one primitive" else spread
    t["b2"] = t["b2"] * denser + (0.2 if name == "opaque" else 0.0)
    if name == "K=16 C=1":
        t["w2"] *= 0.5  # optical depths like the other cases': denser chords graze where float32 has few digits left
    if edge and kind != "network":
        t["w2"], t["b2"] = t["w2"] * 1.5, t["b2"] * 1.5  # about as opaque as with a hard edge
    if axes:
        t["log_scales"] = t["log_scales"].amax(1, keepdim=True) + torch.tensor(axes).log()
    return Case(t, scenes.camera(**{**size, **view}), replace(settings, sort=sort, **knobs), edge)


def case(name: str) -> tuple[dict[str, Tensor], Camera, RenderSettings]:
    """Tensors, camera and settings of a case with a hard edge, in the order of centres."""
    made = make_case(name)
    return made.tensors, made.camera, made.settings


# ---------------------------------------------------------------- spheres


def spheres(means: list[list[float]], radii: list[float], density: list[float]) -> dict[str, Tensor]:
    """Homogeneous spheres of the colours red, green, blue; ``density`` times the diameter is a central chord's optical
    depth."""
    count = len(radii)
    t = scenes.tensors(count, dtype=torch.float64)
    t["w2"] *= 0
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
