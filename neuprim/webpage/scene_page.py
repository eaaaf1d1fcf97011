"""The page of a scene's model: its held-out views with their ground truth, its conditions, a still image."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.channels import Channels
from neuprim.core.data import Dataset
from neuprim.core.errors import ConfigError
from neuprim.core.io.images import encode_webp_data_uri
from neuprim.core.model.fields import ConditionSpec
from neuprim.core.model.primitives import Primitives
from neuprim.core.settings import RenderSettings
from neuprim.webpage.model_page import Condition, PageScene, PageView, WebPage, make_model_webpage

DrawView = Callable[[Primitives, Camera, Mapping[str, Tensor]], Tensor]
"""(model, camera, conditions) -> (H, W, C), over the scene's background."""

_TRUTH_PIXELS, _STILL_PIXELS = 320, 640


def held_out_webpage_views(dataset: Dataset, channels: Channels, limit: int) -> list[PageView]:
    """Return up to ``limit`` held-out views of pinhole cameras, evenly spread; first the one with most contrast."""
    count = min(limit, len(dataset.test))
    views, contrasts = [], []
    for index in (k * len(dataset.test) // count for k in range(count)):
        view = dataset.test.view(index)
        if isinstance(view.camera, Camera):
            image = channels.display(dataset.test.pixels(index).over(dataset.background)).clamp(0.0, 1.0)
            truth = encode_webp_data_uri(image, _TRUTH_PIXELS)
            views.append(PageView(view.name, view.camera, view.conditions, truth))
            contrasts.append(float(image.std()))
    if views:  # the first frame of a sequence may be empty
        views.insert(0, views.pop(contrasts.index(max(contrasts))))
    return views


def initial_webpage_conditions(
    specs: Sequence[ConditionSpec], views: Sequence[PageView], given: Mapping[str, Tensor]
) -> list[Condition]:
    """Return float64 conditions: those given, else of the first view, else the middle of a bounded range, else 1."""
    shown = {**(views[0].conditions if views else {}), **given}
    found = []
    for spec in specs:
        low, high = spec.range
        middle = torch.full(spec.shape, 0.5 * (low + high) if high - low < 1e4 else 1.0)
        found.append(Condition(spec, shown.get(spec.name, middle).double()))
    return found


def webpage_subtitle(task: str, data_source: str) -> str:
    """Name the task, and the kind of data unless they are real."""
    return task if data_source == "real" else f"{task}, {data_source} data"


def scene_page(
    name: str,
    model: Primitives,
    channels: Channels,
    settings: RenderSettings,
    draw: DrawView,
    scene: PageScene,
    level: int = 1,
) -> WebPage:
    """Make the page of a scene; its still, drawn by ``draw``, and its colour space are set here.

    Raises:
        ConfigError: channels that are not red, green and blue, or a field without a script for browsers.
        CheckpointError: numbers that cannot be stored.
    """
    if channels.own is not None or channels.rgb is None:
        raise ConfigError(
            f"a page shows red, green and blue; this model has {channels.display_text or channels.name_list}"
        )
    still = ""
    if scene.views:
        start = {condition.spec.name: condition.value for condition in scene.conditions}
        image = draw(model, scene.views[0].camera, scene.views[0].conditions or start)
        still = encode_webp_data_uri(channels.display(image).clamp(0.0, 1.0), _STILL_PIXELS)
    scene = replace(scene, still=still, linear=channels.color_space == "linear", up=_read_webpage_axis(scene.up))
    return make_model_webpage(name, model, channels.rgb, settings, scene, level)


def _read_webpage_axis(up: Sequence[float]) -> tuple[float, ...]:
    """Return +z for anything but three finite numbers that are not all 0; a damaged header may hold something else."""
    try:
        found = tuple(float(x) for x in up)
    except (TypeError, ValueError):
        return 0.0, 0.0, 1.0
    return found if len(found) == 3 and all(map(math.isfinite, found)) and any(found) else (0.0, 0.0, 1.0)
