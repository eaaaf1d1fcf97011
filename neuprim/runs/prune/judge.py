"""What pruning is judged by: some training views, kept out of what decides which parts go. Test views are looked at only at the end."""

from __future__ import annotations

import numpy as np
import torch

from neuprim.core.data import Dataset
from neuprim.core.metrics import psnr
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings
from neuprim.runs.measure import draw

__all__ = ["Judge"]

_JUDGED, _QUICK = 24, 8
"""Views that decide, and how many of them a search in between looks at."""

_LOOKED_AT = 64
"""Views that sensitivities come from."""

_MOST = 200.0
"""dB that stand for equal images."""


class Judge:
    """Mean PSNR over some training views, as ``metrics.json`` has it over test views.

    Which ones is drawn by lot, as views often are in an order (all times of a camera, all cameras of a time) that even steps would fall in with.

    Attributes:
        views: those that decide; others: of the remaining ones, as far as there are some, those that sensitivities come from.
    """

    def __init__(self, dataset: Dataset, settings: RenderSettings) -> None:
        self.dataset, self.settings = dataset, settings
        lot = torch.randperm(len(dataset.train), generator=torch.Generator().manual_seed(0)).tolist()
        decide = min(_JUDGED, max(len(lot) // 2, 1))
        self.views, self.others = lot[:decide], lot[decide : decide + _LOOKED_AT] or lot[:decide]

    def __call__(self, model: Primitives, quick: bool = False) -> float:
        """dB; with ``quick`` over every third view."""
        step = max(len(self.views) // _QUICK, 1) if quick else 1
        found = []
        for index in self.views[::step]:
            pixels = self.dataset.train.pixels(index)
            image = draw(model, self.dataset.train.view(index), self.settings, self.dataset.background)
            found.append(min(psnr(image, pixels.over(self.dataset.background), pixels.mask), _MOST))
        return float(np.mean(found))
