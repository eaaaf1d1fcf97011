"""Layers of a volume's image: the two terms of the equation of transfer, dL/ds = sigma c - sigma L, integrated along
each ray.

What arrives is what was emitted less what was absorbed on the way, so that beauty = emission - absorption (over black).
N. Max, "Optical models for direct volume rendering", 1995, has the emission alone as the model without absorption.
"""

from __future__ import annotations

from torch import Tensor

from neuprim.core.layers import LayerFrame, LayerSpec

__all__ = ["LAYERS"]


def emission(frame: LayerFrame) -> Tensor | None:
    """(H, W, C) integral of sigma c, linear light."""
    return frame.emitted


def absorption(frame: LayerFrame) -> Tensor | None:
    """(H, W, C) integral of sigma L: the emitted light that does not arrive."""
    return None if frame.emitted is None else frame.emitted - frame.drawn.rgb


LAYERS = (
    LayerSpec(
        "emission",
        "all light that is emitted along the ray, as if nothing absorbed any: the integral of sigma c, linear light",
        emission,
    ),
    LayerSpec(
        "absorption",
        "the part of the emission that is absorbed before it arrives, linear light: beauty = emission - absorption",
        absorption,
    ),
)
"""What :attr:`~neuprim.core.task.TaskSpec.layers` of the task holds."""
