"""The page of a scene's model: cameras of its held-out views with their true images, its conditions, a still."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.cameras.world import World
from neuprim.core.channels import Channels
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.io.images import webp_data_uri
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.model.primitives import Primitives
from neuprim.core.settings import RenderSettings
from neuprim.webpage.page import Condition, PageView, WebPage, web_page

Draw = Callable[[Primitives, Camera, Mapping[str, Tensor]], Tensor]
"""(model, camera, conditions) -> (H, W, C), over the scene's background."""

_WIDEST, _STILL = 320, 640
"""Pixels of a true image, and of the still."""


def held_out(dataset: Dataset, channels: Channels, most: int) -> list[PageView]:
    """At most so many of the held-out views, evenly spread, those of pinholes; first the one in which most is to be
    seen."""
    count, found, contrasts = min(most, len(dataset.test)), [], []
    for index in (k * len(dataset.test) // count for k in range(count)):
        view = dataset.test.view(index)
        if isinstance(view.camera, Camera):
            image = channels.display(dataset.test.pixels(index).over(dataset.background)).clamp(0.0, 1.0)
            found.append(PageView(view.name, view.camera, view.conditions, webp_data_uri(image, _WIDEST)))
            contrasts.append(float(image.std()))
    if found:  # a sequence may begin with nothing
        found.insert(0, found.pop(contrasts.index(max(contrasts))))
    return found


def start_of(
    specs: Sequence[ConditionSpec], views: Sequence[PageView], given: Mapping[str, Tensor]
) -> dict[str, Tensor]:
    """The conditions that a page begins with: those given, else the first view's, else the middle of their ranges, or 1
    where that says nothing."""
    found: dict[str, Tensor] = {}
    for spec in specs:
        low, high = spec.range
        middle = torch.full(spec.shape, 0.5 * (low + high) if high - low < 1e4 else 1.0)
        seen = views[0].conditions.get(spec.name, middle) if views else middle
        found[spec.name] = given.get(spec.name, seen).double()
    return found


def scene_page(
    name: str,
    model: Primitives,
    channels: Channels,
    settings: RenderSettings,
    draw: Draw,
    *,
    specs: Sequence[ConditionSpec],
    start: Mapping[str, Tensor],
    views: Sequence[PageView],
    background: Sequence[float],
    up: Sequence[float],
    task: str,
    data_source: str,
    level: int = 1,
    world: World | None = None,
) -> WebPage:
    """See :func:`~neuprim.webpage.page.web_page`.

    Args:
        draw: makes the still, of the first view.
        task, data_source: what the page says beside its name; that data are real goes without saying.

    Raises:
        ConfigError: channels that are not red, green and blue, or a field without a script for browsers.
        CheckpointError: numbers that cannot be stored.
    """
    if channels.own is not None or channels.rgb is None:
        raise ConfigError(
            f"a page shows red, green and blue; this model has {channels.display_text or channels.name_list}"
        )
    still = ""
    if views:
        image = draw(model, views[0].camera, views[0].conditions or start)
        still = webp_data_uri(channels.display(image).clamp(0.0, 1.0), _STILL)
    return web_page(
        name,
        model,
        channels.rgb,
        settings,
        level=level,
        subtitle=task if data_source == "real" else f"{task}, {data_source} data",
        background=background,
        linear=channels.color_space == "linear",
        up=_axis(up),
        conditions=[Condition(spec, start[spec.name]) for spec in specs],
        views=views,
        still=still,
        world=world,
    )


def _axis(up: Sequence[float]) -> tuple[float, ...]:
    """Three finite numbers, not all 0: of anything else, which a damaged header may say, +z."""
    try:
        found = tuple(float(x) for x in up)
    except (TypeError, ValueError):
        return 0.0, 0.0, 1.0
    return found if len(found) == 3 and all(map(math.isfinite, found)) and any(found) else (0.0, 0.0, 1.0)
