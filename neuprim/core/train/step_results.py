"""Results of training steps and of their views."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from neuprim.core.data import Pixels, View
from neuprim.core.render.output import Contributions, RenderOutput
from neuprim.core.task import Loss, Supervision
from neuprim.core.train.training_views import PixelStride


@dataclass(frozen=True)
class StepReport:
    """Result of one training step.

    On a GPU, the first access to ``loss``, ``parts`` or ``psnr`` waits until the step has ended.

    Attributes:
        seconds: training time up to the end of this step.
        parts: named parts of the loss.
        psnr: PSNR of the training view (mean over views), or of the extinction at points in a step without views.
        primitives: number of primitives after the step.
        change: text about what population control changed; None if nothing.
    """

    step: int
    seconds: float
    loss: float
    parts: dict[str, float]
    psnr: float
    primitives: int
    view: str
    change: str | None

    @classmethod
    def pending(cls, settle: Callable[[], None], **known: Any) -> StepReport:
        """Return a report whose loss, parts and PSNR are not known yet; ``known`` has values of other fields.

        The first access to the loss, the parts or the PSNR calls ``settle``, which must pass all three to
        :meth:`resolve`.
        """
        report = cls.__new__(cls)
        report.__dict__.update(known, _settle=settle)
        return report

    def resolve(self, loss: float, parts: dict[str, float], psnr: float) -> None:
        """Set the loss, its parts and the PSNR of a pending report."""
        self.__dict__.update(loss=loss, parts=parts, psnr=psnr)

    def __getattr__(self, name: str) -> Any:
        if name not in ("loss", "parts", "psnr") or "_settle" not in self.__dict__:
            raise AttributeError(name)
        self.__dict__["_settle"]()
        return self.__dict__[name]


class ViewTask(NamedTuple):
    """A training view to render: its index, background, selected pixels, and the index of the next view, if known."""

    view: int
    background: Tensor
    stride: PixelStride
    upcoming: int | None


class ViewResult(NamedTuple):
    """Results of one view of a step.

    Attributes:
        loss: the view's part of the step's loss. The loss of the last view includes points and regularisers.
        parts: named parts of the loss. The parts of the last view include points.
        gain: gradient of the logarithm of the view's exposure, one number per channel; None without learned exposures.
        correction: gradient of the view's corrections; None without learned corrections.
    """

    view: int
    name: str
    loss: float
    psnr: float
    parts: dict[str, float]
    gain: list[float] | None
    correction: list[float] | None


@dataclass
class RenderedView:
    """A rendered view and its loss against the true image; the backward pass fills ``contributions``."""

    loss: Tensor
    parts: dict[str, float | Tensor]
    squared: Tensor  # sum of squared errors
    counted: int | Tensor  # number of values in the sum: unmasked pixels x channels
    name: str
    truth: Tensor
    contributions: Contributions

    def numbers(self, cost: Tensor, more: Iterable[Tensor] = ()) -> Tensor:
        """Return ``cost``, ``squared``, ``counted``, parts and ``more`` in one float64 tensor.

        With a single tensor, the host waits for the GPU only once.
        """
        values = (cost.detach(), self.squared, self.counted, *self.parts.values(), *more)
        like = self.squared
        return torch.stack(
            [
                x.detach().double() if isinstance(x, Tensor) else like.new_full((), x, dtype=torch.float64)
                for x in values
            ]
        )


def compare_view(
    output: RenderOutput, loss: Loss, view: View, pixels: Pixels, background: Tensor, progress: float = 0.0
) -> RenderedView:
    """Return the loss of a rendered view against the view's true image, without waiting for a GPU.

    The true image is composited over the (C,) ``background`` of the rendered view.
    """
    truth = pixels.over(background)
    rgb = output.rgb if pixels.mask is None else torch.where(pixels.mask[..., None], output.rgb, truth)
    value, parts = loss(rgb, truth, Supervision(view, pixels.mask, pixels.alpha, progress))
    with torch.no_grad():
        difference = rgb - truth
        channels = difference.shape[-1]
        mean = torch.full((channels,), 1.0 / channels, device=rgb.device)
        contributions = output.request_contributions(difference.abs() @ mean)
        flat = difference.reshape(-1)
        counted = flat.numel() if pixels.mask is None else pixels.mask.sum() * channels
    return RenderedView(value, dict(parts), torch.dot(flat, flat), counted, view.name, truth, contributions)


def summarize_numbers(numbers: Sequence[float], parts: Sequence[str]) -> tuple[float, dict[str, float], float]:
    """Return (loss, parts by name, PSNR) from the values of :meth:`RenderedView.numbers` and the names ``parts``."""
    cost, squared, counted, *values = numbers
    mse = squared / counted
    psnr = -10 * math.log10(max(mse, 1e-20)) if math.isfinite(mse) else math.nan
    return cost, dict(zip(parts, values, strict=False)), psnr


def summarize_views(views: list[ViewResult]) -> tuple[float, dict[str, float], float]:
    """Return summed loss, mean parts and mean PSNR of a step, from the results of its views."""
    first, last, count = views[0], views[-1], len(views)
    means = {part: sum(view.parts[part] for view in views) / count for part in first.parts}
    return sum(view.loss for view in views), last.parts | means, sum(view.psnr for view in views) / count


def name_views(names: Sequence[str]) -> str:
    """Return a text that names the views of a step, for reports: the last view, and the number of others."""
    return names[-1] if len(names) == 1 else f"{names[-1]} and {len(names) - 1} more"
