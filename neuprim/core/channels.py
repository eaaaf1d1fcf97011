"""Names of the channels of a task's images, and their conversion to red, green and blue for display."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from neuprim.core.errors import CheckpointError, ConfigError, DataError
from neuprim.core.io.exr import default_exr_channel_names, exr_channel_name_error
from neuprim.core.io.images import linear_to_srgb
from neuprim.core.task import Display, TaskSpec

if TYPE_CHECKING:
    from neuprim.core.data import Dataset

__all__ = ["Channels"]

_LISTED = 8  # most names that a line of text lists; longer lists show the first three and the last


@dataclass(frozen=True)
class Channels:
    """The channels of a task's images.

    Attributes:
        names: one name per channel, in the order of the tensors' last axis.
        color_space: colour space of the data set, "srgb" or "linear".
        own: the task's function for display, :attr:`TaskSpec.display <neuprim.core.task.TaskSpec.display>`, or None.
        task: name of the task, for messages.
    """

    names: tuple[str, ...] = ("R", "G", "B")
    color_space: str = "srgb"
    own: Display | None = None
    task: str = ""

    @property
    def count(self) -> int:
        """Number of channels, C."""
        return len(self.names)

    @property
    def rgb(self) -> tuple[int, int, int] | None:
        """Indices of the channels that are shown as red, green and blue: those named R, G and B.

        Without these names, the indices are (0, 1, 2) for three channels and (0, 0, 0) for one channel. For other
        numbers of channels, the property is None.
        """
        if {"R", "G", "B"} <= set(self.names):
            return self.names.index("R"), self.names.index("G"), self.names.index("B")
        return {1: (0, 0, 0), 3: (0, 1, 2)}.get(self.count)

    @property
    def is_rgb(self) -> bool:
        """Whether the channels are red, green and blue, so that the sRGB curve applies to all of them."""
        return self.own is None and sorted(self.names) == ["B", "G", "R"]

    @property
    def hides_channels(self) -> bool:
        """Whether the task has no function for display, and the channels are not one or three.

        Pictures then show at most three of the channels.
        """
        return self.own is None and self.count not in (1, 3)

    @property
    def display_text(self) -> str:
        """Text that tells users which channels the pictures show, and in which colours; empty for plain RGB or grey."""
        if self.own is not None:
            return f"{self.name_list} through the display of task {self.task!r}"
        if self.names == default_exr_channel_names(self.count) and not self.hides_channels:
            return ""
        if self.count == 1:
            return f"{self.names[0]} as grey"
        chosen = [self.names[i] for i in self._shown_indices]
        part = f" of {self.count} channels" if self.count > 3 else ""
        return f"{', '.join(chosen)}{part} as {', '.join(('red', 'green', 'blue')[: len(chosen)])}"

    @property
    def name_list(self) -> str:
        """Names of the channels in one line; if there are more than 8, only the first three and the last."""
        if self.count <= _LISTED:
            return ", ".join(self.names)
        return f"{', '.join(self.names[:3])}, … {self.names[-1]} ({self.count} channels)"

    @property
    def _shown_indices(self) -> tuple[int, ...]:
        return self.rgb or tuple(range(min(self.count, 3)))

    def display(self, image: Tensor) -> Tensor:
        """Convert an image (H, W, C) in the data set's colour space to display-referred sRGB (H, W, 3).

        If the task has a function for display, this function converts the image, and values are clamped to 0..1.
        Otherwise, linear values get the sRGB curve, and values are not clamped at 1.

        Raises:
            ConfigError: the task's function for display returned no tensor (H, W, 3) of finite floats.
        """
        if image.shape[-1] != self.count:
            raise ValueError(
                f"image has shape {tuple(image.shape)}; expected (H, W, {self.count}), channels {self.name_list}"
            )
        if self.own is not None:
            return self._check_display(self.own(image), image)
        if self.count == 1:
            image = image.expand(-1, -1, 3)
        elif self.count != 3 or self._shown_indices != (0, 1, 2):
            image = torch.nn.functional.pad(image[..., list(self._shown_indices)], (0, max(0, 3 - self.count)))
        return linear_to_srgb(image.clamp_min(0.0)) if self.color_space == "linear" else image

    def display_rows(self, colours: Tensor) -> Tensor:
        """Convert M colours (M, C), e.g. of primitives, to display-referred sRGB (M, 3), 0..1."""
        return self.display(colours[None])[0].clamp(0.0, 1.0)

    def _check_display(self, found: Any, image: Tensor) -> Tensor:
        expected = (*image.shape[:2], 3)
        if not isinstance(found, Tensor) or tuple(found.shape) != expected or not found.is_floating_point():
            what = f"{found.dtype} of shape {tuple(found.shape)}" if isinstance(found, Tensor) else type(found).__name__
            raise ConfigError(
                f"task {self.task!r}: display returned {what} for an image {tuple(image.shape)}; "
                f"expected floats {expected}"
            )
        bad = int((~torch.isfinite(found)).sum())
        if bad:
            raise ConfigError(
                f"task {self.task!r}: display returned {bad} NaN or infinite values; expected numbers from 0 to 1"
            )
        return found.clamp(0.0, 1.0)


def find_channels(task: TaskSpec, dataset: Dataset) -> Channels:
    """Return the channels of a task's data set.

    Raises DataError if the data set has another number of channels than the task, or if its background does not fit the
    number of channels.
    """
    if task.channels and len(task.channels) != dataset.channels:
        named = f"{len(task.channels)}, the channels of task {task.name!r}: {', '.join(task.channels)}"
        raise DataError(f"{dataset.name}: images have {dataset.channels} channels; expected {named}")
    if (shape := tuple(dataset.background.shape)) != (dataset.channels,):
        expected = f"({dataset.channels},), one number per channel"
        raise DataError(f"{dataset.name}: the background has shape {shape}; expected {expected}")
    names = tuple(task.channels) or default_exr_channel_names(dataset.channels)
    return Channels(names, dataset.color_space, task.display, task.name)


def read_stored_channels(where: Path, header: Mapping[str, Any], task: TaskSpec, count: int) -> Channels:
    """Return the colour channels of a stored model, read from the header of its file.

    Args:
        where: the model's run directory, for messages.
        header: the JSON header of the model's file.
        count: number of colour channels of the model.

    Raises:
        CheckpointError: the channel names in the header are damaged or do not fit the model.
    """
    names = header.get("channels")
    if names is None:  # no run wrote the model
        names = task.channels if len(task.channels) == count else default_exr_channel_names(count)
    elif not isinstance(names, list) or len(names) != count or exr_channel_name_error(names):
        raise CheckpointError(
            f"{where}: the model's header names the channels {str(names)[:100]}; expected {count} different names"
        )
    return Channels(tuple(names), str(header.get("color_space", "srgb")), task.display, task.name)
