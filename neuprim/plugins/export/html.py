"""``html``: the model as one web page that draws it, in any browser with WebGL2; lossy by the level of its numbers.

The page needs no network and no server: it opens from disk. It turns, zooms, plays the sequence, moves the light with its shadows, shows opacity, depth, a
slice of the density and the ellipsoids, and jumps to held-out cameras with their true images beside. Every primitive is drawn over its exact silhouette with
the closed form of its chord, in float32, blended front to back in the order of centres: the image of ``renderer.sort=center`` with one ray a pixel and
``transmittance_min`` at 0, as blending cannot stop.

``level`` is that of ``neuprim compress``, 1 to 5; 0 keeps every bit. The error is the PSNR of what the page holds against the model, on the page's own views,
drawn by the run's backend.

Held-out cameras and their true images need the scene's data; without them the page begins with a camera of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport, TrainedModel
from neuprim.core.io.addresses import picture_address
from neuprim.core.io.files import write_text
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import render
from neuprim.core.task import API_VERSION
from neuprim.plugins.export.appearance import comparison_views, rgb_of
from neuprim.webpage import Condition, PageView, web_page

__all__ = ["EXPORTER"]

OPTIONS = {
    "level": (1, "digits of the model's numbers: 0 for all, or a level of `neuprim compress`, 1 (nearly all) to 5 (very few)"),
    "views": (6, "held-out cameras to jump to, with their true images, 0 to 100"),
}
_WIDEST = 320
"""Pixels of a true image."""
_MEASURED = 4


def _write(job: ExportJob) -> ExportReport:
    run = job.run
    if run.channels.own is not None:
        raise ConfigError(f"{run.directory}: task {run.task.name!r} shows {run.channels.shown}; a page has red, green and blue")
    rgb = rgb_of(run)
    level, most = job.count("level", 0, 5), job.count("views", 0, 100)
    assert level is not None and most is not None
    notes = []
    job.progress("reading the scene", 0.0)
    try:
        views = _held_out(run, most)
    except NeuprimError as error:
        views = []
        notes.append(f"no held-out cameras: {error}")
    start = _start(run, views, job)
    job.progress("packing", 0.4)
    still = _still(run, views, start)
    up = _three(run.header.get("data", {}), "up", (0.0, 0.0, 1.0))
    page = web_page(
        run.directory.resolve().name,
        run.model,
        rgb,
        run.settings,
        level=level,
        subtitle=_subtitle(run),
        background=run.header["background"],
        linear=run.channels.color_space == "linear",
        up=up,
        conditions=[Condition(spec, start[spec.name]) for spec in run.task.conditions],
        views=views,
        still=still,
    )
    job.progress("measuring", 0.7)
    errors = {} if level == 0 else {"psnr": _error(run, page.model, views, start, job)}
    write_text(job.out, page.text)
    notes.append(f"{len(page.text.encode()) / 1e6:.2f} MB, the model's numbers {page.numbers / 1e6:.2f} MB of it before base64")
    if run.settings.sort != "center" or run.settings.samples > 1:
        notes.append(f"the run draws with sort={run.settings.sort} samples={run.settings.samples}; the page by centres, one ray a pixel")
    return ExportReport((job.out,), False, errors, tuple(notes))


def _held_out(run: TrainedModel, most: int) -> list[PageView]:
    if most == 0:
        return []
    dataset = run.dataset()
    count = min(most, len(dataset.test))
    found = []
    for index in (k * len(dataset.test) // count for k in range(count)):
        view, pixels = dataset.test.view(index), dataset.test.pixels(index)
        if not isinstance(view.camera, Camera):
            continue
        image = run.channels.display(pixels.over(dataset.background)).clamp(0.0, 1.0)
        found.append(PageView(view.name, view.camera, view.conditions, picture_address(image, _WIDEST)))
    return found


def _start(run: TrainedModel, views: Sequence[PageView], job: ExportJob) -> Mapping[str, Tensor]:
    """Conditions that the page begins with: the user's, else the first view's, else the middle of their ranges."""
    given = job.frames()[0] if job.conditions else {}
    found: dict[str, Tensor] = {}
    for spec in run.task.conditions:
        low, high = spec.range
        seen = views[0].conditions.get(spec.name) if views else None
        middle = torch.full(spec.shape, 0.5 * (low + high) if math.isfinite(high - low) and high - low < 1e4 else 1.0)
        found[spec.name] = given.get(spec.name, seen if seen is not None else middle).double()
    return found


def _still(run: TrainedModel, views: Sequence[PageView], start: Mapping[str, Tensor]) -> str:
    """A picture for browsers that cannot draw: the first held-out view, as the run draws it."""
    if not views:
        return ""
    image = _drawn(run, run.model, views[0].camera, views[0].conditions or start)
    return picture_address(run.channels.display(image).clamp(0.0, 1.0), 2 * _WIDEST)


def _drawn(run: TrainedModel, model: Primitives, camera: Camera, conditions: Mapping[str, Tensor]) -> Tensor:
    with torch.no_grad():
        background = torch.tensor(run.header["background"])
        return render(model, camera, conditions, replace(run.settings, samples=1), background).rgb


def _error(run: TrainedModel, held: Primitives, views: Sequence[PageView], start: Mapping[str, Tensor], job: ExportJob) -> float:
    """dB over some views of the page, or over an orbit where it has none."""
    shown = [(view.camera, view.conditions) for view in views[:_MEASURED]]
    shown = shown or [(view.camera, start) for view in comparison_views(job, "orbit", start)[0]]
    total, count = 0.0, 0
    for camera, conditions in shown:
        difference = (_drawn(run, run.model, camera, conditions) - _drawn(run, held, camera, conditions)).double()
        total, count = total + float(difference.square().sum()), count + difference.numel()
    return -10.0 * math.log10(total / count) if total else math.inf


def _subtitle(run: TrainedModel) -> str:
    source = str(run.header.get("data_source", ""))
    return f"{run.task.name}{f', {source} data' if source and source != 'real' else ''}"


def _three(data: Any, key: str, usual: tuple[float, float, float]) -> tuple[float, ...]:
    """Three finite numbers, not all 0, of a header that may be damaged."""
    found = data.get(key) if isinstance(data, Mapping) else None
    if isinstance(found, list) and len(found) == 3 and all(isinstance(x, (int, float)) and math.isfinite(x) for x in found) and any(found):
        return tuple(map(float, found))
    return usual


EXPORTER = Exporter(
    API_VERSION,
    "html",
    "one web page that draws the model: turn it, play it, move the light; opens from disk",
    _write,
    options=OPTIONS,
    conditions=True,
    default="model.html",
    suffixes=(".html",),
)
