"""Losses for images and for points in a volume, and regularisers of the primitives' sizes.

The losses for images are the photometric loss, (1 - lambda) L1 + lambda (1 - SSIM), and three losses for linear light
of high dynamic range. Each function that makes a loss takes the settings that a
:class:`~neuprim.core.extensions.LossExtension` or a task's ``loss`` gets. Image losses need no masks, because the
trainer makes masked pixels equal in both images.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from scipy.spatial import cKDTree
from torch import Tensor

from neuprim.core.compute import device
from neuprim.core.data import PointSamples, ViewSet
from neuprim.core.model.fields import CHANNEL
from neuprim.core.model.primitives import Primitives
from neuprim.core.render.output import Contributions
from neuprim.core.task import Loss, Supervision
from neuprim.core.train.settings import TrainSettings
from neuprim.core.volumes.points import PointShares, volume_values_at

__all__ = ["compressed_loss", "l1", "photometric", "relative_loss"]

_WINDOW = 11
_MAX_CPU_CHANNELS = 51
_MU = 16.0
_DARK = 0.05

_ROWS = 65_536  # primitives whose distances from all cameras are in memory at once

_COMPONENT_WEIGHT = 0.1
"""Weight of the loss of the extinction's components, which are the parts of the extinction from single source grids.
This loss trains the share of each component in a primitive. Shares are learned equally fast with any weight; this
weight is so small that the loss hardly moves primitives."""


_FAINT = 0.02  # typical extinctions below which the error of a channel at a point counts less


def photometric_reference(rendered: Tensor, truth: Tensor, ssim_weight: float) -> tuple[Tensor, dict[str, Tensor]]:
    """Return the photometric loss and its parts, computed by kornia and autograd on any device.

    Tests compare the fast kernels with this function. :func:`photometric` uses it where the fast kernels do not apply.

    Args:
        rendered: (H, W, C) rendered image, values nominally in 0..1.
        truth: (H, W, C) true image.
        ssim_weight: lambda in (1 - lambda) L1 + lambda (1 - SSIM). SSIM uses an 11 x 11 Gaussian window (sigma 1.5)
            without padding. Images smaller than the window use L1 alone.
    """
    l1 = (rendered - truth).abs().mean()
    if ssim_weight == 0 or min(rendered.shape[:2]) < _WINDOW:
        return l1, {"l1": l1.detach()}
    from kornia.metrics import ssim as kornia_ssim  # slow to import, and the fused versions do without

    with torch.backends.cudnn.flags(enabled=False):  # may round to ten bits, and variances are differences of blurs
        maps = kornia_ssim(rendered.permute(2, 0, 1)[None], truth.permute(2, 0, 1)[None], _WINDOW, padding="valid")
    similarity = maps.mean()
    loss = (1 - ssim_weight) * l1 + ssim_weight * (1 - similarity)
    return loss, {"l1": l1.detach(), "ssim": similarity.detach()}


class _Photometric(torch.autograd.Function):
    """Autograd function of the photometric loss, whose kernels compute value and gradient together."""

    @staticmethod
    def forward(ctx: Any, rendered: Tensor, truth: Tensor, weight: float, parts: dict[str, Tensor]) -> Tensor:
        if device.on_numba(rendered):
            from neuprim.core.train.ssim_cpu import ssim_loss_with_gradient
        else:
            from neuprim.core.train.kernels_warp import ssim_loss_with_gradient
        means, grad = ssim_loss_with_gradient(rendered.detach(), truth.detach(), weight)
        parts["l1"], parts["ssim"] = means.unbind()
        ctx.save_for_backward(grad)
        return ((1 - weight) * means[0] + weight * (1 - means[1])).float()

    @staticmethod
    def backward(ctx: Any, g: Tensor) -> tuple[Tensor, None, None, None]:  # type: ignore[override]
        (grad,) = ctx.saved_tensors
        return grad * g, None, None, None


def photometric(settings: Mapping[str, Any]) -> Loss:
    """Return a function for the loss (1 - lambda) L1 + lambda (1 - SSIM), with lambda = ``settings["ssim_weight"]``."""
    weight = float(settings["ssim_weight"])

    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, Tensor]]:
        fits = rendered.dtype == truth.dtype == torch.float32 and min(rendered.shape[:2]) >= _WINDOW
        on_cpu = device.on_numba(rendered, truth) and rendered.shape[2] <= _MAX_CPU_CHANNELS
        if weight > 0 and fits and (on_cpu or device.on_warp(rendered, truth)):
            parts: dict[str, Tensor] = {}
            value: Tensor = _Photometric.apply(rendered, truth, weight, parts)
            return value, parts
        return photometric_reference(rendered, truth, weight)

    loss.recordable = True  # type: ignore[attr-defined]
    return loss


def l1(settings: Mapping[str, Any]) -> Loss:
    """Return a function for the loss mean |rendered - true|; it reads no settings."""
    return _image_loss("l1", lambda rendered, truth: (rendered - truth).abs().mean())


def compressed_loss(settings: Mapping[str, Any]) -> Loss:
    """Return a function for the L1 loss of log(1 + mu x) / log(1 + mu), where x are the images and mu = 16.

    The logarithm gives shadows more weight.
    """

    def measure(rendered: Tensor, truth: Tensor) -> Tensor:
        scale = torch.log1p(torch.tensor(_MU))
        a, b = (torch.log1p(_MU * x.clamp_min(0.0)) / scale for x in (rendered, truth))
        return (a - b).abs().mean()

    return _image_loss("compressed", measure)


def relative_loss(settings: Mapping[str, Any]) -> Loss:
    """Return a function for the loss mean ((rendered - true) / (rendered + 0.05))^2 (Mildenhall 2022, RawNeRF).

    The denominator gets no gradient; negative rendered values count as 0 in it.
    """

    def measure(rendered: Tensor, truth: Tensor) -> Tensor:
        return ((rendered - truth) / (rendered.detach().clamp_min(0.0) + _DARK)).square().mean()

    return _image_loss("relative", measure)


def _image_loss(name: str, measure: Callable[[Tensor, Tensor], Tensor]) -> Loss:
    def loss(rendered: Tensor, truth: Tensor, frame: Supervision) -> tuple[Tensor, dict[str, Tensor]]:
        value = measure(rendered, truth)
        return value, {name: value.detach()}

    loss.recordable = True  # type: ignore[attr-defined]
    return loss


# ---------------------------------------------------------------- points


@dataclass(frozen=True)
class PointLossResult:
    """Result of :func:`point_loss` at the points of one frame.

    Attributes:
        loss: differentiable scalar.
        parts: named parts of the loss, for the log, one number each.
        samples: the points and their true values.
        rows: indices of the primitives that are active in the frame; None for all.
        shares: these primitives' contributions to extinction and error.
    """

    loss: Tensor
    parts: dict[str, Tensor]
    samples: PointSamples
    rows: Tensor | None
    shares: PointShares

    def contributions(self) -> Contributions:
        """Return the sums over the points of each primitive's extinction, and of its extinction times the error.

        Call this method after the backward pass, which computes the sums.
        """
        return Contributions(self.shares.weight, self.shares.error_weight, self.rows)

    def psnr(self) -> float:
        """Return the PSNR of the extinction at the points, relative to the largest true extinction."""
        peak = max(float(self.samples.sigma.max()), 1e-30) / float(self.samples.sigma_scale)
        return -10 * math.log10(max(float(self.parts["voxel_sigma"]) / peak**2, 1e-20))


def point_loss(model: Primitives, samples: PointSamples, settings: TrainSettings, threads: int = 0) -> PointLossResult:
    """Return the loss of a model's extinction and source radiance against known values at points.

    The loss is a weighted sum of mean squared errors, each error divided by a scale from ``samples``. With
    ``train.supervision=both``, squared errors of the extinction are also divided by 1 + true extinction / scale. This
    lowers the weight of dense matter, because images do not show its inside. The weights are 1 for the extinction, 0.1
    for each extinction component and channel, and ``train.voxel_colour`` for the source radiance and for the scattered
    radiance. The error of a channel is that of its mean over primitives, weighted by their extinctions.
    """
    colour = samples.source is not None and settings.voxel_colour > 0
    found = volume_values_at(model, samples.conditions, samples.points, colour, threads)
    where, per_scale = found.sigma.device, 1 / samples.sigma_scale
    sigma = device.copy_to_device(samples.sigma, where)
    wrong = (found.sigma - sigma) * per_scale
    parts = {"voxel_sigma": wrong.detach().square().mean()}
    if settings.supervision == "both":
        wrong = wrong / (1 + sigma * per_scale).sqrt()
    loss = wrong.square().mean()
    if found.source is not None and samples.source is not None:
        light = (found.source - device.copy_to_device(samples.source, where)) * (1 / samples.source_scale)
        parts["voxel_source"] = light.detach().square().mean()
        loss = loss + settings.voxel_colour * light.square().mean()
    if found.scattered is not None and samples.scattered is not None:
        light = (found.scattered - device.copy_to_device(samples.scattered, where)) * (1 / samples.scattered_scale)
        parts["voxel_scattered"] = light.detach().square().mean()
        loss = loss + settings.voxel_colour * light.square().mean()
    for name, (value, scale) in samples.components.items():
        if name in found.components:
            known, own = device.copy_to_device(value, where), found.components[name]
            if name.startswith(CHANNEL):  # with the model's own sigma, so that wrong extinction is no error of channels
                true, sigma_found = sigma[:, None], found.sigma.detach()[:, None]
                inside = true > 0
                wanted = torch.where(inside, sigma_found * known / torch.where(inside, true, 1.0), own.detach())
                per_sigma = 1 / (sigma_found + _FAINT * samples.sigma_scale)
                part = (own - wanted) * per_sigma * (samples.sigma_scale / scale)
            else:
                part = (own - known) * (1 / scale)
            loss = loss + _COMPONENT_WEIGHT * part.square().mean()
    return PointLossResult(loss, parts, samples, found.rows, found.request_shares(wrong.detach().abs()))


# ---------------------------------------------------------------- sizes


def scale_anisotropy(log_scales: Tensor) -> Tensor:
    """Return the mean over primitives of std(s / min s), where s are the three semi-axes; 0 for spheres.

    This is the regulariser of the authors of the method.
    """
    ratio = (log_scales - log_scales.min(dim=-1, keepdim=True).values).exp()
    return ratio.std(dim=-1).mean()


class MaxScreenSize:
    """Limits the largest semi-axis of each primitive to a fraction of its distance to the nearest training camera.

    A primitive close to one camera covers few pixels of other cameras, so images alone do not stop its growth. Such a
    primitive learns the mean colour of the scene behind it. From a camera between two training cameras, the primitive
    then covers the whole image. A distant primitive may be large.

    Args:
        share: upper bound of largest semi-axis / distance.
        every: number of steps between two applications.
    """

    def __init__(self, views: ViewSet, share: float, every: int = 10) -> None:
        eyes = torch.stack([views.view(i).camera.position.detach().double() for i in range(len(views))])
        self.share, self.every, self._eyes, self._tree = share, every, eyes, cKDTree(eyes.numpy())

    def due(self, step: int) -> bool:
        """Return whether :meth:`apply` should run in this step."""
        return step % self.every == 0

    def apply(self, means: Tensor, log_scales: Tensor, when: Tensor | None = None) -> None:
        """Shrink primitives that exceed the limit, in place in ``log_scales`` (N, 3), all three axes by one factor.

        ``when`` is (1,) bool on the device; if ``when`` is False, no primitive changes.
        """
        with torch.no_grad():
            if device.on_numba(means):
                distance = torch.from_numpy(self._tree.query(means.detach().numpy())[0]).to(log_scales)
            else:  # without a wait; a row of distances per primitive, of some thousand primitives at a time
                self._eyes = self._eyes.to(means.device)
                near = [torch.cdist(part.double(), self._eyes).amin(1) for part in means.detach().split(_ROWS)]
                distance = torch.cat(near).to(log_scales)
            limit = (self.share * distance.clamp_min(1e-12)).log()
            excess = (log_scales.max(dim=1).values - limit).clamp_min(0.0)[:, None]
            log_scales -= excess if when is None else torch.where(when, excess, 0.0)
