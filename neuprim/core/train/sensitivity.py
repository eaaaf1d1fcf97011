"""What images would lose without a primitive, or without a piece of it, found by one backward pass per view.

An image is J delta different when numbers change by delta, to first order. For random signs z per pixel and channel, the mean of (z . J delta)^2
is the sum of squares |J delta|^2 (Hutchinson 1990, for the trace), and z . J is what a backward pass gives. So views are enough to know every
piece's squared effect at once. A whole primitive's part in a pixel is its weight w = alpha T times how much its colour differs from what is
behind it; its sum of w^2 comes the same way out of the frame's tally. Squares matter: primitives of equal summed weight differ much in it, and
on a trained chair those with the least w^2 cost a third of what those with the least w cost (docs/tradeoffs.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from neuprim.core.data import Dataset
from neuprim.core.model.fields import pieces_by_name
from neuprim.core.model.pieces import worth
from neuprim.core.model.primitives import Primitives
from neuprim.core.render import RenderSettings, render

__all__ = ["Sensitivity", "sensitivity"]


@dataclass(frozen=True)
class Sensitivity:
    """Mean squared effects over the pixels and channels of some views.

    Attributes:
        whole: (N,) of each primitive, for a difference of colour of 1 from what is behind it.
        pieces: name -> (N,) of each primitive's piece being zero.
    """

    whole: Tensor
    pieces: dict[str, Tensor]


def sensitivity(model: Primitives, dataset: Dataset, views: Sequence[int], settings: RenderSettings, seed: int = 0) -> Sensitivity:
    """Effects over training views, on the processor.

    Args:
        views: indices of training views.
        seed: of the random signs.
    """
    generator = torch.Generator().manual_seed(seed)
    pieces = pieces_by_name(model.density, model.colour)
    whole = torch.zeros(model.count)
    found = {name: torch.zeros(model.count) for name in pieces}
    background, numbers = dataset.background.float(), 0
    for index in views:
        view = dataset.train.view(index)
        params = {name: value.detach().requires_grad_() for name, value in model.params.items()}
        seen = Primitives(model.density, model.colour, params)
        output = render(seen, view.camera, view.conditions, settings, background.to(model.device))
        signs = (2 * torch.randint(0, 2, output.rgb.shape, generator=generator) - 1).to(output.rgb)
        tally = output.watch(signs[..., 0])
        (output.rgb * signs).sum().backward()
        gradients = {name: torch.zeros_like(value) if value.grad is None else value.grad for name, value in params.items()}
        _, signed = tally.of_all(model.count)
        whole += signed.cpu().square() * output.rgb.shape[-1]
        for name, piece in pieces.items():
            found[name] += worth(piece, params, gradients).square().cpu()
        numbers += output.rgb.numel()
    return Sensitivity(whole / numbers, {name: value / numbers for name, value in found.items()})
