"""Layers of a lit image: its light without the shadows, and how much of the light arrives."""

from __future__ import annotations

from torch import Tensor

from neuprim.core.layers import LayerFrame, LayerSpec

__all__ = ["LAYERS"]


def unshadowed(frame: LayerFrame) -> Tensor | None:
    """(H, W, C) the frame as if all of the light arrived everywhere; None for colours that know no shadows."""
    return None if frame.shading is None else frame.unshaded


def visibility(frame: LayerFrame) -> Tensor | None:
    """(H, W) mean visibility of the light; None for colours that know no shadows."""
    return (
        None if frame.shading is None else frame.shading.clamp(0.0, 1.0)
    )  # a mean of factors up to 1, but for rounding


LAYERS = (
    LayerSpec(
        "unshadowed", "the image as if the light arrived everywhere, linear light, premultiplied by alpha", unshadowed
    ),
    LayerSpec(
        "visibility",
        "how much of the light arrives, 0 to 1: the mean over what the pixel shows, weighted by its part in the pixel; 0 where alpha is 0",
        visibility,
        ("Y",),
    ),
)
"""What :attr:`~neuprim.core.task.TaskSpec.layers` of the task holds."""
