"""Motion blur: an image is the mean of sub-frames, renderings at times spread over the interval of an open shutter.

The shutter is centred on the frame, as in Blender and Arnold: it opens before the time of the frame and closes after
this time. The camera and the lights of an image do not move while the shutter is open.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from neuprim.core.conditions import frame_interval
from neuprim.core.data import View
from neuprim.core.errors import ConfigError
from neuprim.core.io.images import linear_to_srgb, srgb_to_linear
from neuprim.core.model.fields import ConditionSpec


@dataclass(frozen=True)
class Shutter:
    """A shutter that is open for ``fraction`` times ``interval``, centred on the time of each frame.

    Attributes:
        fraction: part of the interval between two frames, above 0 and at most 1.
        samples: number of sub-frames of an image.
        interval: time between two frames, in units of the condition "time".
        limits: first and last time of the sequence; times outside are clamped to this range.
    """

    fraction: float
    samples: int
    interval: float
    limits: tuple[float, float]

    def sub_frames(self, view: View) -> list[View]:
        """Return ``samples`` copies of a view. Their times are the middles of equal parts of the open interval."""
        time = view.conditions["time"]
        offsets = (self.fraction * self.interval * ((i + 0.5) / self.samples - 0.5) for i in range(self.samples))
        times = ((time.double() + offset).clamp(*self.limits).to(time) for offset in offsets)
        return [replace(view, conditions={**view.conditions, "time": moment}) for moment in times]


def choose_shutter(
    fraction: float, samples: int, specs: Sequence[ConditionSpec], header: Mapping[str, Any], views: Sequence[View]
) -> Shutter:
    """Return the shutter (motion blur) that ``--shutter FRACTION`` asks for, for the views of a model.

    Args:
        fraction: part of the interval between two frames in which the shutter is open, above 0 and at most 1.
        samples: number of sub-frames of an image.
        specs: conditions of the task (inputs of a frame besides its camera, such as the time).
        header: header of the model's file, see :func:`~neuprim.core.conditions.frame_interval`.
        views: the views to render, with their conditions.

    Raises:
        ConfigError: the model has no time, the fraction is out of range, or the interval between frames is unknown.
    """
    where = f"--shutter {fraction:g}"
    time = next((spec for spec in specs if spec.name == "time" and not spec.shape), None)
    if time is None:
        raise ConfigError(
            f"{where}: the model does not vary in time; expected a model of a moving scene. Omit --shutter."
        )
    if not 0 < fraction <= 1:
        raise ConfigError(f"{where}: expected a part of the frame interval, above 0 and at most 1")
    interval = frame_interval(header, (float(view.conditions["time"]) for view in views))
    if interval is None:
        found = "the frame interval is unknown: all images show one time, and the model has no numbered frames"
        raise ConfigError(f"{where}: {found}; expected several times. Pass a range, such as --time 0:1:48.")
    return Shutter(fraction, samples, interval, time.range)


def mean_in_linear_light(images: Iterable[Tensor], color_space: str) -> Tensor:
    """Return the mean of (H, W, C) images, averaged in linear light.

    Images and mean have the colour space ``color_space``, "linear" or "srgb". Negative sRGB values become 0.
    """
    if color_space == "linear":
        return torch.stack(list(images)).mean(0)
    return linear_to_srgb(torch.stack([srgb_to_linear(image.clamp_min(0.0)) for image in images]).mean(0))
