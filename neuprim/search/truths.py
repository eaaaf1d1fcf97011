"""The held-out views that models are compared on: some of them, evenly spread, with their true images."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.data import Dataset, View
from neuprim.core.data.dataset_check import check_pixels

__all__ = ["Truth", "masked", "truths_of"]


@dataclass(frozen=True)
class Truth:
    """A held-out view: its name, camera and conditions, its true image over the background, (H, W, C), and which pixels
    count."""

    view: View
    image: Tensor
    mask: Tensor | None


def truths_of(dataset: Dataset, views: int) -> list[Truth]:
    """At most ``views`` of the test views, evenly spread; none of a data set without any."""
    count, found = len(dataset.test), []
    most = min(views, count)
    for i in (k * count // most for k in range(most)):
        view, pixels = dataset.test.view(i), dataset.test.pixels(i)
        check_pixels("test", view, pixels, dataset.channels)
        found.append(Truth(view, pixels.over(dataset.background), pixels.mask))
    return found


def masked(image: Tensor, truth: Truth) -> Tensor:
    """The image with the truth where pixels do not count, as metrics take it."""
    return image if truth.mask is None else torch.where(truth.mask[..., None], image, truth.image.to(image))
