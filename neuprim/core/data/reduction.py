"""Images on larger pixels: area means, and which of them count."""

from __future__ import annotations

import torch.nn.functional as F
from torch import Tensor

__all__ = ["averaged", "whole"]


def averaged(values: Tensor, factor: int) -> Tensor:
    """(H // factor, W // factor, C) means of (H, W, C); what is left over at the right and at the bottom is cut off."""
    return F.avg_pool2d(values.permute(2, 0, 1), factor).permute(1, 2, 0).contiguous()


def whole(mask: Tensor, factor: int) -> Tensor:
    """(H // factor, W // factor) bool of the large pixels all of whose parts count in (H, W) ``mask``."""
    return F.avg_pool2d(mask[None].float(), factor)[0] > 0.999
