"""Export format ``html``: one web page that draws the model with WebGL2; lossy unless ``level`` is 0.

The page works in any browser with WebGL2 and needs no network and no server. The page draws every primitive over its
exact silhouette and integrates the density along rays in closed form, in float32. Primitives are composited front to
back in the order of their centres. The image is the one that neuprim renders with ``renderer.sort=center``,
``renderer.transmittance_min=0`` and one ray per pixel. ``level`` 1 to 5 compresses the model as ``neuprim compress``
does; 0 preserves every bit.

The reported error is a PSNR: images of the compressed model against images of the run's model. The run's backend draws
both, on the page's views. The page can offer held-out views only if the scene's data can be read.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.conditions import source_frames
from neuprim.core.errors import ConfigError, NeuprimError
from neuprim.core.extensions import Exporter, ExportJob, ExportReport, TrainedModel
from neuprim.core.io.files import write_text
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import render
from neuprim.core.task import API_VERSION
from neuprim.export.shared import choose_export_views, find_export_rgb_channels
from neuprim.webpage.model_page import (
    DrawView,
    PageScene,
    PageView,
    fullest_webpage_conditions,
    held_out_webpage_views,
    initial_webpage_conditions,
    scene_page,
    stored_up_axis,
    webpage_subtitle,
)

OPTIONS = {
    "level": (
        1,
        "digits of the model's numbers: 0 for all, or a level of `neuprim compress`, 1 (nearly all) to 5 (very few)",
    ),
    "fps": (None, "frames per second at which the page plays a sequence (default: six seconds for all frames)"),
    "views": (6, "held-out cameras to jump to, with their true images, 0 to 100"),
}
_MEASURED_VIEWS = 4


def _write_html_export(job: ExportJob) -> ExportReport:
    run = job.run
    if run.channels.own is not None:
        raise ConfigError(
            f"{run.directory}: pictures show {run.channels.display_text}; an HTML page needs red, green and blue"
        )
    find_export_rgb_channels(run)
    level, limit = job.count("level", 0, 5) or 0, job.count("views", 0, 100) or 0
    views, notes = _load_html_export_views(job, limit)
    frames, fps = source_frames(run.header), job.number("fps", 0.1, 240.0)
    if fps is not None and frames is None:
        raise ConfigError("fps: the model has no numbered frames; expected a model of .vdb files. Omit fps.")
    given = job.frames()[0] if job.conditions else {}
    conditions = initial_webpage_conditions(run.task.conditions, views, given, frames, fps)
    scene = PageScene(
        webpage_subtitle(run.task.name, str(run.header.get("data_source", "real"))),
        run.header["background"],
        up=stored_up_axis(run.header),
        conditions=conditions,
        views=views,
        world=run.world,
    )
    job.progress("packing", 0.4)
    name = run.directory.resolve().name
    page = scene_page(name, run.model, run.channels, run.settings, _make_html_export_draw(run), scene, level)
    job.progress("measuring", 0.7)
    shown = fullest_webpage_conditions(run.model, conditions)
    errors = {} if level == 0 else {"psnr": _measure_html_export_psnr(job, page.model, views, shown)}
    write_text(job.out, page.text)
    notes.append(f"{len(page.text.encode()) / 1e6:.2f} MB")
    if run.settings.sort != "center" or run.settings.samples > 1:
        drawn = f"the run draws with sort={run.settings.sort} samples={run.settings.samples}"
        notes.append(f"{drawn}; the page by centres, one ray a pixel")
    return ExportReport((job.out,), False, errors, tuple(notes))


def _load_html_export_views(job: ExportJob, limit: int) -> tuple[list[PageView], list[str]]:
    """Load at most ``limit`` held-out views for the page. Return the views, and the reason if they cannot be read."""
    if limit == 0:
        return [], []
    job.progress("reading the scene", 0.0)
    try:
        return held_out_webpage_views(job.run.dataset(), job.run.channels, limit), []
    except NeuprimError as error:
        return [], [f"no held-out cameras: {error}"]


def _make_html_export_draw(run: TrainedModel) -> DrawView:
    background, settings = torch.tensor(run.header["background"]), replace(run.settings, samples=1)

    @torch.no_grad()
    def draw(model: Primitives, camera: Camera, conditions: Mapping[str, Tensor]) -> Tensor:
        return render(model, camera, conditions, settings, background).rgb

    return draw


def _measure_html_export_psnr(
    job: ExportJob, stored: Primitives, views: Sequence[PageView], conditions: Mapping[str, Tensor]
) -> float:
    """Return the PSNR, dB, of images of the ``stored`` (compressed) model against images of the run's model.

    The images show the first of ``views`` or, if there are none, an orbit under ``conditions``.
    """
    model = job.run.model
    if not views and not model.active(conditions).geometry.count:
        return math.inf  # both images are the background
    draw, shown = _make_html_export_draw(job.run), [(view.camera, view.conditions) for view in views[:_MEASURED_VIEWS]]
    shown = shown or [(view.camera, conditions) for view in choose_export_views(job, "orbit", conditions)[0]]
    errors = [(draw(model, *view) - draw(stored, *view)).double().square().mean() for view in shown]
    mean = float(torch.stack(errors).mean())
    return -10.0 * math.log10(mean) if mean else math.inf


EXPORTER = Exporter(
    API_VERSION,
    "html",
    "one web page that draws the model: turn it, play it, move the light; opens from disk",
    _write_html_export,
    options=OPTIONS,
    conditions=True,
    default="model.html",
    suffixes=(".html",),
)
