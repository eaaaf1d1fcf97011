"""Keep primitives from growing too large or too thin."""

from __future__ import annotations

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.data import ViewSet


class MaxScreenSize:
    """Limit every primitive's largest semi-axis to a share of its distance to the nearest training camera.

    A primitive close to one camera covers few pixels of the others, so images alone do not stop its growth: it learns
    the mean of what is behind it and veils views from between two cameras. A distant primitive may be large.

    Args:
        views: the training views.
        share: largest semi-axis over distance.
        every: steps between two applications.
    """

    def __init__(self, views: ViewSet, share: float, every: int = 10) -> None:
        eyes = torch.stack([views.view(i).camera.position.detach().double() for i in range(len(views))])
        self.share, self.every = share, every
        self._eyes = cKDTree(eyes.numpy())

    def apply(self, step: int, means: Tensor, log_scales: Tensor) -> None:
        """Shrink (N, 3) ``log_scales`` in place where they exceed the limit, all axes of a primitive alike."""
        if step % self.every:
            return
        distance = torch.from_numpy(self._eyes.query(means.detach().cpu().numpy())[0]).to(log_scales)
        limit = (self.share * distance.clamp_min(1e-12)).log()
        with torch.no_grad():
            log_scales -= (log_scales.max(dim=1).values - limit).clamp_min(0.0)[:, None]


def scale_anisotropy(log_scales: Tensor) -> Tensor:
    """Mean over primitives of the standard deviation over axes of s / min s (the authors' regulariser); 0 for
    spheres."""
    ratio = (log_scales - log_scales.min(dim=-1, keepdim=True).values).exp()
    return ratio.std(dim=-1).mean()
