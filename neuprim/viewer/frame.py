"""One picture of a model: a camera, conditions and a quantity in, bytes for a screen out."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.channels import Channels
from neuprim.core.data import View
from neuprim.core.errors import ConfigError
from neuprim.core.io.images import to_uint8
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import render
from neuprim.inspect.paint import table
from neuprim.runs.render_config import RenderConfig

__all__ = ["ALPHA", "COLOUR", "DEPTH", "Look", "Picture", "draw_look", "quantities"]

COLOUR, ALPHA, DEPTH = "colour", "alpha", "depth"

_RAYS = 2**26
"""Of a picture, which the renderer draws at once in 2 GB."""

_SOLID = 0.05
"""Alpha below which a pixel has no depth worth showing."""


@dataclass(frozen=True, eq=False)
class Look:
    """What somebody wants to see.

    Attributes:
        conditions: every condition of the model's task.
        shows: one of :func:`quantities`.
    """

    camera: Camera
    conditions: Mapping[str, Tensor] = field(default_factory=dict)
    shows: str = COLOUR


@dataclass(frozen=True, eq=False)
class Picture:
    """What was drawn.

    Attributes:
        image: (H, W, 3) uint8 sRGB, at the resolution that it was drawn at.
        caption: what its colours mean, where that needs saying.
        seconds: that drawing took.
    """

    image: np.ndarray
    caption: str
    seconds: float


def quantities(channels: Channels) -> list[str]:
    """What can be shown of a model: its colour as people see it, alpha, depth, and every channel alone where there are
    several."""
    return [COLOUR, ALPHA, DEPTH, *(f"channel {name}" for name in channels.names if channels.count > 1)]


def draw_look(model: Primitives, look: Look, point: RenderConfig, background: Tensor, channels: Channels) -> Picture:
    """Draw a look of a model that the point is applied to already.

    Depth is the mean along each ray, camera-z, in scene units, between its 2nd and 98th percentile on the screen.

    Raises:
        NeuprimError: what the renderer refuses.
    """
    start = time.perf_counter()
    view = point.scale_view(View("", look.camera, look.conditions))
    settings = replace(point.settings, depth=look.shows == DEPTH)
    width, height = view.camera.width, view.camera.height
    if width * height * settings.samples**2 > _RAYS:
        raise ConfigError(
            f"{width} x {height} pixels with renderer.samples={settings.samples} take more than {_RAYS:,} rays; lower either"
        )
    with torch.no_grad():
        output = render(model, view.camera, view.conditions, settings, background)
    caption = ""
    if look.shows == COLOUR:
        image = to_uint8(channels.display(output.rgb.cpu())).numpy()
    elif look.shows == ALPHA:
        image = _grey(output.alpha.cpu())
    elif look.shows == DEPTH:
        assert output.depth is not None
        image, caption = _depth(output.depth.cpu().numpy(), output.alpha.cpu().numpy())
    else:
        index = [f"channel {name}" for name in channels.names].index(look.shows)
        image = _grey(output.rgb[..., index].cpu())
        caption = f"{channels.names[index]}, 0 is black and 1 is white, {channels.color_space}"
    return Picture(image, caption, time.perf_counter() - start)


def _grey(values: Tensor) -> np.ndarray:
    return np.asarray(to_uint8(values[..., None].expand(-1, -1, 3)).numpy())


def _depth(depth: np.ndarray, alpha: np.ndarray) -> tuple[np.ndarray, str]:
    """(H, W, 3) uint8, bright is near, black where nothing is; and the range in words."""
    solid = alpha > _SOLID
    image = np.zeros((*depth.shape, 3), np.uint8)
    if not solid.any():
        return image, "nothing is in sight"
    near, far = (float(x) for x in np.percentile(depth[solid], (2.0, 98.0)))
    part = np.clip((depth[solid] - near) / max(far - near, 1e-12), 0.0, 1.0)
    image[solid] = table("viridis")[np.minimum((256 * (1.0 - part)).astype(np.int64), 255)]
    return image, f"depth {near:.4g} (bright) to {far:.4g} scene units"
