"""Random models of every field that pages can show, and pages of them."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera, look_at
from neuprim.core.model.fields import ColourField, DensityField
from neuprim.core.model.geometry import GEOMETRY_SPECS
from neuprim.core.model.primitives import Primitives
from neuprim.core.settings import RenderSettings
from neuprim.tasks.dynamic import TASK as DYNAMIC
from neuprim.tasks.relight import TASK as RELIGHT
from neuprim.webpage import Condition, PageScene, PageView, WebPage, make_model_webpage

__all__ = ["LIGHT", "SETTINGS", "camera_at", "header_of", "page_of", "random_model"]

SETTINGS = RenderSettings(alpha_min=0.0, transmittance_min=0.0)
"""Without cuts: pairs at the edge of one fall on either side, and blending cannot stop early."""

LIGHT = {"light": torch.tensor([1.5, -2.0, 2.5]), "light_intensity": torch.tensor([1.0, 0.8, 1.2])}
_SPECS = {spec.name: spec for task in (DYNAMIC, RELIGHT) for spec in task.conditions}


def random_model(density: DensityField, colour: ColourField, count: int = 60, seed: int = 0) -> Primitives:
    """Overlapping needles, discs and balls of all opacities; fields that vary in whatever they can."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator)

    def uniform(low: float, high: float, *shape: int) -> Tensor:
        return low + (high - low) * torch.rand(shape, generator=generator)

    known = {
        "means": 0.6 * normal(count, 3),
        "log_scales": uniform(-3.5, -0.9, count, 3),
        "quats": normal(count, 4),
        "b2": uniform(-0.1, 2.0, count, 1),
        "log_gain": uniform(-1.0, 2.0, count, 1),
        "window_center": uniform(0.0, 1.0, count, 1),
        "log_window": uniform(math.log(0.2), math.log(0.8), count, 1),
    }
    params = {}
    for spec in (*GEOMETRY_SPECS, *density.parameters(), *colour.parameters()):
        params[spec.name] = known[spec.name] if spec.name in known else 0.3 * normal(count, *spec.shape)
    return Primitives(density, colour, params)


def camera_at(eye: Sequence[float], size: tuple[int, int] = (72, 56), focal: float = 80.0) -> Camera:
    view = look_at(torch.tensor(eye, dtype=torch.float64), torch.zeros(3), torch.tensor([0.0, 0.0, 1.0]))
    return Camera(view, focal, 1.1 * focal, size[0] / 2 + 1.5, size[1] / 2 - 2.25, *size)


def page_of(
    model: Primitives,
    path: Path,
    conditions: Mapping[str, Tensor] | None = None,
    settings: RenderSettings = SETTINGS,
    **more: Any,
) -> WebPage:
    """A page with one view, written to ``path``."""
    frames = more.pop("frames", None)
    given = [Condition(_SPECS[name], value, frames) for name, value in (conditions or {}).items()]
    views = more.pop("views", [PageView("first", camera_at((0.3, -3.0, 1.0)), conditions or {})])
    name, level = more.pop("name", "model"), more.pop("level", 0)
    page = make_model_webpage(name, model, (0, 1, 2), settings, PageScene(conditions=given, views=views, **more), level)
    path.write_text(page.text, encoding="utf-8")
    return page


def header_of(text: str) -> dict[str, Any]:
    """The facts that a page holds beside its numbers."""
    found = re.search(r'<script id="page" type="application/json">(.*?)</script>', text, re.DOTALL)
    assert found
    header: dict[str, Any] = json.loads(found[1])
    return header
