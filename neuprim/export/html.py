"""``html``: the model as one web page that draws it, in any browser with WebGL2; lossy by the level of its numbers.

The page needs no network and no server: it opens from disk. It turns, zooms, plays the sequence, moves the light with
its shadows, shows opacity, depth, a slice of the density and the ellipsoids, and jumps to held-out cameras with their
true images beside. Every primitive is drawn over its exact silhouette with the closed form of its chord, in float32,
blended front to back in the order of centres: the image of ``renderer.sort=center`` with one ray a pixel and
``transmittance_min`` at 0, as blending cannot stop.

``level`` is that of ``neuprim compress``, 1 to 5; 0 keeps every bit. The error is the PSNR of what the page holds
against the model, on the page's own views, drawn by the run's backend.

Held-out cameras and their true images need the scene's data; without them the page begins with a camera of its own.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport, TrainedModel
from neuprim.core.io.files import write_text
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import render
from neuprim.core.task import API_VERSION
from neuprim.export.shared import choose_comparison_views, find_rgb_channels
from neuprim.webpage.page import Condition, PageView, fullest
from neuprim.webpage.scene import Draw, held_out, scene_page, start_of

OPTIONS = {
    "level": (
        1,
        "digits of the model's numbers: 0 for all, or a level of `neuprim compress`, 1 (nearly all) to 5 (very few)",
    ),
    "views": (6, "held-out cameras to jump to, with their true images, 0 to 100"),
}
_MEASURED = 4
"""Views of which the error is measured."""


def _write(job: ExportJob) -> ExportReport:
    run = job.run
    if run.channels.own is not None:
        raise ConfigError(
            f"{run.directory}: pictures show {run.channels.display_text}; a page shows red, green and blue"
        )
    find_rgb_channels(run)
    level, most = job.count("level", 0, 5) or 0, job.count("views", 0, 100) or 0
    views, notes = _views(job, most)
    start = start_of(run.task.conditions, views, job.frames()[0] if job.conditions else {})
    job.progress("packing", 0.4)
    data = run.header.get("data")
    page = scene_page(
        run.directory.resolve().name,
        run.model,
        run.channels,
        run.settings,
        _make_draw(run),
        specs=run.task.conditions,
        start=start,
        views=views,
        background=run.header["background"],
        up=data.get("up", ()) if isinstance(data, Mapping) else (),
        task=run.task.name,
        data_source=str(run.header.get("data_source", "real")),
        level=level,
        world=run.world,
    )
    job.progress("measuring", 0.7)
    moment = fullest(run.model, [Condition(spec, start[spec.name]) for spec in run.task.conditions])
    errors = {} if level == 0 else {"psnr": _measure_psnr(job, page.model, views, moment)}
    write_text(job.out, page.text)
    notes.append(
        f"{len(page.text.encode()) / 1e6:.2f} MB, {page.numbers / 1e6:.2f} MB of them the model's numbers before base64"
    )
    if run.settings.sort != "center" or run.settings.samples > 1:
        notes.append(
            f"the run draws with sort={run.settings.sort} samples={run.settings.samples}; the page by centres, "
            "one ray a pixel"
        )
    return ExportReport((job.out,), False, errors, tuple(notes))


def _views(job: ExportJob, most: int) -> tuple[list[PageView], list[str]]:
    """Return held-out views, or the reason why there are none."""
    if most == 0:
        return [], []
    job.progress("reading the scene", 0.0)
    try:
        return held_out(job.run.dataset(), job.run.channels, most), []
    except NeuprimError as error:
        return [], [f"no held-out cameras: {error}"]


def _make_draw(run: TrainedModel) -> Draw:
    background = torch.tensor(run.header["background"])

    @torch.no_grad()
    def draw(model: Primitives, camera: Camera, conditions: Mapping[str, Tensor]) -> Tensor:
        return render(model, camera, conditions, replace(run.settings, samples=1), background).rgb

    return draw


def _measure_psnr(job: ExportJob, held: Primitives, views: Sequence[PageView], moment: Mapping[str, Tensor]) -> float:
    """Return the PSNR over some views of the page, or over an orbit if it has none, dB."""
    if not views and not job.run.model.active(moment).geometry.count:
        return math.inf  # nothing is active anywhere: both are the background
    draw, shown = _make_draw(job.run), [(view.camera, view.conditions) for view in views[:_MEASURED]]
    shown = shown or [(view.camera, moment) for view in choose_comparison_views(job, "orbit", moment)[0]]
    wrong = [(draw(job.run.model, *view) - draw(held, *view)).double().square().mean() for view in shown]
    mean = float(torch.stack(wrong).mean())
    return -10.0 * math.log10(mean) if mean else math.inf


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
