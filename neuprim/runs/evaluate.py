"""Evaluate a trained model: metrics, pictures, films and the report, from the tensors on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

from neuprim.core.cameras import Camera
from neuprim.core.data import Clip, View
from neuprim.core.errors import CheckpointError, FormError
from neuprim.core.io import images
from neuprim.core.io.animation import FrameSpool, write_animation
from neuprim.core.io.files import write_json
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.plugins.returns import call_task_clips, call_task_orbit
from neuprim.report import Viewer, error_map, write_report
from neuprim.report.regions import Regions
from neuprim.runs.fit import Fitted
from neuprim.runs.measure import measure_views, render_image, summarize_metrics
from neuprim.webpage.scene import held_out, scene_page, start_of

_SHOWN_VIEWS = 8  # held-out views in renders/ and the report
_ORBIT_FRAMES = 36


def evaluate_fitted(fitted: Fitted, directory: Path) -> dict[str, Any]:
    """Write ``metrics.json``, ``renders/`` and the report of a model saved in ``directory``; returns the metrics."""
    config, task, dataset, channels, model = fitted.config, fitted.task, fitted.dataset, fitted.channels, fitted.model
    fitted.unlock()
    count = len(dataset.test)
    shown = {round(i * (count - 1) / max(min(count, _SHOWN_VIEWS) - 1, 1)) for i in range(min(count, _SHOWN_VIEWS))}
    folder = directory / "renders"
    folder.mkdir(exist_ok=True)

    clips = call_task_clips(task, dataset)
    spooled = {i: clip for clip in clips if clip.source is None for i in clip.views}
    open_spool: list[FrameSpool] = []
    regions = Regions(channels.display)

    def add_frame(clip: Clip, index: int, rendered: torch.Tensor, truth: torch.Tensor) -> None:
        if not open_spool:
            open_spool.append(FrameSpool(folder))
        open_spool[0].add(torch.cat([channels.display(x) for x in (truth, rendered)], dim=1))
        if index == clip.views[-1]:
            open_spool.pop().write(folder / f"clip_{clip.name}.webp", clip.fps)

    def write_view(index: int, view: View, rendered: torch.Tensor, truth: torch.Tensor) -> None:
        regions.look(view.name, rendered, truth)
        clip = spooled.get(index)
        if clip is not None:
            add_frame(clip, index, rendered, truth)
        if index in shown:
            stem = f"test_{index:03d}_" + "".join(c if c.isalnum() or c in "-_" else "_" for c in view.name)
            images.write_png(folder / f"{stem}.png", channels.display(rendered))
            images.write_png(folder / f"{stem}_truth.png", channels.display(truth))
            images.write_png(folder / f"{stem}_error.png", torch.from_numpy(error_map(rendered, truth)))

    views = measure_views(model, task, dataset, config.renderer, channels, write_view, fitted.lpips)
    regions.write(folder)
    for clip in clips:
        if clip.source is None:
            continue  # its frames are test views, written above
        for i in clip.views:
            truth = clip.source.pixels(i).over(dataset.background)
            add_frame(clip, i, render_image(model, clip.source.view(i), config.renderer, dataset.background), truth)
    size = (directory / "model.safetensors").stat().st_size
    metrics = summarize_metrics(fitted.job, channels, views, size, fitted.training, fitted.lpips)
    write_json(directory / "metrics.json", metrics)
    views_around = call_task_orbit(task, dataset, _ORBIT_FRAMES)
    frames = [channels.display(render_image(model, v, config.renderer, dataset.background)) for v in views_around]
    write_animation(folder / "orbit.webp", frames, fps=12.0)
    write_report(directory, task.conditions, _embedded_viewer(fitted, directory))
    return metrics


def _embedded_viewer(fitted: Fitted, directory: Path) -> Viewer | None:
    """Return the viewer page of the model; None of a model that a page cannot show."""
    config, task, dataset, channels = fitted.config, fitted.task, fitted.dataset, fitted.channels
    if (
        channels.own is not None
        or channels.rgb is None
        or fitted.model.density.script() is None
        or fitted.model.colour.script() is None
    ):
        return None

    def render_frame(model: Primitives, camera: Camera, conditions: Conditions) -> torch.Tensor:
        return render_image(model, View("", camera, conditions), config.renderer, dataset.background)

    views = held_out(dataset, channels, _SHOWN_VIEWS)
    try:
        page = scene_page(
            directory.resolve().name,
            fitted.model,
            channels,
            config.renderer,
            render_frame,
            specs=task.conditions,
            start=start_of(task.conditions, views, {}),
            views=views,
            background=dataset.background.tolist(),
            up=dataset.up.tolist(),
            task=task.name,
            data_source=dataset.data_source,
        )
    except (CheckpointError, FormError):  # numbers that cannot be quantized
        return None
    return Viewer(page.text, page.nonce)
