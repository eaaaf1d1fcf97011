"""Measure a model: metrics of every held-out view, their means, and further metrics of the task.

PSNR and SSIM compare float images in the data set's own colour space, unclamped and unquantised. For linear RGB images,
PSNR and SSIM are also computed after the sRGB transfer curve (``psnr_srgb``, ``ssim_srgb``). If the task has its own
conversion of channels to a displayed image, they are also computed for the displayed image (``psnr_display``,
``ssim_display``). If the task masks a part of a view, the error inside the mask is also reported alone, because a black
background improves the mean. ``ssim_3dgs`` is the SSIM of the displayed image as 3D Gaussian splatting computes it.
``lpips`` is LPIPS as published; ``lpips_3dgs`` is LPIPS as 3D Gaussian splatting computes it.
"""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from neuprim.config import Job
from neuprim.core.channels import Channels, find_channels
from neuprim.core.compute import device
from neuprim.core.compute.threads import limit_threads
from neuprim.core.data import Clip, Dataset, Pixels, View
from neuprim.core.data.dataset_check import check_dataset_views, check_pixels
from neuprim.core.data.starting_points import GIVE_POINTS
from neuprim.core.errors import warn_once
from neuprim.core.io import images
from neuprim.core.metrics import mean_metrics, metric_to_json, psnr, psnr_gain, ssim, ssim_3dgs
from neuprim.core.metrics.lpips import Lpips
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, choose_backend, render
from neuprim.core.task import TaskSpec
from neuprim.plugins.attribution import call_task_clips, call_task_diagnose, call_task_mask, call_task_metrics
from neuprim.runs.open import StoredRun, load_dataset, load_run, model_file, move_to_render_device
from neuprim.runs.render_config import estimate_run_file_bytes, parse_run_rendering
from neuprim.version import __version__

__all__ = ["ViewMetrics", "evaluate_run", "measure_views", "render_image"]

_VISIBLE_PSNR = 20 * math.log10(255)
"""PSNR of an error of one level of 255 in all pixels, dB; smaller errors are invisible. Only views with a lower PSNR
count as worse than a black image. Without this bound, invisible errors in empty frames would count, because a black
image of an empty frame has no error."""


@dataclass(frozen=True)
class ViewMetrics:
    """Metrics of one view.

    Attributes:
        seconds: render time of the view.
        black: PSNR of an image that shows only the background.
        more: further metrics by name: those of :attr:`~neuprim.core.task.TaskSpec.metrics`; ``psnr_gain`` of opaque
            photographs; ``psnr_mask`` and ``mse_mask`` inside the task's mask; ``psnr_black_image`` and
            ``psnr_black_image_mask`` of an empty image.
        empty: whether the rendered image shows only the background, because the model is not in the view.
    """

    name: str
    psnr: float  # PSNR in the data set's colour space, dB
    ssim: float  # SSIM in the data set's colour space
    seconds: float
    black: float = -math.inf
    more: dict[str, float] = field(default_factory=dict)
    empty: bool = False


def render_image(model: Primitives, view: View, settings: RenderSettings, background: Tensor) -> Tensor:
    """Render one view without gradients; return its (H, W, C) image on the CPU."""
    with torch.no_grad():
        return render(model, view.camera, view.conditions, settings, background).rgb.cpu()


def render_light_sum(
    model: Primitives,
    view: View,
    lights: Sequence[Conditions],
    settings: RenderSettings,
    background: Tensor,
    on_alpha: Callable[[Tensor], None] = lambda alpha: None,
) -> Tensor:
    """Render a view under several lights at once, as the sum of one image per light: (H, W, C) on the CPU.

    The sum is exact for models that are linear in light, because opacity does not depend on light. The sum is
    computed in float64, and the background is added once.

    Args:
        lights: conditions of each light, which replace the view's conditions of the same names.
        on_alpha: called with the alpha of each image.
    """
    total, alpha = torch.zeros(()), torch.zeros(())
    for light in lights:
        with torch.no_grad():
            frame = render(model, view.camera, {**view.conditions, **light}, settings)
        total, alpha = total + frame.rgb.double(), frame.alpha
        on_alpha(alpha)
    return (total + (1.0 - alpha.double())[..., None] * background.double().to(alpha.device)).to(frame.rgb).cpu()


def measure_views(
    model: Primitives,
    task: TaskSpec,
    dataset: Dataset,
    settings: RenderSettings,
    lpips: Lpips | None = None,
    on_view: Callable[[int, View, Tensor, Tensor], None] | None = None,
    render_view: Callable[[Primitives, View, Tensor], Tensor] | None = None,
) -> list[ViewMetrics]:
    """Return the metrics of every view of the test split. Images are composited over the data set's background.

    Args:
        lpips: LPIPS network; None if LPIPS is not measured.
        on_view: function that is called with (index, view, rendered, truth), for example to write pictures.
        render_view: function (model, view, background) -> image, instead of :func:`render_image`.
    """
    draw = render_view or (lambda model, view, background: render_image(model, view, settings, background))
    result = []
    with limit_threads(settings.threads):
        for i in range(len(dataset.test)):
            start = time.perf_counter()
            rendered = draw(model, dataset.test.view(i), dataset.background)
            metrics, rendered, truth = _measure_view(rendered, time.perf_counter() - start, task, dataset, i, lpips)
            result.append(metrics)
            if on_view is not None:
                on_view(i, dataset.test.view(i), rendered, truth)
    if all(view.empty for view in result):
        warn_once(
            f"{dataset.name}: the model is invisible in all {len(result)} test views, which show only the background; "
            f"expected starting points in view of the cameras: {GIVE_POINTS}"
        )
    return result


def mask_rendering(rendered: Tensor, pixels: Pixels, background: Tensor) -> tuple[Tensor, Tensor]:
    """Return a rendering and its ground truth over ``background``. Outside the view's pixel mask the rendering is
    replaced by the ground truth.
    """
    truth = pixels.over(background)
    return rendered if pixels.mask is None else torch.where(pixels.mask[..., None], rendered, truth), truth


def _measure_view(
    rendered: Tensor, seconds: float, task: TaskSpec, dataset: Dataset, index: int, lpips: Lpips | None
) -> tuple[ViewMetrics, Tensor, Tensor]:
    """Return the metrics of test view ``index``, and its rendering and ground truth from :func:`mask_rendering`.

    ``seconds`` is the time in which ``rendered`` was rendered.
    """
    view, pixels, background = dataset.test.view(index), dataset.test.pixels(index), dataset.background
    channels = find_channels(task, dataset)
    check_pixels("test", view, pixels, dataset.channels)
    empty = bool((rendered == background).all())
    rendered, truth = mask_rendering(rendered, pixels, background)
    mask = call_task_mask(task, dataset, index)
    more = _run_display_metrics(rendered, truth, dataset, channels, pixels.mask)
    more |= _mask_metrics(rendered, truth, dataset, mask) | _table_metrics(rendered, truth, channels, lpips)
    if pixels.alpha is None:
        more["psnr_gain"] = psnr_gain(rendered, truth, pixels.mask)
    more |= call_task_metrics(task, dataset, index, rendered, truth)
    black = psnr(background.to(truth).expand_as(truth), truth, pixels.mask)
    score = psnr(rendered, truth, pixels.mask)
    return ViewMetrics(view.name, score, ssim(rendered, truth), seconds, black, more, empty), rendered, truth


def measure_quality(
    model: Primitives, task: TaskSpec, dataset: Dataset, settings: RenderSettings
) -> tuple[float, float]:
    """Return mean PSNR and SSIM of the held-out views, as in ``metrics.json``, on the device of the backend."""
    views = measure_views(move_to_render_device(model, settings, dataset.test.view(0)), task, dataset, settings)
    return float(np.mean([v.psnr for v in views])), float(np.mean([v.ssim for v in views]))


def _run_display_metrics(
    rendered: Tensor, truth: Tensor, dataset: Dataset, channels: Channels, valid: Tensor | None
) -> dict[str, float]:
    if channels.own is not None:
        kind, a, b = "display", channels.display(rendered), channels.display(truth)
    elif dataset.color_space == "linear" and channels.is_rgb:
        kind, a, b = "srgb", *(images.linear_to_srgb(x.clamp_min(0.0)) for x in (rendered, truth))
    else:
        return {}
    return {f"psnr_{kind}": psnr(a, b, valid), f"ssim_{kind}": ssim(a, b)}


def _mask_metrics(rendered: Tensor, truth: Tensor, dataset: Dataset, mask: Tensor | None) -> dict[str, float]:
    if mask is None or not bool(mask.any()):
        return {}
    black = dataset.background.to(truth).expand_as(truth)
    return {
        "psnr_mask": psnr(rendered, truth, mask),
        "mse_mask": float((rendered - truth)[mask].double().square().mean()),
        "psnr_black_image": psnr(black, truth),
        "psnr_black_image_mask": psnr(black, truth, mask),
    }


def _table_metrics(rendered: Tensor, truth: Tensor, channels: Channels, lpips: Lpips | None) -> dict[str, float]:
    """Return SSIM and, with a network, LPIPS of the displayed image, computed as in published tables of results."""
    a, b = (channels.display(x).clamp(0.0, 1.0) for x in (rendered, truth))
    found = {"ssim_3dgs": ssim_3dgs(a, b)}
    if lpips is not None and min(a.shape[:2]) >= lpips.least:
        found |= {"lpips": lpips(a, b), "lpips_3dgs": lpips.unmapped(a, b)}
    return found


def evaluate_run(
    run: Path | StoredRun, lpips: str | Path | None = None, overrides: Sequence[str] = ()
) -> dict[str, Any]:
    """Measure a finished run again from its files; return the content of ``metrics.json``.

    Args:
        lpips: file or folder with weights for LPIPS; None for the run's own.
        overrides: render settings, see :class:`~neuprim.runs.render_config.RenderConfig`. If they reduce the model,
            ``model_bytes`` is the size of the reduced model.
    """
    run = load_run(run)
    config = parse_run_rendering(overrides, run.config.renderer, run.model)
    run = replace(run, config=replace(run.config, renderer=config.settings))
    weights = lpips or run.config.metrics.lpips
    distance = None if weights is None else Lpips.load(weights)
    with run.plugins.attribute_errors():
        dataset = load_dataset(run)
        check_dataset_views(dataset, run.task.conditions)
        training = {name: run.header.get(name) for name in ("iterations", "train_seconds")}
        model = config.prepare_model(run.model)
        size = estimate_run_file_bytes(model_file(run.directory), run.model, model)
        model = move_to_render_device(model, config.settings, dataset.test.view(0))
        views = measure_views(model, run.task, dataset, config.settings, distance, render_view=config.render_view)
        return summarize_run_metrics(run, dataset, model, views, size, training, distance)


def summarize_run_metrics(
    job: Job,
    dataset: Dataset,
    model: Primitives,
    views: Sequence[ViewMetrics],
    model_bytes: int,
    training: Mapping[str, Any],
    lpips: Lpips | None = None,
    split: str = "test",
) -> dict[str, Any]:
    """Return the content of ``metrics.json`` from the metrics of all views.

    Args:
        training: entries ``iterations`` and ``train_seconds``, as the run recorded them.
        split: name of the measured views; means per frame of the task's clips (films) are only computed for "test".
    """
    config, task, channels = job.config, job.task, find_channels(job.task, dataset)
    worst, first = min(views, key=lambda v: v.psnr), dataset.test.view(0)
    backend = choose_backend(model.lower(first.camera, first.conditions, config.renderer), config.renderer)
    seconds = sorted(v.seconds for v in views)
    return {
        "task": config.task,
        "scene": config.scene_name,
        "dataset": dataset.name,
        "preset": config.preset,
        "split": split,
        **metric_to_json("psnr", float(np.mean([v.psnr for v in views]))),
        "ssim": float(np.mean([v.ssim for v in views])),
        **mean_metrics([v.more for v in views]),
        **_run_lpips_entries(views, lpips),
        **metric_to_json("psnr_worst", worst.psnr),
        "view_worst": worst.name,
        "worse_than_black_image": [v.name for v in views if v.psnr < min(v.black, _VISIBLE_PSNR)],
        "per_view": [_run_view_metrics_entry(v) for v in views],
        **({"views_empty": sum(v.empty for v in views)} if any(v.empty for v in views) else {}),
        **_run_frame_means(call_task_clips(task, dataset) if split == "test" else (), views),
        "primitives": model.count,
        "parameters": model.count * model.parameters_per_primitive,
        "parameters_per_primitive": model.parameters_per_primitive,
        "model_bytes": model_bytes,
        **training,
        "render_fps": 1.0 / max(seconds[len(seconds) // 2], 1e-9),
        "backend": backend.name,
        "device": backend.computing_on(config.renderer),
        "checkpoint": "last",
        "downsampling": dataset.downsampling,
        "image_size": [first.camera.width, first.camera.height],
        "background": [round(float(x), 6) for x in dataset.background],
        "color_space": dataset.color_space,
        "channels": list(channels.names),
        **({"shown": channels.display_text} if channels.display_text else {}),
        "data_source": dataset.data_source,
        "train_views": len(dataset.train),
        "seed": config.seed,
        **call_task_diagnose(task, dataset, model.to(device.HOST)),
        "non_default": {key: list(pair) for key, pair in config.non_default.items()},
        "versions": {
            "neuprim": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "numpy": np.__version__,
        },
        "made_by": config.made_by.origins(),
    }


def _run_view_metrics_entry(view: ViewMetrics) -> dict[str, Any]:
    entry = {"name": view.name, **metric_to_json("psnr", view.psnr), "ssim": view.ssim, "seconds": view.seconds}
    for name, value in view.more.items():
        entry |= metric_to_json(name, value)
    return entry


def _run_lpips_entries(views: Sequence[ViewMetrics], lpips: Lpips | None) -> dict[str, Any]:
    """Return entries of ``metrics.json`` that name the LPIPS network, or say why LPIPS was not measured."""
    if lpips is None:
        why = "no weights were given (metrics.lpips=FILE, or neuprim eval --lpips FILE)"
        return {"lpips": None, "not_measured": {"lpips": why}}
    if any("lpips" not in v.more for v in views):
        why = f"some view is lower or narrower than {lpips.least} pixels"
        return {"lpips": None, "lpips_3dgs": None, "not_measured": {"lpips": why}}
    return {"lpips_network": lpips.network}


def _run_frame_means(clips: Sequence[Clip], views: Sequence[ViewMetrics]) -> dict[str, Any]:
    """Return ``{"per_frame": [...]}``: at each frame, the mean PSNR and SSIM over all clips (films) of test views.

    Return {} if there are no such clips, or if they differ in length.
    """
    own = [[views[i] for i in clip.views] for clip in clips if clip.source is None]
    if not own or len({len(clip) for clip in own}) != 1:
        return {}
    frames = []
    for same in zip(*own, strict=True):
        entry = metric_to_json("psnr", float(np.mean([v.psnr for v in same])))
        entry["ssim"] = float(np.mean([v.ssim for v in same]))
        for name in ("psnr_mask", "psnr_black_image"):
            if values := [v.more[name] for v in same if name in v.more]:
                entry |= metric_to_json(name, float(np.mean(values)))
        frames.append(entry)
    return {"per_frame": frames}
