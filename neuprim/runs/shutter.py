"""Motion blur: an image is the mean of sub-frames, whose times are spread over the interval of an open shutter.

The shutter is centred on the frame, as in Blender and Arnold: it opens before the time of the frame and closes after
it. The camera and the lights of an image do not move while the shutter is open.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from neuprim.core.data import View
from neuprim.core.errors import ConfigError
from neuprim.core.io.images import linear_to_srgb, srgb_to_linear
from neuprim.core.model.fields import ConditionSpec


@dataclass(frozen=True)
class Shutter:
    """A shutter that is open from t - fraction interval/2 to t + fraction interval/2 in a frame of time t.

    Attributes:
        fraction: part of the interval between two frames, above 0 and at most 1.
        samples: number of sub-frames of an image.
        interval: time between two frames, in units of the condition "time".
        limits: first and last time of the sequence; earlier and later times are clamped to them.
    """

    fraction: float
    samples: int
    interval: float
    limits: tuple[float, float]

    def sub_frames(self, view: View) -> list[View]:
        """Return the view at the middles of ``samples`` equal parts of the open interval."""
        time = view.conditions["time"]
        offsets = (self.fraction * self.interval * ((i + 0.5) / self.samples - 0.5) for i in range(self.samples))
        times = ((time.double() + offset).clamp(*self.limits).to(time) for offset in offsets)
        return [replace(view, conditions={**view.conditions, "time": moment}) for moment in times]


def choose_shutter(
    fraction: float,
    samples: int,
    conditions: Sequence[ConditionSpec],
    frames: tuple[int, int] | None,
    views: Sequence[View],
) -> Shutter:
    """Return the shutter of ``--shutter`` for the views of a model.

    Args:
        conditions: conditions of the task.
        frames: numbers of the first and the last source frame, at times 0 and 1; None: the mean distance of the views'
            times is the interval.
        views: the views to render, with their conditions.

    Raises:
        ConfigError: the model has no time, the fraction is out of range, or the interval between frames is unknown.
    """
    where = f"--shutter {fraction:g}"
    time = next((spec for spec in conditions if spec.name == "time" and not spec.shape), None)
    if time is None:
        raise ConfigError(f"{where}: the model does not vary in time; expected one of a moving scene. Omit --shutter.")
    if not 0 < fraction <= 1:
        raise ConfigError(f"{where}: expected a part of the frame interval, above 0 and at most 1")
    times = sorted({float(view.conditions["time"]) for view in views})
    if frames is not None and frames[1] > frames[0]:
        interval = 1 / (frames[1] - frames[0])
    elif len(times) > 1:
        interval = (times[-1] - times[0]) / (len(times) - 1)
    else:
        found = f"all images show time {times[0]:g}, and the model has no numbered frames"
        raise ConfigError(f"{where}: {found}; expected the interval of frames. Pass a range, such as --time 0:1:48.")
    return Shutter(fraction, samples, interval, time.range)


def mean_in_linear_light(images: Iterable[Tensor], color_space: str) -> Tensor:
    """Return the mean of (H, W, C) images in ``color_space``, taken in linear light; negative sRGB values become 0."""
    if color_space == "linear":
        return torch.stack(list(images)).mean(0)
    return linear_to_srgb(torch.stack([srgb_to_linear(image.clamp_min(0.0)) for image in images]).mean(0))
