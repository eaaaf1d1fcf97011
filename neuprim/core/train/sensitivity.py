"""Estimate the error in images, or at points, of removing a primitive or a part of one, by one backward pass per view.

A part (a prunable unit) is a group of parameters such as a neuron. If parameters change by delta, an image changes by J
delta to first order, where J is the Jacobian of the image. For random signs z per pixel and channel, the mean of (z . J
delta)^2 is |J delta|^2 (Hutchinson 1990). A backward pass computes z . J. Removing a primitive changes a pixel by w x
(the primitive's colour - the colour behind the primitive), where w = alpha T is the primitive's weight in the pixel.
The sum of w^2 over pixels predicts the increase of the loss better than the sum of w.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.data import Dataset, PointSamples
from neuprim.core.model.fields import prunable_units_of_model
from neuprim.core.model.primitives import Primitives
from neuprim.core.model.prunable import primitive_unit_removal_effect
from neuprim.core.render import RenderSettings, render
from neuprim.core.volumes.points import volume_values_at


@dataclass(frozen=True)
class Sensitivity:
    """Mean squared effects of changes to a model, over the pixels and channels of some views, or over points.

    Attributes:
        whole: (N,) effect of removing each primitive. For views, the primitive's colour is assumed to differ by 1 from
            the colour behind the primitive.
        seen: (N,) number of views, or frames, that show the primitive. If the number is 0, the effects are unknown.
        pieces: name of a prunable unit, e.g. of a neuron -> (N,) effect of setting this unit of each primitive to zero.
        columns: parameter -> (C,) float64 effects. Effect c is that of changing number c of the parameter in all
            primitives, by independent random amounts of variance 1. A change of "quats" is perpendicular to the
            quaternion, which has unit norm.
    """

    whole: Tensor
    seen: Tensor
    pieces: dict[str, Tensor]
    columns: dict[str, Tensor]

    def combine(self, other: Sensitivity, weight: float) -> Sensitivity:
        """Return these effects plus ``weight`` times the effects in ``other``; the counts ``seen`` are added."""
        pieces = {name: value + weight * other.pieces[name] for name, value in self.pieces.items()}
        columns = {name: value + weight * other.columns[name] for name, value in self.columns.items()}
        return Sensitivity(self.whole + weight * other.whole, self.seen + other.seen, pieces, columns)


class _SensitivitySums:
    """Sums of squared effects over several backward passes, each of which starts from random signs."""

    def __init__(self, model: Primitives) -> None:
        self._model, self._pieces = model, prunable_units_of_model(model.density, model.colour)
        self.pieces = {name: torch.zeros(model.count) for name in self._pieces}
        self.columns = {spec.name: torch.zeros(spec.size, dtype=torch.float64) for spec in model.specs}

    def add_pass(self, params: dict[str, Tensor]) -> None:
        """Add the squared effects of one backward pass, computed from ``params`` and their ``.grad``."""
        gradients = {
            name: torch.zeros_like(value) if value.grad is None else value.grad for name, value in params.items()
        }
        for name, piece in self._pieces.items():
            self.pieces[name] += primitive_unit_removal_effect(piece, params, gradients).square().cpu()
        for name, own in self.columns.items():
            slopes = gradients[name].reshape(self._model.count, len(own))
            if name == "quats":  # a change of a quaternion counts by its rotation, whatever the norm
                slopes = slopes * params[name].detach().norm(dim=1, keepdim=True)
            own += slopes.double().square().sum(0).cpu()

    def means(self, count: float, whole: Tensor, seen: Tensor) -> Sensitivity:
        pieces = {name: value / count for name, value in self.pieces.items()}
        columns = {name: value / count for name, value in self.columns.items()}
        return Sensitivity(whole / count, seen, pieces, columns)


def sensitivity(
    model: Primitives, dataset: Dataset, views: Sequence[int], settings: RenderSettings, seed: int = 0
) -> Sensitivity:
    """Estimate the effects of changes to a model on the images of training views; returns CPU tensors.

    Args:
        views: indices of training views.
        seed: seed of the random signs.
    """
    generator = torch.Generator().manual_seed(seed)
    whole, seen, sums = torch.zeros(model.count), torch.zeros(model.count, dtype=torch.int64), _SensitivitySums(model)
    background, numbers = dataset.background.float(), 0
    for index in views:
        view = dataset.train.view(index)
        params = {name: value.detach().requires_grad_() for name, value in model.params.items()}
        traced = Primitives(model.density, model.colour, params)
        output = render(traced, view.camera, view.conditions, settings, background.to(model.device))
        signs = (2 * torch.randint(0, 2, output.rgb.shape, generator=generator) - 1).to(output.rgb)
        contributions = output.request_contributions(signs[..., 0])
        (output.rgb * signs).sum().backward()
        sums.add_pass(params)
        weight, signed = contributions.of_all(model.count)
        seen += (weight > 0).cpu()
        whole += signed.cpu().square() * output.rgb.shape[-1]
        numbers += output.rgb.numel()
    return sums.means(numbers, whole, seen)


def inner_sensitivity(model: Primitives, draws: Sequence[PointSamples], seed: int = 0, threads: int = 0) -> Sensitivity:
    """Estimate the effects of changes to a model on its extinction at points, relative to typical extinction.

    Returns CPU tensors. Use this function for volumes with known extinction, because images do not show the extinction
    inside dense matter.

    Args:
        draws: samples of points, each from one frame.
        seed: seed of the random signs.
        threads: CPU threads; 0 uses all cores.
    """
    generator = torch.Generator().manual_seed(seed)
    whole, seen, sums = torch.zeros(model.count), torch.zeros(model.count, dtype=torch.int64), _SensitivitySums(model)
    for samples in draws:
        params = {name: value.detach().requires_grad_() for name, value in model.params.items()}
        traced = Primitives(model.density, model.colour, params)
        values = volume_values_at(traced, samples.conditions, samples.points, False, threads)
        signs = (2 * torch.randint(0, 2, (len(samples.points),), generator=generator) - 1).float()
        signs = device.copy_to_device(signs / samples.sigma_scale / len(signs) ** 0.5, values.sigma.device)
        shares = values.request_shares(signs)
        (values.sigma * signs).sum().backward()
        rows = torch.arange(model.count) if values.rows is None else values.rows.cpu()
        whole[rows] += shares.error_weight.cpu().square()
        seen[rows] += (shares.weight > 0).cpu()
        sums.add_pass(params)
    return sums.means(max(len(draws), 1), whole, seen)
