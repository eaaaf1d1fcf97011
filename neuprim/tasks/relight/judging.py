"""What relit images are judged by, whichever scene they are of: scores, classes of pixels, baselines, films and an
orbit of the light."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from neuprim.core.data import Clip, Dataset, View
from neuprim.core.metrics import means
from neuprim.core.metrics.flip import flip_available
from neuprim.core.model.primitives import Primitives
from neuprim.tasks.relight.data import lighting_of
from neuprim.tasks.relight.environment import summary
from neuprim.tasks.relight.measure import class_errors, class_shares, scores

__all__ = ["baselines", "clips", "diagnose", "facts", "judge", "mask", "orbit"]

_MATTER = 1.0 / 255.0  # alpha from which a pixel belongs to the mask


def mask(dataset: Dataset, index: int) -> Tensor | None:
    """Pixels of a test view that show matter; None for images without alpha."""
    alpha = dataset.test.pixels(index).alpha
    return None if alpha is None else alpha > _MATTER


def judge(dataset: Dataset, index: int, rendered: Tensor, truth: Tensor) -> dict[str, float]:
    """See :func:`neuprim.tasks.relight.measure.scores`; also the errors of each pixel class, and the PSNR again under
    the name of the view's part of the test split, where the data set tells classes and parts."""
    return _judged(dataset, index, rendered, truth, structure=True)


def _judged(dataset: Dataset, index: int, rendered: Tensor, truth: Tensor, structure: bool) -> dict[str, float]:
    known, result = lighting_of(dataset), scores(rendered, truth, structure)
    part = next((p for p in known.parts if dataset.test.view(index).name.startswith(p)), None)
    if part is not None:
        result[f"psnr_linear_clamped_{part}"] = result["psnr_linear_clamped"]
    return result if known.classes is None else result | class_errors(rendered, truth, known.classes(index))


def diagnose(dataset: Dataset, model: Primitives) -> dict[str, Any]:
    """How light is measured here, how good images without a model would be, and the share of each pixel class in the
    test split, in percent of the pixels that show matter."""
    known = lighting_of(dataset)
    result: dict[str, Any] = {"exposure": dataset.exposure, "falloff": known.falloff, "baselines": baselines(dataset)}
    if not flip_available():
        result["flip_missing"] = "pip install 'neuprim[flip]'"
    if known.classes is not None:
        result["class_percent"] = class_shares([known.classes(i) for i in range(len(dataset.test))])
    return result


def baselines(dataset: Dataset) -> dict[str, dict[str, Any]]:
    """Means over the test views of what images that need no model score, by name; SSIM and FLIP are left out, which
    take long."""
    result = {"black": _guessed(dataset, lambda i, truth: torch.zeros_like(truth))}
    for name, guess in lighting_of(dataset).baselines.items():
        result[name] = _guessed(dataset, lambda i, truth, guess=guess: guess(i))  # type: ignore[misc]
    return result


def _guessed(dataset: Dataset, guess: Callable[[int, Tensor], Tensor]) -> dict[str, Any]:
    """Means over the test views of what ``guess(index, truth)``, an (H, W, 3) image, scores."""
    entries = []
    for i in range(len(dataset.test)):
        truth = dataset.test.pixels(i).over(dataset.background)
        entries.append(_judged(dataset, i, guess(i, truth), truth, structure=False))
    return means(entries)


def clips(dataset: Dataset) -> Sequence[Clip]:
    """Those that the data set brings."""
    return lighting_of(dataset).clips


def facts(dataset: Dataset) -> dict[str, Any]:
    """Where the training lights were, as the scene's centre sees them: see
    :func:`~neuprim.tasks.relight.environment.summary`."""
    lights = torch.stack([dataset.train.view(i).conditions["light"] for i in range(len(dataset.train))])
    return {"lights": summary(lights, dataset.center, lighting_of(dataset).falloff, dataset.exposure)}


def orbit(dataset: Dataset, frames: int) -> list[View]:
    """Views circling the scene while the light circles it the other way, once, at its mean distance and height."""
    training = [dataset.train.view(i).conditions for i in range(len(dataset.train))]
    up, center = (x.double() / n for x, n in ((dataset.up, dataset.up.double().norm()), (dataset.center, 1.0)))
    offsets = torch.stack([c["light"] for c in training]).double() - center
    radius, sine = offsets.norm(dim=-1).mean(), ((offsets @ up) / offsets.norm(dim=-1).clamp_min(1e-30)).mean()
    helper = torch.eye(3, dtype=torch.float64)[int(up.abs().argmin())]
    side = torch.linalg.cross(up, helper)
    side = side / side.norm()
    other = torch.linalg.cross(up, side)
    intensity = torch.stack([c["light_intensity"] for c in training]).mean(0)
    views = []
    for i, view in enumerate(dataset.orbit(frames)):
        turn = -2.0 * math.pi * i / frames
        across = math.cos(turn) * side + math.sin(turn) * other
        light = center + radius * (sine * up + (1.0 - sine * sine).clamp_min(0.0).sqrt() * across)
        views.append(View(view.name, view.camera, {"light": light.float(), "light_intensity": intensity}))
    return views
