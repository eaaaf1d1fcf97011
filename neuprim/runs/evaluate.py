"""Evaluate a trained model: write its metrics, pictures, films and report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from neuprim.core.cameras import Camera
from neuprim.core.conditions import source_frames
from neuprim.core.data import Clip, View
from neuprim.core.errors import CheckpointError, FormError
from neuprim.core.io import images
from neuprim.core.io.files import write_json
from neuprim.core.io.images import FrameSpool, write_animation
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.plugins.attribution import call_task_clips, call_task_facts, call_task_orbit
from neuprim.report.pictures import WorstRegions, error_map
from neuprim.report.run_record import median_and_worst
from neuprim.report.run_report import Viewer, write_report
from neuprim.runs.fit import Fitted
from neuprim.runs.measure import mask_rendering, measure_views, render_image, summarize_run_metrics
from neuprim.webpage.model_page import (
    PageScene,
    held_out_webpage_views,
    initial_webpage_conditions,
    scene_page,
    webpage_subtitle,
)

_SHOWN_VIEWS = 8  # held-out views in renders/ and the report, the median and the worst among them
_ORBIT_FRAMES = 36


def evaluate_fitted(fitted: Fitted, directory: Path, command: str = "") -> dict[str, Any]:
    """Write ``metrics.json``, ``renders/`` and the report of a trained model into ``directory``; return the metrics.

    Args:
        fitted: a trained model that is saved in ``directory``.
        command: command line that made the run, shown in the report; "" if no single command made it.
    """
    task, dataset, model, settings = fitted.task, fitted.dataset, fitted.model, fitted.config.renderer
    display = fitted.channels.display
    fitted.unlock_bands()
    count = len(dataset.test)
    spread = count if count <= _SHOWN_VIEWS else _SHOWN_VIEWS - 2
    shown = {round(i * (count - 1) / max(spread - 1, 1)) for i in range(spread)}
    folder = directory / "renders"
    folder.mkdir(exist_ok=True)

    clips = call_task_clips(task, dataset)
    clip_of_view = {i: clip for clip in clips if clip.source is None for i in clip.views}
    spool: FrameSpool | None = None
    regions = WorstRegions(display)

    def add_frame(clip: Clip, index: int, rendered: Tensor, truth: Tensor) -> None:
        nonlocal spool
        spool = spool or FrameSpool(folder)
        spool.add(torch.cat([display(x) for x in (truth, rendered)], dim=1))
        if index == clip.views[-1]:
            spool.write(folder / f"clip_{clip.name}.webp", clip.fps)
            spool = None

    def write_view(index: int, view: View, rendered: Tensor, truth: Tensor) -> None:
        stem = f"test_{index:03d}_" + "".join(c if c.isalnum() or c in "-_" else "_" for c in view.name)
        images.write_png(folder / f"{stem}.png", display(rendered))
        images.write_png(folder / f"{stem}_truth.png", display(truth))
        images.write_png(folder / f"{stem}_error.png", torch.from_numpy(error_map(rendered, truth)))

    def add_view(index: int, view: View, rendered: Tensor, truth: Tensor) -> None:
        regions.add_view(view.name, rendered, truth)
        if index in clip_of_view:
            add_frame(clip_of_view[index], index, rendered, truth)
        if index in shown:
            write_view(index, view, rendered, truth)

    views = measure_views(model, task, dataset, settings, fitted.lpips, add_view)
    for clip in clips:
        if clip.source is not None:  # frames of the other clips are test views, which are written above
            for i in clip.views:
                rendered = render_image(model, clip.source.view(i), settings, dataset.background)
                add_frame(clip, i, rendered, clip.source.pixels(i).over(dataset.background))
    size = (directory / "model.safetensors").stat().st_size
    metrics = summarize_run_metrics(fitted, dataset, model, views, size, fitted.training, fitted.lpips)
    write_json(directory / "metrics.json", metrics)
    for i in set(median_and_worst(metrics["per_view"])) - shown:
        view = dataset.test.view(i)
        rendered = render_image(model, view, settings, dataset.background)
        write_view(i, view, *mask_rendering(rendered, dataset.test.pixels(i), dataset.background))
    orbit = call_task_orbit(task, dataset, _ORBIT_FRAMES)
    frames = [display(render_image(model, view, settings, dataset.background)) for view in orbit]
    write_animation(folder / "orbit.webp", frames, fps=12.0)
    viewer = _make_run_viewer_page(fitted, directory)
    write_report(directory, task.conditions, viewer, regions.write(folder), command)
    return metrics


def _make_run_viewer_page(fitted: Fitted, directory: Path) -> Viewer | None:
    """Return an interactive web page that shows the model; None if a page cannot show this kind of model."""
    task, dataset, channels, model = fitted.task, fitted.dataset, fitted.channels, fitted.model
    settings = fitted.config.renderer
    if channels.own is not None or channels.rgb is None or None in (model.density.script(), model.colour.script()):
        return None

    def render_frame(model: Primitives, camera: Camera, conditions: Conditions) -> Tensor:
        return render_image(model, View("", camera, conditions), settings, dataset.background)

    # without images: the report shows them beside the model
    views = held_out_webpage_views(dataset, channels, _SHOWN_VIEWS, truths=False)
    frames = source_frames({"data": call_task_facts(task, dataset)})
    scene = PageScene(
        webpage_subtitle(task.name, dataset.data_source),
        dataset.background.tolist(),
        up=dataset.up.tolist(),
        conditions=initial_webpage_conditions(task.conditions, views, {}, frames),
        views=views,
    )
    try:
        page = scene_page(directory.resolve().name, model, channels, settings, render_frame, scene)
    except (CheckpointError, FormError):  # numbers that cannot be quantized
        return None
    return Viewer(page.text, page.nonce)
