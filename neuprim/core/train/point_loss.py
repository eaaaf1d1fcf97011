"""Compare a model with known extinction and source radiance at points."""

from __future__ import annotations

import math
from dataclasses import dataclass

from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.data import Dataset, PointSamples
from neuprim.core.data.dataset_check import check_samples
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions
from neuprim.core.train.settings import TrainSettings
from neuprim.core.volumes.points import PointShares, volume_values_at

_COMPONENT = 0.1
"""Weight of an extinction's components: it teaches the primitives' shares, whose rate does not depend on it, and hardly
moves primitives."""


@dataclass(frozen=True)
class PointResult:
    """One frame's points, evaluated and compared.

    Attributes:
        loss: with gradient. parts: its named parts, for the log.
        psnr: of the extinction at the points, against the largest true one.
        name: of the frame.
        rows, shares: of the primitives that are active in the frame, see
            :func:`~neuprim.core.volumes.points.volume_values_at`.
    """

    loss: Tensor
    parts: dict[str, float]
    psnr: float
    name: str
    rows: Tensor | None
    shares: PointShares

    def contributions(self) -> Contributions:
        """Contributions of the primitives to the points; call it after the backward pass."""
        return Contributions(self.shares.weight, self.shares.error_weight, self.rows)


def point_loss(
    model: Primitives,
    dataset: Dataset,
    samples: PointSamples,
    settings: TrainSettings,
    threads: int = 0,
) -> PointResult:
    """Evaluate the model at points and compare.

    The loss is the mean square of errors over their scale: the extinction's, which is the square of its relative L2
    error but for how the points are spread, :data:`_COMPONENT` times that of each of its components, and
    ``train.voxel_colour`` times the source's.
    """
    check_samples(samples, dataset)
    colour = samples.source is not None and settings.voxel_colour > 0
    found = volume_values_at(model, samples.conditions, samples.points, colour, threads)
    where = found.sigma.device
    wrong = (found.sigma - device.copy_from_host(samples.sigma, where)) / samples.sigma_scale
    loss = wrong.square().mean()
    parts = {"voxel_sigma": loss.item()}
    if found.source is not None and samples.source is not None:
        light = ((found.source - device.copy_from_host(samples.source, where)) / samples.source_scale).square().mean()
        parts["voxel_source"] = light.item()
        loss = loss + settings.voxel_colour * light
    for name, (value, scale) in samples.components.items():
        if name in found.components:
            part = ((found.components[name] - device.copy_from_host(value, where)) / scale).square().mean()
            loss = loss + _COMPONENT * part
    peak = max(float(samples.sigma.max()), 1e-30) / samples.sigma_scale
    psnr = -10 * math.log10(max(parts["voxel_sigma"] / peak**2, 1e-20))
    return PointResult(loss, parts, psnr, samples.name, found.rows, found.request_shares(wrong.detach().abs()))
