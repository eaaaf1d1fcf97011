"""The numbers of a fitted model: every held-out view, their means, and what the task adds.

PSNR and SSIM compare float images in the data set's own colour space, unclamped and unquantised. A linear data set also
gets both after the sRGB transfer curve (``psnr_srgb``, ``ssim_srgb``), if its channels are red, green and blue; a task
with a display of its own gets both of what that shows instead (``psnr_display``, ``ssim_display``). Where it marks a
part of a view (the union of all that a camera ever sees of a volume), the error there counts on its own: a black
background flatters. For comparing with other people's tables
``ssim_3dgs`` is the SSIM of what is displayed as the tools of 3D Gaussian splatting count it, and ``lpips`` and
``lpips_3dgs``, where the user has weights, are LPIPS as published and as these tools take it.
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

from neuprim.config import Job, find_run_plugins
from neuprim.core.channels import Channels, find_channels
from neuprim.core.compute import device
from neuprim.core.data import Clip, Dataset, View
from neuprim.core.data.dataset_check import check_dataset, check_pixels
from neuprim.core.data.ray_points import GIVE_POINTS
from neuprim.core.io import images
from neuprim.core.metrics import means, psnr, psnr_gain, ssim, ssim_3dgs, to_json
from neuprim.core.metrics.lpips import Lpips
from neuprim.core.model.fields import Conditions
from neuprim.core.model.primitives import Primitives
from neuprim.core.notices import warn_once
from neuprim.core.render import RenderSettings, choose_backend, render
from neuprim.core.task import TaskSpec
from neuprim.plugins.returns import call_task_clips, call_task_diagnose, call_task_mask, call_task_metrics
from neuprim.runs.open import load_dataset, load_run, model_file, move_to_render_device
from neuprim.runs.render_config import estimate_file_bytes, parse_render_config
from neuprim.version import __version__

_VISIBLE = 20 * math.log10(255)
"""dB: smaller errors than one of 255 levels are not visible, and an empty frame's black image has no error at all."""


@dataclass(frozen=True)
class ViewMetrics:
    """One view's numbers.

    Attributes:
        psnr, ssim: in the data set's colour space.
        seconds: of the forward pass alone.
        black: PSNR of an image of the background alone.
        empty: the model is not in the view; the image is the background alone.
        more: further numbers by name: ``psnr_srgb``, ``ssim_srgb`` of linear images, or ``psnr_display``,
            ``ssim_display`` of what the task's own display shows; ``psnr_gain`` of opaque photographs; ``ssim_3dgs``,
            ``lpips``; ``psnr_mask`` and ``mse_mask`` inside the task's mask; ``psnr_black_image`` and
            ``psnr_black_image_mask`` of an image without anything on it; what the task's
            :attr:`~neuprim.core.task.TaskSpec.metrics` adds.
    """

    name: str
    psnr: float
    ssim: float
    seconds: float
    black: float = -math.inf
    more: dict[str, float] = field(default_factory=dict)
    empty: bool = False


def render_image(model: Primitives, view: View, settings: RenderSettings, background: Tensor) -> Tensor:
    """(H, W, C) image of one view, without gradients; on the processor, wherever it was drawn."""
    with torch.no_grad():
        return render(model, view.camera, view.conditions, settings, background).rgb.cpu()


def render_light_sum(
    model: Primitives,
    view: View,
    lights: Sequence[Conditions],
    settings: RenderSettings,
    background: Tensor,
    drawn: Callable[[Tensor], None] = lambda alpha: None,
) -> Tensor:
    """(H, W, C) sum of one view's images under conditions that change light alone, over the background once; as
    :func:`draw`.

    Exact for what is linear in light, as opacity does not depend on it. Sums are float64.

    Args:
        lights: one or more; each replaces the view's conditions of the same names.
        drawn: called after every image, with its alpha.
    """
    total, alpha = torch.zeros(()), torch.zeros(())
    for light in lights:
        with torch.no_grad():
            frame = render(model, view.camera, {**view.conditions, **light}, settings)
        total, alpha = total + frame.rgb.double(), frame.alpha
        drawn(alpha)
    return (total + (1.0 - alpha.double())[..., None] * background.double().to(alpha.device)).to(frame.rgb).cpu()


def measure_views(
    model: Primitives,
    task: TaskSpec,
    dataset: Dataset,
    settings: RenderSettings,
    channels: Channels,
    seen: Callable[[int, View, Tensor, Tensor], None] | None = None,
    lpips: Lpips | None = None,
    paint: Callable[[Primitives, View, Tensor], Tensor] | None = None,
) -> list[ViewMetrics]:
    """Every view of the test split, composited over the data set's background.

    Args:
        seen: called as ``seen(index, view, rendered, truth)`` for each, e.g. to keep pictures.
        lpips: measured too, where there are weights for it.
        paint: draws (model, view, background) in place of :func:`draw` with the settings.
    """
    views, background = dataset.test, dataset.background
    result = []
    for i in range(len(views)):
        view, pixels = views.view(i), views.pixels(i)
        check_pixels("test", view, pixels, dataset.channels)
        truth = pixels.over(background)
        start = time.perf_counter()
        rendered = render_image(model, view, settings, background) if paint is None else paint(model, view, background)
        seconds = time.perf_counter() - start
        empty = bool((rendered == background).all())
        if pixels.mask is not None:
            rendered = torch.where(pixels.mask[..., None], rendered, truth)
        counted = call_task_mask(task, dataset, i)
        more = _more(rendered, truth, dataset, channels, counted, pixels.mask) | _as_others(
            rendered, truth, channels, lpips
        )
        if pixels.alpha is None:
            more["psnr_gain"] = psnr_gain(rendered, truth, pixels.mask)
        more |= call_task_metrics(task, dataset, i, rendered, truth)
        black = psnr(background.to(truth).expand_as(truth), truth, pixels.mask)
        score = psnr(rendered, truth, pixels.mask)
        result.append(ViewMetrics(view.name, score, ssim(rendered, truth), seconds, black, more, empty))
        if seen is not None:
            seen(i, view, rendered, truth)
    if all(view.empty for view in result):
        warn_once(
            f"{dataset.name}: the model is in none of {len(result)} test views, which show the background alone; "
            f"expected starting points where "
            f"the cameras look: {GIVE_POINTS}"
        )
    return result


def measure_quality(
    model: Primitives, task: TaskSpec, dataset: Dataset, settings: RenderSettings
) -> tuple[float, float]:
    """Mean PSNR and SSIM of the held-out views, as ``metrics.json`` has them, drawn where such views are best drawn."""
    views = measure_views(
        move_to_render_device(model, settings, dataset.test.view(0)),
        task,
        dataset,
        settings,
        find_channels(task, dataset),
    )
    return float(np.mean([v.psnr for v in views])), float(np.mean([v.ssim for v in views]))


def _more(
    rendered: Tensor, truth: Tensor, dataset: Dataset, channels: Channels, part: Tensor | None, valid: Tensor | None
) -> dict[str, float]:
    more: dict[str, float] = {}
    if channels.own is not None:
        shown, wanted = channels.display(rendered), channels.display(truth)
        more |= {"psnr_display": psnr(shown, wanted, valid), "ssim_display": ssim(shown, wanted)}
    elif dataset.color_space == "linear" and channels.plain:
        shown, wanted = (images.linear_to_srgb(x.clamp_min(0.0)) for x in (rendered, truth))
        more |= {"psnr_srgb": psnr(shown, wanted, valid), "ssim_srgb": ssim(shown, wanted)}
    if part is not None and bool(part.any()):
        black = dataset.background.to(truth).expand_as(truth)
        more["psnr_mask"] = psnr(rendered, truth, part)
        more["mse_mask"] = float((rendered - truth)[part].double().square().mean())
        more["psnr_black_image"], more["psnr_black_image_mask"] = psnr(black, truth), psnr(black, truth, part)
    return more


def _as_others(rendered: Tensor, truth: Tensor, channels: Channels, lpips: Lpips | None) -> dict[str, float]:
    """The numbers of other people's tables, of what is displayed."""
    shown, wanted = (channels.display(x).clamp(0.0, 1.0) for x in (rendered, truth))
    found = {"ssim_3dgs": ssim_3dgs(shown, wanted)}
    if lpips is not None and min(shown.shape[:2]) >= lpips.least:
        found |= {"lpips": lpips(shown, wanted), "lpips_3dgs": lpips.unmapped(shown, wanted)}
    return found


def evaluate_run(run_dir: Path, lpips: str | Path | None = None, words: Sequence[str] = ()) -> dict[str, Any]:
    """The metrics of a run's last checkpoint, measured again from disk alone; the same numbers as the run's own.

    Args:
        lpips: weights for LPIPS; without, those that the run names.
        words: overrides of a render configuration (:mod:`neuprim.runs.render_config`); ``model_bytes`` is the size of
            the run's file but for what these change.
    """
    config, task, model, header = load_run(run_dir)
    point = parse_render_config(words, config.renderer, model)
    config = replace(config, renderer=point.settings)
    weights = lpips or config.metrics.lpips
    distance = None if weights is None else Lpips.load(weights)
    with find_run_plugins(config).attribute_errors():
        dataset = load_dataset(config, task, run_dir=run_dir)
        check_dataset(dataset, task.conditions)
        path = model_file(run_dir)
        training = {"iterations": header.get("iterations"), "train_seconds": header.get("train_seconds")}
        channels = find_channels(task, dataset)
        part = point.prepare_model(model)
        size = estimate_file_bytes(path, model, part, point.storage)
        model = move_to_render_device(part, config.renderer, dataset.test.view(0))
        views = measure_views(model, task, dataset, config.renderer, channels, lpips=distance, paint=point.render_view)
        return summarize_metrics(Job(config, task, dataset, model), channels, views, size, training, distance)


def summarize_metrics(
    job: Job,
    channels: Channels,
    views: Sequence[ViewMetrics],
    model_bytes: int,
    training: Mapping[str, Any],
    lpips: Lpips | None = None,
    split: str = "test",
) -> dict[str, Any]:
    """The content of ``metrics.json``.

    Args:
        job: with its data and its model.
        training: iterations and train_seconds as the run recorded them.
        split: what the judging views are; those that are not the data set's test views make none of the task's films.
    """
    config, task, dataset, model = job.config, job.task, job.dataset, job.model
    assert dataset is not None and model is not None
    worst, camera = min(views, key=lambda v: v.psnr), dataset.test.view(0).camera
    lowered = model.lower(dataset.test.view(0).camera, dataset.test.view(0).conditions, config.renderer)
    backend = choose_backend(lowered, config.renderer)
    seconds = sorted(v.seconds for v in views)
    return {
        "task": config.task,
        "scene": config.scene_name,
        "dataset": dataset.name,
        "preset": config.preset,
        "split": split,
        **to_json("psnr", float(np.mean([v.psnr for v in views]))),
        "ssim": float(np.mean([v.ssim for v in views])),
        **means([v.more for v in views]),
        **_lpips(views, lpips),
        **to_json("psnr_worst", worst.psnr),
        "view_worst": worst.name,
        "worse_than_black_image": [v.name for v in views if v.psnr < min(v.black, _VISIBLE)],
        "per_view": [_entry(v) for v in views],
        **({"views_empty": sum(v.empty for v in views)} if any(v.empty for v in views) else {}),
        **_per_frame(call_task_clips(task, dataset) if split == "test" else (), views),
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
        "image_size": [camera.width, camera.height],
        "background": [round(float(x), 6) for x in dataset.background],
        "color_space": dataset.color_space,
        "channels": list(channels.names),
        **({"shown": channels.shown} if channels.shown else {}),
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
        **({} if config.made_by is None else {"made_by": config.made_by.origins()}),
    }


def _entry(view: ViewMetrics) -> dict[str, Any]:
    entry = {"name": view.name, **to_json("psnr", view.psnr), "ssim": view.ssim, "seconds": view.seconds}
    for name, value in view.more.items():
        entry |= to_json(name, value)
    return entry


def _lpips(views: Sequence[ViewMetrics], lpips: Lpips | None) -> dict[str, Any]:
    """Which network measured LPIPS, or why none did: a missing number is not a zero."""
    if lpips is None:
        return {
            "lpips": None,
            "not_measured": {"lpips": "no weights were given (metrics.lpips=FILE, or neuprim eval --lpips FILE)"},
        }
    if any("lpips" not in v.more for v in views):
        return {
            "lpips": None,
            "lpips_3dgs": None,
            "not_measured": {"lpips": f"some view is lower or narrower than {lpips.least} pixels"},
        }
    return {"lpips_network": lpips.network}


def _per_frame(made: Sequence[Clip], views: Sequence[ViewMetrics]) -> dict[str, Any]:
    """Means over the clips of the test views of each of their frames, where these are of one length."""
    clips = [[views[i] for i in clip.views] for clip in made if clip.source is None]
    if not clips or len({len(c) for c in clips}) != 1:
        return {}
    frames = []
    for same in zip(*clips, strict=True):
        entry = to_json("psnr", float(np.mean([v.psnr for v in same]))) | {
            "ssim": float(np.mean([v.ssim for v in same]))
        }
        for name in ("psnr_mask", "psnr_black_image"):
            values = [v.more[name] for v in same if name in v.more]
            entry |= to_json(name, float(np.mean(values))) if values else {}
        frames.append(entry)
    return {"per_frame": frames}
