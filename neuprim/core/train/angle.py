"""How large a primitive may look: a limit for scenes that cameras stand in."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.data import ViewSet

__all__ = ["AngularSize"]


class AngularSize:
    """Keeps every primitive's largest semi-axis below a share of its distance to the nearest training camera.

    What hovers in front of one camera covers few of the others' pixels, so that images alone do not keep it from
    growing: it learns the mean of what is behind it and veils the subject in a view from between two cameras. What is
    far may be large.

    Args:
        views: the training views.
        share: largest semi-axis over distance.
        every: steps from one look to the next.
    """

    def __init__(self, views: ViewSet, share: float, every: int = 10) -> None:
        eyes = torch.stack([views.view(i).camera.position.detach().double() for i in range(len(views))])
        self.share, self.every = share, every
        self._eyes = cKDTree(eyes.numpy())

    def step(self, step: int, means: Tensor, log_scales: Tensor) -> None:
        """Shrink (N, 3) ``log_scales`` in place, all axes of a primitive alike, where they are due and too large."""
        if step % self.every:
            return
        distance = torch.from_numpy(self._eyes.query(means.detach().cpu().numpy())[0]).to(log_scales)
        limit = (self.share * distance.clamp_min(1e-12)).log()
        with torch.no_grad():
            log_scales -= (log_scales.max(dim=1).values - limit).clamp_min(0.0)[:, None]
