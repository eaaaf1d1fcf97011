"""Evaluation views: some test views, evenly spread, with their ground truth."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.data import Dataset, View
from neuprim.core.data.dataset_check import check_pixels

__all__ = ["EvalView", "eval_views", "fill_masked"]


@dataclass(frozen=True)
class EvalView:
    """A test view, its ground truth over the background, (H, W, C), and the pixels that count (None: all)."""

    view: View
    image: Tensor
    mask: Tensor | None


def eval_views(dataset: Dataset, views: int) -> list[EvalView]:
    """Return at most ``views`` of the test views, evenly spread."""
    count, chosen = len(dataset.test), []
    most = min(views, count)
    for i in (k * count // most for k in range(most)):
        view, pixels = dataset.test.view(i), dataset.test.pixels(i)
        check_pixels("test", view, pixels, dataset.channels)
        chosen.append(EvalView(view, pixels.over(dataset.background), pixels.mask))
    return chosen


def fill_masked(image: Tensor, view: EvalView) -> Tensor:
    """Replace the pixels that do not count by the ground truth."""
    return image if view.mask is None else torch.where(view.mask[..., None], image, view.image.to(image))
